"""Reads scenes out of EnvPool's native highway environments (EnvPool ≥ 1.2.5): of one environment, or of a whole pool.

Sees what a perception system could: position, speed and heading. Lanes, routes, driver parameters and the order of the
simulator's list are not used; who is who between two steps is told from the motion alone. The ego knows itself: it is
the list's first vehicle. Parking, lane keeping and the multi-agent intersection are not covered.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from jaxtyping import Bool, Float, Int

from envs.readers.base import Reader, perceive_batch
from envs.readers.identity import best_pairs
from envs.simulators.envpool import HIGHWAY_ENV_OF
from predictor.errors import UserError
from predictor.scene import PADDING_ID, AxisFrame, Scene, SceneBatch, SceneSpec

GATE_M = 12.0
"""A vehicle is not found again beyond this cost [m]; docs/envpool.md has what the motion within a step costs."""

_UNBOUNDED_X: tuple[AxisFrame, AxisFrame] = ("ego", "world")
_FIXED_MAP: tuple[AxisFrame, AxisFrame] = ("world", "world")
_STRAIGHT_ROADS = ("Highway-v0", "HighwayFast-v0", "TwoWay-v0")
_CHANGE_WEIGHT = 0.1  # as `IdentityTracker`
_STATE = tuple(map(attrgetter, ("x", "y", "speed", "heading")))


class NativeEnv(Protocol):
    """What `EnvPoolReader` needs of an environment."""

    task_id: str
    native_config: Mapping[str, Any]

    def debug_states(self) -> Sequence[Any]:
        """EnvPool's own description of the one environment."""


def is_envpool_env(env: gym.Env) -> bool:
    """Whether the environment is one of EnvPool's highway environments behind `envs.simulators.envpool.EnvPoolEnv`."""
    inner = env.unwrapped
    return getattr(inner, "task_id", None) in HIGHWAY_ENV_OF and hasattr(inner, "debug_states")


def native_spec(
    task_id: str, config: Mapping[str, Any], perception_m: float | None = None, max_agents: int | None = None
) -> SceneSpec:
    """Layout of a task's scenes: what `HighwayReader` gives for the id that it mirrors.

    Args:
        task_id: a key of `HIGHWAY_ENV_OF`.
        config: EnvPool's, with `simulation_frequency` and `policy_frequency`.
        perception_m: how far the ego sees [m]; None takes `SceneSpec`'s default.
        max_agents: rows of a scene, the ego included; None takes `SceneSpec`'s default.

    Raises:
        UserError: a task that is not covered, or numbers that make no spec.
    """
    if task_id not in HIGHWAY_ENV_OF:
        raise UserError(f"no scene reader knows EnvPool's task '{task_id}'; known: {', '.join(HIGHWAY_ENV_OF)}")
    frames = config["simulation_frequency"] // config["policy_frequency"]
    frame = _UNBOUNDED_X if task_id in _STRAIGHT_ROADS else _FIXED_MAP
    spec = SceneSpec(dt_s=float(frames / config["simulation_frequency"]), frame=frame)
    if perception_m is not None:
        spec = replace(spec, perception_m=float(perception_m))
    return spec if max_agents is None else replace(spec, max_agents=int(max_agents))


class PoolIdentity:
    """`IdentityTracker` for many environments in one go: the same costs, pairs and numbers.

    Nearly always each agent's cheapest observation is nobody else's; that is the best pairing then, and one argmin over
    all rows finds it. The rest is paired row by row.

    Args:
        rows: parallel environments.
        gate_m: an agent is not found again at this cost or more [m].
    """

    def __init__(self, rows: int, gate_m: float = GATE_M) -> None:
        """Start with nobody known."""
        self._gate_m = gate_m
        self._next_id = np.zeros(rows, dtype=np.int64)
        self._ids: np.ndarray = np.zeros((rows, 0), dtype=np.int64)
        self._known: np.ndarray = np.zeros((rows, 0), dtype=np.bool_)
        self._place = np.zeros((rows, 0, 2))
        self._motion = np.zeros((rows, 0, 2))

    def reset(self, rows: Int[np.ndarray, " some"]) -> None:
        """Forget everyone in some rows; their numbering starts anew at 0."""
        self._next_id[rows] = 0
        self._known[rows] = False

    def update(
        self,
        place: Float[np.ndarray, "some agents 2"],
        motion: Float[np.ndarray, "some agents 2"],
        present: Bool[np.ndarray, "some agents"],
        rows: Int[np.ndarray, " some"],
        passed_s: Float[np.ndarray, " some"],
    ) -> Int[np.ndarray, "some agents"]:
        """Take in one step of some rows; the number of each agent, -1 where none is present.

        Args:
            place: positions [m].
            motion: velocities [m/s].
            present: which entries hold an agent.
            rows: which environments these are.
            passed_s: time since each row's last update [s]; 0 repeats it.
        """
        if not place.shape[1]:
            return np.zeros(present.shape, dtype=np.int64)
        self._make_room(place.shape[1])
        cost = self._costs(place, motion, present, rows, passed_s)
        first = cost.argmin(axis=2)
        near = np.take_along_axis(cost, first[:, :, None], axis=2)[:, :, 0] < self._gate_m
        found = np.full(present.shape, PADDING_ID, dtype=np.int64)
        some, known = np.nonzero(near)
        found[some, first[some, known]] = self._ids[rows[some], known]
        for i in np.flatnonzero((found != PADDING_ID).sum(axis=1) != near.sum(axis=1)):
            found[i] = PADDING_ID
            agents, seen = best_pairs(cost[i], self._gate_m)
            found[i, seen] = self._ids[rows[i], agents]
        fresh = present & (found == PADDING_ID)
        found[fresh] = (self._next_id[rows, None] + fresh.cumsum(axis=1) - 1)[fresh]
        self._next_id[rows] += fresh.sum(axis=1)
        width = place.shape[1]
        self._known[rows] = False
        self._ids[rows, :width], self._known[rows, :width] = found, present
        self._place[rows, :width], self._motion[rows, :width] = place, motion
        return found

    def _costs(
        self, place: np.ndarray, motion: np.ndarray, present: np.ndarray, rows: np.ndarray, passed_s: np.ndarray
    ) -> Float[np.ndarray, "some known agents"]:
        # Both parts of the cost are differences between something of the old and something of the new alone.
        half_s, weight_s = 0.5 * passed_s[:, None, None], _CHANGE_WEIGHT * passed_s[:, None, None]
        old_motion = self._motion[rows]
        old = np.concatenate([self._place[rows] + old_motion * half_s, old_motion * weight_s], axis=-1)
        new = np.concatenate([place - motion * half_s, motion * weight_s], axis=-1)
        squares = np.zeros((len(rows), old.shape[1], new.shape[1]))
        for column in range(old.shape[-1]):
            squares += np.square(new[:, None, :, column] - old[:, :, None, column])
        squares[~(self._known[rows][:, :, None] & present[:, None])] = np.inf
        return np.sqrt(squares, out=squares)

    def _make_room(self, agents: int) -> None:
        missing = agents - self._ids.shape[1]
        if missing > 0:
            self._ids, self._known = (np.pad(a, ((0, 0), (0, missing))) for a in (self._ids, self._known))
            wide = ((0, 0), (0, missing), (0, 0))
            self._place, self._motion = np.pad(self._place, wide), np.pad(self._motion, wide)


class PoolReader:
    """Reads the scenes of a pool's environments, all rows in one go.

    A row whose clock stands at 0 begins a new episode; reading twice at the same instant changes nothing.

    Args:
        spec: layout of the scenes; its `perception_m` and `max_agents` decide what is perceived.
        rows: environments of the pool.
    """

    def __init__(self, spec: SceneSpec, rows: int) -> None:
        """Know nobody."""
        self.spec = spec
        self._identity = PoolIdentity(rows)
        self._step = np.zeros(rows, dtype=np.int64)

    def reset(self, rows: Int[np.ndarray, " some"]) -> None:
        """Forget all identities of some rows: a new episode has begun."""
        self._identity.reset(rows)
        self._step[rows] = 0

    def read(self, states: Sequence[Any], rows: Int[np.ndarray, " some"]) -> SceneBatch:
        """What each ego perceives, as `envs.readers.base.perceive` has it for one environment.

        Args:
            states: `debug_states()` of these rows.
            rows: which environments these are.
        """
        return perceive_batch(self.read_all(states, rows), self.spec)

    def read_all(self, states: Sequence[Any], rows: Int[np.ndarray, " some"]) -> SceneBatch:
        """Everyone, ego first, padded to the fullest row.

        Raises:
            UserError: a vehicle whose state is not finite.
        """
        kinematics, valid = vehicles_of(states)
        step = np.fromiter(map(attrgetter("elapsed_step"), states), np.int64, len(states))
        self._identity.reset(rows[(step == 0) | (step < self._step[rows])])
        passed_s = np.maximum(step - self._step[rows], 0) * self.spec.dt_s
        self._step[rows] = step
        scenes = np.empty_like(kinematics)
        scenes[..., :2] = kinematics[..., :2]
        np.multiply(kinematics[..., 2], np.cos(kinematics[..., 3]), out=scenes[..., 2])
        np.multiply(kinematics[..., 2], np.sin(kinematics[..., 3]), out=scenes[..., 3])
        ids = np.zeros(valid.shape, dtype=np.int64)
        ids[:, 1:] = 1 + self._identity.update(scenes[:, 1:, :2], scenes[:, 1:, 2:], valid[:, 1:], rows, passed_s)
        ids[~valid] = PADDING_ID
        return SceneBatch(scenes, ids, valid, kinematics[:, 0, 3].copy())


def vehicles_of(
    states: Sequence[Any],
) -> tuple[Float[np.ndarray, "rows agents 4"], Bool[np.ndarray, "rows agents"]]:
    """Position, speed and heading of each vehicle of each environment, ego first, zeros in padded entries.

    Raises:
        UserError: a vehicle whose state is not finite.
    """
    lists = [state.vehicles for state in states]  # each access copies the list out of the simulator
    vehicles = [vehicle for row in lists for vehicle in row]
    counts = np.fromiter(map(len, lists), np.int64, len(lists))
    valid = np.arange(counts.max(initial=0)) < counts[:, None]
    kinematics = np.zeros((*valid.shape, len(_STATE)))
    flat = np.stack([np.fromiter(map(get, vehicles), np.float64, len(vehicles)) for get in _STATE], axis=-1)
    if not np.isfinite(flat).all():
        raise UserError("EnvPool reports a vehicle whose position, speed or heading is not finite; reset the pool")
    kinematics[valid] = flat
    return kinematics, valid


class EnvPoolReader(Reader):
    """Scene reader for one of EnvPool's highway environments (`envs.simulators.envpool.EnvPoolEnv`).

    Args:
        env: the environment; its frequencies give `dt_s`, its task the frame.
        perception_m: how far the ego sees [m]; None takes `SceneSpec`'s default.
        max_agents: rows of a scene, the ego included; None takes `SceneSpec`'s default.

    Raises:
        UserError: not such an environment.
    """

    def __init__(self, env: gym.Env, perception_m: float | None = None, max_agents: int | None = None) -> None:
        """Derive the spec from the environment."""
        if not is_envpool_env(env):
            raise UserError(
                f"EnvPoolReader needs an EnvPoolEnv (envs.simulators.envpool), got {type(env.unwrapped).__name__}"
            )
        native: NativeEnv = env.unwrapped  # type: ignore[assignment]
        super().__init__(native_spec(native.task_id, native.native_config, perception_m, max_agents))
        self._rows = np.zeros(1, dtype=np.int64)
        self._pool = PoolReader(self._spec, 1)

    def reset(self) -> None:
        """Forget all identities; numbering starts anew, so equal seeds give equal ids."""
        self._pool.reset(self._rows)

    def read_all(self, env: gym.Env) -> Scene:
        """Every vehicle on the road, ego first, unpadded: ground truth for collection and evaluation."""
        native: NativeEnv = env.unwrapped  # type: ignore[assignment]
        scenes = self._pool.read_all(native.debug_states(), self._rows)
        return Scene(scenes.states[0], scenes.ids[0], scenes.valid[0], float(scenes.heading_rad[0]))
