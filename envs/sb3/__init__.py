"""Vector environments for Stable-Baselines3; nothing outside this package imports it."""
