"""Drawings and films of environments with forecasts."""
