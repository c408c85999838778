"""All that the circle needs to be read, and a driver of our own. Importing this registers the reader."""

from collections.abc import Callable

import gymnasium as gym
import numpy as np
from circle_env import DT_S, CircleEnv

from dgvae_rl import FunctionReader, Scene, SceneSpec, register_reader


def read_circle(env: gym.Env) -> Scene:
    """The robot, then the people, who stay from the first step to the last."""
    states = np.vstack([env.unwrapped.robot, env.unwrapped.walkers])
    return Scene(states, np.arange(len(states)), np.ones(len(states), dtype=bool))


SPEC = SceneSpec(dt_s=DT_S, feature_scales=(5.0, 5.0, 1.0, 1.0), perception_m=8.0)
register_reader(
    CircleEnv, FunctionReader(read_circle, SPEC), crash_key="outcome.collided", success_key="outcome.reached"
)


def straight_on(env: gym.Env, rng: np.random.Generator) -> Callable[[dict], int]:
    """A driver: the robot goes to its goal, now and then astray; for --driver own:circle_reader:straight_on."""
    astray = rng.uniform(0.0, 0.4)

    def act(observation: dict) -> int:
        way = observation["robot"][4:]
        return int(rng.integers(9)) if rng.random() < astray else int(np.rint(np.arctan2(*way[::-1]) / (np.pi / 4))) % 8

    return act
