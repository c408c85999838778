"""Baseline forecasters, with the interface of the dG-VAE."""
