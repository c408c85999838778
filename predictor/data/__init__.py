"""Datasets: the episode store, the loaders that write it and the training windows cut from it."""
