"""Vector environments and policy files for Stable-Baselines3, which other modules of `envs` do not need."""
