"""Re-identifies agents between two steps, for environments that report agents without names: `IdentityTracker`.

Each agent of the last step is extrapolated with the mean of its old and new velocity, which is exact under constant
acceleration, and matched to the nearest observation (optimal assignment over all agents). Matches are reliable only
where motion is smooth: where the environment numbers or names its agents, use those.
"""

import hashlib
import math
import weakref
from collections.abc import Iterator, Sequence
from copy import deepcopy
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from predictor.scene import PADDING_ID
from predictor.support.errors import UserError

_CHANGE_WEIGHT = 0.1

Known = TypeVar("Known")


def agent_ids(names: Sequence[str]) -> Int[np.ndarray, " agents"]:
    """Returns a number for each name, for simulators whose agents have names: the same name has the same number.

    Numbers are 62 bits of a hash, so they need no memory and are equal in every process.

        >>> agent_ids(["car_7", "walker_1"]).tolist() == agent_ids(["walker_1", "car_7"]).tolist()[::-1]
        True

    Args:
        names: names of the agents of a scene.
    """
    digests = (hashlib.blake2b(str(name).encode(), digest_size=8).digest() for name in names)
    return np.array([int.from_bytes(digest) >> 2 for digest in digests], dtype=np.int64)


class IdentityDict(weakref.WeakKeyDictionary[Any, Known]):
    """Dictionary whose keys are the simulator's own objects; an entry is removed with its object.

    Keyed by the living object, since `id()` is reused after garbage collection and would join two agents. Unlike in its
    base, in a copy (`copy.deepcopy`, `pickle`) of reader and environment together, the entries
    belong to the copied objects.
    """

    def __deepcopy__(self, memo: dict[int, Any]) -> "IdentityDict[Known]":
        """Returns a dictionary of the copied objects."""
        copied: IdentityDict[Known] = IdentityDict()
        for key, value in list(self.items()):
            copied[deepcopy(key, memo)] = deepcopy(value, memo)
        return copied

    def __reduce__(self) -> tuple[type, tuple[()], None, None, Iterator[tuple[Any, Known]]]:
        """Pickles the objects with their entries."""
        return type(self), (), None, None, iter(list(self.items()))


class IdentityTracker:
    """Gives the agents of one environment numbers that stay with them from step to step.

    Each known agent is extrapolated with the mean of its old and new velocity and matched to the observations by
    optimal assignment. A pair costs √(r² + c²) [m], with r its distance from the extrapolated position and c a tenth of
    its change of velocity times the time between the steps; without c, two agents that pass each other head-on could
    not be distinguished from two that turn round. A pair that costs `gate_m` or more, or whose `keys` differ, is no
    match. The assignment maximises the sum of `gate_m` − cost over its pairs.

    Args:
        dt_s: time between two updates [s].
        gate_m: an agent is not found again at this cost or more [m]; half the least distance between two agents is a
            good start, more where agents brake hard within a step (10 m for cars at 1 s).
        memory_steps: for how many updates an agent that is not seen is remembered, keeping its velocity; 0 forgets it
            at once, and it comes back as a new agent.
    """

    def __init__(self, dt_s: float, gate_m: float, memory_steps: int = 0) -> None:
        """Starts without known agents."""
        if not 0 < dt_s < np.inf or not 0 < gate_m < np.inf or memory_steps < 0:
            raise UserError(
                "IdentityTracker needs a positive dt_s and gate_m and memory_steps of at least 0, "
                f"got {dt_s}, {gate_m}, {memory_steps}"
            )
        self._dt_s, self._gate_m, self._memory_steps = dt_s, gate_m, memory_steps
        self.reset()

    def reset(self) -> None:
        """Forgets all agents: a new episode has begun. Numbering starts anew at 0."""
        self._next_id = 0
        self._ids: np.ndarray = np.empty(0, dtype=np.int64)
        self._place: np.ndarray = np.empty((0, 0))
        self._motion: np.ndarray = np.empty((0, 0))
        self._kinds: np.ndarray = np.empty((0, 0))
        self._steps: np.ndarray = np.empty(0)

    def update(
        self,
        positions: Float[np.ndarray, "agents axes"],
        velocities: Float[np.ndarray, "agents axes"],
        valid: Bool[np.ndarray, " agents"] | None = None,
        keys: Shaped[np.ndarray, "agents ..."] | None = None,
    ) -> Int[np.ndarray, " agents"]:
        """Takes in one step and returns the number of each agent.

        Args:
            positions: one axis system for all steps [m].
            velocities: in the same axes [m/s].
            valid: which entries hold an agent; None means all.
            keys: constant properties of each agent (its kind, a driver's parameter), in one column or several; compared
                exactly. Their columns do not change between steps.

        Returns:
            Numbers from 0 on in the order of first sight; -1 where there is no agent.

        Raises:
            UserError: positions or velocities that are not finite, or axes or keys other than those of the last step.
        """
        indices = np.arange(len(positions)) if valid is None else np.flatnonzero(valid)
        place, motion = np.asarray(positions[indices], np.float64), np.asarray(velocities[indices], np.float64)
        if not (np.isfinite(place).all() and np.isfinite(motion).all()):
            raise UserError("IdentityTracker needs finite positions and velocities of all valid agents")
        kinds = np.zeros((len(indices), 0)) if keys is None else np.asarray(keys)[indices]
        kinds = kinds.reshape(len(indices), math.prod(kinds.shape[1:]))
        found = self._recognise(place, motion, kinds)
        fresh = found == PADDING_ID
        found[fresh] = np.arange(self._next_id, self._next_id + fresh.sum())
        self._next_id += int(fresh.sum())
        self._remember(found, place, motion, kinds)
        ids = np.full(len(positions), PADDING_ID, dtype=np.int64)
        ids[indices] = found
        return ids

    def _recognise(self, place: np.ndarray, motion: np.ndarray, kinds: np.ndarray) -> np.ndarray:
        """Returns the number of each observation's agent; -1 for a new one."""
        found = np.full(len(place), PADDING_ID, dtype=np.int64)
        if not len(self._ids) or not len(place):
            return found
        if kinds.shape[1] != self._kinds.shape[1] or place.shape[1] != self._place.shape[1]:
            raise UserError(
                f"IdentityTracker needs the same axes and keys at every step, got {place.shape[1]} and "
                f"{kinds.shape[1]} after {self._place.shape[1]} and {self._kinds.shape[1]}; call reset() between"
            )
        cost = self._costs(place, motion)
        for column in range(kinds.shape[1]):
            cost[self._kinds[:, None, column] != kinds[:, column]] = np.inf
        agents, observations = best_pairs(cost, self._gate_m)
        found[observations] = self._ids[agents]
        return found

    def _costs(self, place: np.ndarray, motion: np.ndarray) -> np.ndarray:
        """Returns the cost of each pair of known agent and observation [m], without gate and keys."""
        half_s = (0.5 * self._dt_s * self._steps)[:, None]
        weight_s = 2 * _CHANGE_WEIGHT * half_s
        straight = self._place + half_s * self._motion
        total = np.zeros((len(self._ids), len(place)))
        for axis in range(place.shape[1]):
            miss = place[:, axis] - straight[:, axis, None] - half_s * motion[:, axis]
            change = weight_s * (motion[:, axis] - self._motion[:, axis, None])
            total += miss * miss + change * change
        return np.sqrt(total)

    def _remember(self, ids: np.ndarray, place: np.ndarray, motion: np.ndarray, kinds: np.ndarray) -> None:
        """Keeps the agents observed now, and those observed within the last `memory_steps` steps."""
        steps = np.ones(len(ids))
        if self._memory_steps and len(self._ids):
            lost = np.flatnonzero(~np.isin(self._ids, ids) & (self._steps <= self._memory_steps))
            ids = np.concatenate([ids, self._ids[lost]])
            place, motion = np.concatenate([place, self._place[lost]]), np.concatenate([motion, self._motion[lost]])
            kinds = np.concatenate([kinds, self._kinds[lost]])
            steps = np.concatenate([steps, self._steps[lost] + 1])
        self._ids, self._place, self._motion, self._kinds, self._steps = ids, place, motion, kinds, steps


def best_pairs(
    cost: Float[np.ndarray, "rows columns"], gate: float
) -> tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]]:
    """Returns the pairing with the largest sum of `gate` − cost, of pairs that cost less than `gate`.

    Args:
        cost: not NaN; infinite where a pair is not allowed.
        gate: cost of leaving a row and a column unpaired.

    Returns:
        Rows and columns of the pairs; each row and each column at most once.
    """
    # If all rows have different nearest columns, taking each row's nearest is optimal; so it is with columns.
    rows, columns = np.arange(cost.shape[0]), cost.argmin(axis=1)
    near = cost[rows, columns] < gate
    if _distinct(columns[near], cost.shape[1]):
        return rows[near], columns[near]
    columns, rows = np.arange(cost.shape[1]), cost.argmin(axis=0)
    near = cost[rows, columns] < gate
    if _distinct(rows[near], cost.shape[0]):
        return rows[near], columns[near]
    from scipy.optimize import linear_sum_assignment  # slow to import, and seldom needed

    rows, columns = linear_sum_assignment(np.minimum(cost, gate))  # a pair at the gate gains nothing
    near = cost[rows, columns] < gate
    return rows[near], columns[near]


def _distinct(values: np.ndarray, limit: int) -> bool:
    return len(values) < 2 or int(np.bincount(values, minlength=limit).max()) == 1
