"""Forecasters to compare with, behind the same interface as the dG-VAE."""
