"""Pictures and videos of environments with forecasts."""
