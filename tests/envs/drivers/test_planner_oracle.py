"""The planner with true futures: an upper bound of what forecasts can bring."""

import numpy as np
import pytest

from envs import make_env
from envs.drivers.planner import planner_driver
from envs.readers import EntityRowsReader
from envs.wrappers import SceneObservation
from predictor.scene import SceneSpec


def test_it_knows_who_will_brake():
    """Another car stops at once behind nobody's forecast: the oracle alone counts the collision of going on."""
    env = make_env("highway-fast-v0", config={"vehicles_count": 1, "lanes_count": 1})
    env.reset(seed=0)
    ego, ahead = env.unwrapped.road.vehicles[:2]
    ahead.position[0] = ego.position[0] + 45.0
    ahead.speed = ego.speed
    ahead.act = lambda action=None: ahead.action.update(acceleration=-8.0, steering=0.0)
    risks = {}
    for name in ("planner", "planner:oracle"):
        planner = planner_driver(name, env, np.random.default_rng(0))
        planner()
        faster = planner.plan_model.names.index("FASTER")
        risks[name] = 1 - planner.survival[faster, -1]
    env.close()
    assert risks["planner:oracle"] == 1.0
    assert risks["planner"] < 0.9


@pytest.mark.slow
def test_over_a_wrapper_it_shows_the_copys_own_observations_to_the_reader():
    columns = ("presence", "x", "y", "vx", "vy")
    table = {"type": "Kinematics", "features": [*columns], "absolute": True, "normalize": False, "see_behind": True}
    made = make_env("highway-fast-v0", config={"observation": table})
    env = SceneObservation(made, reader=EntityRowsReader(columns, SceneSpec(dt_s=1.0)))
    observation, _ = env.reset(seed=0)
    planner = planner_driver("planner:oracle", env, np.random.default_rng(0))
    for _ in range(2):
        observation, *_ = env.step(planner(observation))
    assert planner.survival.shape == (5, 5) and set(np.unique(planner.survival)) <= {0.0, 1.0}
    env.close()
