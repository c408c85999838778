"""Benchmarks of speed: `python -m benchmarks` runs every section and prints one table (docs/speed.md)."""
