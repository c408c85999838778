"""Simulators of our own, or adapted: they know no readers, forecasts or policies."""

HIGHWAY_MULTIAGENT_IDS = ("intersection-multi-agent-v2", "intersection-multi-agent-v1", "intersection-multi-agent-v0")
"""Ids of `envs.simulators.highway_multiagent`, listed where PettingZoo need not be imported."""
