"""Policies that learn from forecasts: features, training, evaluation, studies (Stable-Baselines3)."""
