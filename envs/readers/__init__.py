"""Scene readers: how to see the agents of an environment family. One module per family."""

from typing import Protocol, runtime_checkable

import gymnasium as gym

from envs.readers.highway import HighwayReader, is_highway_env
from predictor.errors import UserError
from predictor.scene import Scene, SceneSpec

__all__ = ["HighwayReader", "SceneReader", "reader_for"]


@runtime_checkable
class SceneReader(Protocol):
    """Sees the agents of one environment; keeps their identities from step to step."""

    @property
    def spec(self) -> SceneSpec:
        """What the scenes of this reader look like."""

    def reset(self) -> None:
        """Forget all identities: a new episode has begun."""

    def read(self, env: gym.Env) -> Scene:
        """The scene as a perception system would have it: within `perception_m`, at most `max_agents`."""


def reader_for(env: gym.Env, perception_m: float | None = None, max_agents: int | None = None) -> HighwayReader:
    """The reader that knows this environment.

    Args:
        env: any gymnasium environment, wrapped or not.
        perception_m: how far the ego sees [m]; None takes the family's default.
        max_agents: rows of a scene, the ego included; None takes the family's default.

    Raises:
        UserError: no reader knows the environment.
    """
    if is_highway_env(env):
        return HighwayReader(env, perception_m=perception_m, max_agents=max_agents)
    raise UserError(
        f"no scene reader knows {env.unwrapped.__class__.__name__}; pass reader=, an object with "
        "spec, reset() and read(env) -> Scene"
    )
