"""Simulators of our own, or adapted: they know no readers, forecasts or policies."""
