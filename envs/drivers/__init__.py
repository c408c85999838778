"""Drivers: they choose the actions while data is collected or accuracy is measured."""
