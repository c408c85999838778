"""Simulators that are added or adapted here; they import no readers, forecasters or policies."""
