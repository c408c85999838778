"""Datasets: the episode store and what is read from it."""
