"""All that the crossing needs to be read: who is there, ego first. Importing this registers it."""

import gymnasium as gym
import numpy as np
from crossing_env import DT_S, CrossingEnv

from envs.readers import register_reader
from envs.readers.function import FunctionReader
from predictor.scene import Scene, SceneSpec


def read_crossing(env: gym.Env) -> Scene:
    """The robot, then the walkers; they have numbers, so that no agent has to be recognised."""
    world = env.unwrapped
    states = np.vstack([world.robot, world.walkers])
    return Scene(states, np.append(0, world.numbers + 1), np.ones(len(states), dtype=bool))


SPEC = SceneSpec(dt_s=DT_S, feature_scales=(10.0, 10.0, 1.0, 1.0), perception_m=10.0)
register_reader(CrossingEnv, FunctionReader(read_crossing, SPEC), crash_key="touched", success_key="arrived")
