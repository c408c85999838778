"""One space for agents whose own spaces differ: padded observations with the agent's role appended, and cut actions.

Used by `envs.sb3.agents_as_rows` and `envs.sb3.acting`; independent of environments and episodes.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from envs.readers.base import role_of
from predictor.support.errors import UserError

_COUNTED = (gym.spaces.Discrete, gym.spaces.MultiDiscrete, gym.spaces.MultiBinary)


class PaddedObservation:
    """Pads the observations of all learners to one space.

    Args:
        own: observation space of each learner, by name.
        roles: number of each learner's role, by name.
        indicator: whether to append the one-hot of the role; None appends it if the spaces are unequal vectors.

    Attributes:
        space: padded space.

    Raises:
        UserError: spaces that cannot be padded, or an indicator without a 1-D Box.
    """

    def __init__(self, own: dict[str, gym.Space], roles: dict[str, int], indicator: bool | None) -> None:
        """Finds the padded space and the columns of the roles."""
        first = next(iter(own.values()))
        self._is_dict = isinstance(first, gym.spaces.Dict)
        self._own = {agent: dict(s.spaces) if isinstance(s, gym.spaces.Dict) else {"": s} for agent, s in own.items()}
        keys = list(next(iter(self._own.values())))
        for agent, entries in self._own.items():
            if isinstance(own[agent], gym.spaces.Dict) != self._is_dict or set(entries) != set(keys):
                raise UserError(
                    f"observations must have the same entries for all agents, got {first} and, for '{agent}', "
                    f"{own[agent]}; name agents of one kind in agents="
                )
        self._entries = {key: _shared_entry([entries[key] for entries in self._own.values()]) for key in keys}
        self._vector = "observation" if self._is_dict else ""
        self._role_column: dict[str, int] = {}
        box = self._entries.get(self._vector)
        if not isinstance(box, gym.spaces.Box) or len(box.shape) != 1:
            if indicator:
                raise UserError(f"agent_indicator needs a 1-D Box to extend, got {first}; pass agent_indicator=False")
        elif indicator or (indicator is None and any(space != first for space in own.values())):
            self._role_column = {agent: box.shape[0] + role for agent, role in roles.items()}
            self._entries[self._vector] = _with_one_hot(box, max(roles.values()) + 1)
        self.space = gym.spaces.Dict(self._entries) if self._is_dict else self._entries[""]

    def stack(self, observations: Sequence[tuple[str, Any]]) -> Any:
        """Returns the padded observations of (agent, own observation) pairs, stacked; zeros for None."""
        arrays = {key: self._stacked(key, observations) for key in self._entries}
        for i, (agent, seen) in enumerate(observations if self._role_column else ()):
            if seen is not None:
                arrays[self._vector][i, self._role_column[agent]] = 1
        return arrays if self._is_dict else arrays[""]

    def _stacked(self, key: str, observations: Sequence[tuple[str, Any]]) -> NDArray[Any]:
        """Returns one entry of all observations, padded."""
        space = self._entries[key]
        shape, start = space.shape or (), getattr(space, "start", 0)
        padding = np.full(shape, start, space.dtype)
        values = [
            padding if seen is None else np.asarray(seen[key] if self._is_dict else seen) for _, seen in observations
        ]
        for i, ((agent, seen), value) in enumerate(zip(observations, values, strict=True)):
            if seen is None:
                continue
            own = self._own[agent][key].shape
            if value.shape != own:
                raise UserError(f"the observation of agent '{agent}' must have shape {own}, got {value.shape}")
            if own != shape:
                values[i] = padding.copy()
                values[i][_corner(own)] = value
        return np.array(values, space.dtype).reshape(len(values), *shape)

    def one(self, agent: str, seen: Any) -> Any:
        """Returns a single padded observation."""
        stacked = self.stack([(agent, seen)])
        return {key: value[0] for key, value in stacked.items()} if self._is_dict else stacked[0]


def _shared_entry(own: list[gym.Space]) -> gym.Space:
    """Returns a Box that holds all of these Boxes, padded, and zero; or the one space that they all equal."""
    boxes = [space for space in own if isinstance(space, gym.spaces.Box)]
    if len(boxes) == len(own) and len({len(box.shape) for box in boxes}) == 1:
        shape = tuple(np.max([box.shape for box in boxes], axis=0).astype(int)) if boxes[0].shape else ()
        zeros = np.zeros(shape, np.result_type(*(box.dtype for box in boxes)))
        return _union(boxes, zeros.copy(), zeros.copy())
    if isinstance(own[0], _COUNTED) and all(space == own[0] for space in own):
        return own[0]
    kinds = ", ".join(sorted({str(space) for space in own}))
    raise UserError(
        f"observations must be Boxes of as many axes for all agents, or equal Discrete, MultiDiscrete or MultiBinary "
        f"spaces (or a flat Dict of these); got {kinds}"
    )


def _with_one_hot(box: gym.spaces.Box, count: int) -> gym.spaces.Box:
    low, high = np.zeros(count, box.dtype), np.ones(count, box.dtype)
    return gym.spaces.Box(np.concatenate([box.low, low]), np.concatenate([box.high, high]), dtype=low.dtype.type)


def shared_action(own: Mapping[str, gym.Space]) -> gym.Space:
    """Returns the action space that holds those of all learners."""
    spaces = list(own.values())
    discrete = [space for space in spaces if isinstance(space, gym.spaces.Discrete)]
    if len(discrete) == len(spaces):
        return gym.spaces.Discrete(max(int(space.n) for space in discrete))
    boxes = [space for space in spaces if isinstance(space, gym.spaces.Box)]
    if len(boxes) == len(spaces) and (len({b.shape for b in boxes}) == 1 or all(len(b.shape) == 1 for b in boxes)):
        largest = max(boxes, key=lambda box: box.low.size)
        return _union(boxes, largest.low.copy(), largest.high.copy())
    if isinstance(spaces[0], _COUNTED) and all(space == spaces[0] for space in spaces):
        return spaces[0]
    raise UserError(
        "one policy needs actions that are all Discrete, all 1-D Boxes, or equal; got "
        f"{', '.join(f'{agent}: {space}' for agent, space in own.items())}; name agents of one kind in agents="
    )


def own_action(action: Any, space: gym.Space) -> Any:
    """Returns the agent's own action for one of the padded space."""
    if isinstance(space, gym.spaces.Discrete):
        return int(space.start) + min(int(action), int(space.n) - 1)
    if isinstance(space, gym.spaces.Box):
        return np.clip(action[_corner(space.shape)], space.low, space.high).astype(space.dtype)
    return action


def _union(boxes: list[gym.spaces.Box], low: NDArray[Any], high: NDArray[Any]) -> gym.spaces.Box:
    """Returns a Box that holds all of these, each in the first corner, and all values from `low` to `high`."""
    for box in boxes:
        corner = _corner(box.shape)
        low[corner] = np.minimum(low[corner], box.low)
        high[corner] = np.maximum(high[corner], box.high)
    return gym.spaces.Box(low, high, dtype=low.dtype.type)


def _corner(shape: tuple[int, ...]) -> tuple[slice, ...]:
    """Returns the index of the first `shape[i]` elements along each axis i."""
    return tuple(slice(size) for size in shape)


def learners_named(possible_agents: Sequence[str], names: Sequence[str], source: str) -> list[str]:
    """Returns the agents that are named by themselves or by their role; no name stands for all.

    Args:
        possible_agents: names of the environment's agents.
        names: names of agents ("adversary_0") or roles ("adversary").
        source: name of the environment or policy, for messages.

    Raises:
        UserError: a name is neither.
    """
    for name in names:
        if not any(name in (agent, role_of(agent)) for agent in possible_agents):
            raise UserError(
                f"learners: '{name}' is neither an agent nor a role of {source}; it has {', '.join(possible_agents)}"
            )
    return [a for a in possible_agents if not names or a in names or role_of(a) in names]


def roles_of(observations: Mapping[str, gym.Space], actions: Mapping[str, gym.Space]) -> dict[str, int]:
    """Returns the number of each agent's role, in the order of first appearance."""
    kinds: list[tuple[str, gym.Space, gym.Space]] = []
    roles = {}
    for agent in observations:
        kind = (role_of(agent), observations[agent], actions[agent])
        if kind not in kinds:
            kinds.append(kind)
        roles[agent] = kinds.index(kind)
    return roles
