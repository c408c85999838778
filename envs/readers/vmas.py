"""Reads scenes out of VMAS, whose environments step thousands of worlds at once in torch: `VmasReader`.

The layout is that of `envs.readers.mpe`, whose particle worlds VMAS resembles: a forecaster trained in one runs in the
other where the time step is equal. VMAS is not imported here.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from envs.readers.batched import AgentTensors, TensorReader
from envs.readers.mpe import MPE_FEATURES
from predictor.scene import SceneBatch, SceneSpec
from predictor.support.errors import UserError


class VmasReader:
    """Reads all worlds of a VMAS environment at once; no agent is the ego.

    Entities stay from the first step to the last, in one order, so an entity's place is its identity.

    Args:
        env: the environment (`vmas.make_env`); its world gives `dt_s`.
        landmarks: whether to read landmarks (goals, obstacles) as well.

    Raises:
        UserError: not an environment of VMAS, or its world is not flat.
    """

    def __init__(self, env: Any, landmarks: bool = True) -> None:
        """Derives the spec from the world."""
        world: Any = getattr(env, "world", None)
        if not all(hasattr(world, name) for name in ("agents", "landmarks", "dt", "batch_dim")):
            raise UserError(f"VmasReader needs an environment of VMAS (vmas.make_env), got {type(env).__name__}")
        if world.dim_p != 2:
            raise UserError(f"VmasReader needs a world of two axes, got {world.dim_p}")
        self._landmarks = landmarks
        entities = self._entities(world)
        self._constants = torch.tensor(
            [_constants(one, any(one is landmark for landmark in world.landmarks)) for one in entities]
        )
        self._reader = TensorReader(
            SceneSpec(
                dt_s=float(world.dt),
                feature_names=MPE_FEATURES,
                feature_scales=(1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.1),
                has_ego=False,
                perception_m=1000.0,
                max_agents=len(entities),
                constant_features=MPE_FEATURES[4:],
            )
        )

    @property
    def spec(self) -> SceneSpec:
        """Returns the layout of the scenes; no axis has another frame than the world's."""
        return self._reader.spec

    def reset(self, envs: Int[np.ndarray, " some"]) -> None:
        """Does nothing: an entity's place is its identity."""

    def read(self, states: Any, envs: Int[np.ndarray, " some"]) -> SceneBatch:
        """Returns the scenes of some worlds: agents first, then landmarks.

        Args:
            states: the environment.
            envs: index of each of these worlds.
        """
        return self._reader.read(AgentTensors(self._states(states.world))[envs], envs)

    def _entities(self, world: Any) -> list[Any]:
        return [*world.agents, *(world.landmarks if self._landmarks else ())]

    def _states(self, world: Any) -> Float[Tensor, "envs entities features"]:
        entities = self._entities(world)
        moving = torch.stack([torch.cat([e.state.pos, e.state.vel], dim=-1) for e in entities], dim=1).cpu()
        return torch.cat([moving, self._constants.to(moving).expand(len(moving), -1, -1)], dim=-1)


def _constants(entity: Any, landmark: bool) -> tuple[float, float, float]:
    adversary = bool(getattr(entity, "adversary", False))
    return float(adversary), float(landmark), float(entity.shape.circumscribed_radius())
