"""The upper bound of springs in a stream: places without an agent change nothing."""

import numpy as np
import pytest
import torch

from predictor.baselines.least_squares import SpringLeastSquares
from predictor.data.springs import Physics, spring_spec
from predictor.online import OnlineForecaster
from predictor.scene import Forecast, SceneBatch

AGENTS = 4


def forecast(places: int, states: np.ndarray) -> Forecast:
    """What is forecast after these states of the first agents of as many places."""
    stream = OnlineForecaster(SpringLeastSquares(spring_spec(Physics(num_agents=places))), 1, places)
    agents = states.shape[1]
    for now in states:
        padded = np.zeros((1, places, 4))
        padded[0, :agents] = now
        valid = np.arange(places)[None] < agents
        stream.observe(SceneBatch(padded, np.where(valid, np.arange(places), -1), valid, np.zeros(1)))
    return stream.forecast(5)


@pytest.mark.parametrize("places", [AGENTS + 1, AGENTS + 3])
def test_places_without_an_agent_change_nothing(places: int):
    states = np.random.default_rng(0).normal(scale=0.3, size=(6, AGENTS, 4))
    expected, found = forecast(AGENTS, states), forecast(places, states)
    torch.testing.assert_close(found.xy[:, :, :AGENTS], expected.xy, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(found.edge_features[:, :AGENTS, :AGENTS], expected.edge_features, rtol=1e-4, atol=1e-5)
    assert not found.xy[:, :, AGENTS:].any()
