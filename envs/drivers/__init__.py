"""Drivers, which choose the actions in data collection and evaluation."""
