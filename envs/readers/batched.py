"""Reads the scenes of many environments at once: the interface `BatchedReader`, and readers of state tensors.

Environments that step thousands of rows at once keep their state in arrays of rows × agents. A batched reader turns
these into one `SceneBatch`, with operations on whole arrays and no loop over rows; `envs.scene_stream` takes it from
there.
"""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from envs.readers.base import perceive_batch
from predictor.scene import LARGEST, PADDING_ID, SceneBatch, SceneSpec
from predictor.support.errors import UserError

Array = Tensor | np.ndarray
"""Array of an environment's state: torch's, on any device, or NumPy's."""


@runtime_checkable
class BatchedReader(Protocol):
    """Reads the agents of many environments at once; keeps their identities from step to step."""

    @property
    def spec(self) -> SceneSpec:
        """Returns the layout of the scenes."""

    def reset(self, envs: Int[np.ndarray, " some"]) -> None:
        """Forgets all identities of some environments: new episodes have begun there."""

    def read(self, states: Any, envs: Int[np.ndarray, " some"]) -> SceneBatch:
        """Returns one scene for each of these environments, padded to `max_agents`.

        With an ego (`spec.has_ego`), what it perceives, itself first; without one, all agents.

        Args:
            states: what the simulator reports of these environments.
            envs: index of each of these environments.
        """


@dataclass(frozen=True)
class AgentTensors:
    """State of all agents of many environments at one instant, as a tensor environment keeps it."""

    states: Float[Array, "envs agents features"]
    """States in the world frame, SI units, in the order of the spec's `feature_names`; the ego first where there is
    one."""
    valid: Bool[Array, "envs agents"] | None = None
    """Which entries hold an agent; None: all."""
    ids: Int[Array, "envs agents"] | None = None
    """Identity of each agent within its environment, not negative and constant while it is there; None: its column."""
    heading_rad: Float[Array, " envs"] | None = None
    """Heading of each ego; None: 0, world axes."""

    def __getitem__(self, envs: Int[np.ndarray, " some"]) -> "AgentTensors":
        """Returns the state of some environments."""
        parts = (self.states, self.valid, self.ids, self.heading_rad)
        return AgentTensors(*(None if part is None else part[envs] for part in parts))  # type: ignore[arg-type]


class TensorReader:
    """Reads the scenes of environments that keep their agents in arrays; makes no copy of them on the way but one.

        >>> import torch
        >>> from predictor.scene import SceneSpec
        >>> reader = TensorReader(SceneSpec(dt_s=0.1, max_agents=3))
        >>> states = torch.zeros(1000, 5, 4)  # 1000 environments, an ego and 4 others, position and velocity
        >>> states[:, :, 0] = torch.arange(5)  # one metre apart
        >>> reader.read(AgentTensors(states), np.arange(1000)).ids[0].tolist()  # the ego and the nearest two
        [0, 1, 2]

    Args:
        spec: layout of the scenes; with an ego, its `perception_m` and `max_agents` decide what is perceived.
    """

    def __init__(self, spec: SceneSpec) -> None:
        """Stores the spec."""
        self._spec = spec

    @property
    def spec(self) -> SceneSpec:
        """Returns the layout of the scenes."""
        return self._spec

    def reset(self, envs: Int[np.ndarray, " some"]) -> None:
        """Does nothing: environments number their agents."""

    def read(self, states: AgentTensors, envs: Int[np.ndarray, " some"]) -> SceneBatch:
        """Returns one scene for each of these environments, padded to `max_agents`.

        Args:
            states: state of these environments.
            envs: index of each of these environments.

        Raises:
            UserError: the arrays do not fit the spec or each other, numbers of present agents are not finite, ids are
                negative or not unique within an environment, an ego is absent, or there are more agents than
                `max_agents` and no ego.
        """
        full = _as_scenes(states, len(envs))
        check_scenes(full, self._spec)
        if self._spec.has_ego:
            return perceive_batch(full, self._spec)
        missing = self._spec.max_agents - full.valid.shape[1]
        pad = ((0, 0), (0, missing))
        return SceneBatch(
            np.pad(full.states, (*pad, (0, 0))),
            np.pad(full.ids, pad, constant_values=PADDING_ID),
            np.pad(full.valid, pad),
            full.heading_rad,
        )


def check_scenes(scenes: SceneBatch, spec: SceneSpec, source: str = "TensorReader") -> None:
    """Raises unless all scenes of a batch are well-formed, as `Scene.check` does for one.

    Args:
        scenes: all agents of each environment, the ego first where the spec has one.
        spec: layout of the scenes.
        source: name of the reader, for messages.

    Raises:
        UserError: wrong shapes, numbers that are not finite, bad ids, or no ego.
    """
    agents, features = scenes.states.shape[1:]
    if features != spec.num_features:
        raise UserError(f"{source}: states need {spec.num_features} features {spec.feature_names}, got {features}")
    if not spec.has_ego and agents > spec.max_agents:
        raise UserError(f"{source}: {agents} agents do not fit max_agents={spec.max_agents}; raise max_agents")
    _refuse(source, "the states of present agents must be finite", ~np.isfinite(scenes.states).all(axis=(1, 2)))
    _refuse(source, f"states must be at most {LARGEST:g} in size", (np.abs(scenes.states) > LARGEST).any(axis=(1, 2)))
    _refuse(source, "heading_rad must be finite", ~np.isfinite(scenes.heading_rad))
    _refuse(source, "ids of present agents must not be negative", ((scenes.ids < 0) & scenes.valid).any(axis=1))
    ordered = np.sort(np.where(scenes.valid, scenes.ids, -1 - np.arange(agents)), axis=1)
    _refuse(source, "ids must be unique within an environment", (ordered[:, 1:] == ordered[:, :-1]).any(axis=1))
    if spec.has_ego:
        absent = ~scenes.valid[:, 0] if agents else np.ones(len(scenes), dtype=np.bool_)
        _refuse(source, "agent 0 must be the ego, which is always there", absent)


def _refuse(source: str, rule: str, wrong: Bool[np.ndarray, " envs"]) -> None:
    if wrong.any():
        first = int(wrong.argmax())
        raise UserError(
            f"{source}: {rule}, but it is not so in {int(wrong.sum())} of {len(wrong)}, entry {first} first"
        )


def _as_scenes(given: AgentTensors, envs: int) -> SceneBatch:
    """Returns the arrays as NumPy's, entries without an agent cleared."""
    states = _as_numpy(given.states)
    if states.ndim != 3 or len(states) != envs:
        raise UserError(f"TensorReader needs states of {envs} environments × agents × features, got {states.shape}")
    shape = states.shape[:2]
    valid = np.ones(shape, dtype=np.bool_) if given.valid is None else _as_numpy(given.valid)
    ids = np.broadcast_to(np.arange(shape[1]), shape) if given.ids is None else _as_numpy(given.ids)
    heading_rad = np.zeros(envs) if given.heading_rad is None else _as_numpy(given.heading_rad)
    for name, array, wanted in (("valid", valid, shape), ("ids", ids, shape), ("heading_rad", heading_rad, shape[:1])):
        if array.shape != wanted:
            raise UserError(
                f"TensorReader needs {name} of the shape {wanted}, as the states have it, got {array.shape}"
            )
    for name, array in (("states", states), ("heading_rad", heading_rad)):
        if array.dtype.kind not in "fiu":
            raise UserError(f"TensorReader needs {name} that are numbers, got {array.dtype}")
    if ids.dtype.kind not in "iu":
        raise UserError(f"TensorReader needs ids that are whole numbers, got {ids.dtype}")
    if valid.dtype.kind != "b" and not np.isin(valid, (0, 1)).all():
        raise UserError(f"TensorReader needs valid of True and False (or 1 and 0), got {valid.dtype} with other values")
    valid = valid.astype(np.bool_)
    states = np.where(valid[..., None], states, 0.0).astype(np.float64, copy=False)
    ids = np.where(valid, ids, PADDING_ID).astype(np.int64, copy=False)
    heading_rad = np.array(heading_rad, dtype=np.float64)  # the simulator may write into its own
    return SceneBatch(states, ids, valid, heading_rad)


def _as_numpy(array: Any) -> np.ndarray:
    if not isinstance(array, Tensor):
        return np.asarray(array)
    return (array.float() if array.dtype is torch.bfloat16 else array).detach().cpu().numpy()  # NumPy has no bfloat16
