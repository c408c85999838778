"""Reads scenes out of EnvPool's C++ highway environments (EnvPool ≥ 1.2.5): of one environment, or of a whole pool.

Reads what a perception system could measure: position, speed and heading. Lanes, routes, driver parameters and the
order of the simulator's list are not used; agents are re-identified between two steps by their motion alone. The ego is
the list's first vehicle. Parking, lane keeping and the multi-agent intersection are not covered.
"""

from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import Any

import gymnasium as gym
import numpy as np
from jaxtyping import Bool, Float, Int

from envs.readers.base import Reader, bounded_spec, perceive_batch, policy_step_s
from envs.readers.identity import best_pairs
from envs.simulators.envpool import HIGHWAY_ENV_OF
from predictor.scene import PADDING_ID, AxisFrame, Scene, SceneBatch, SceneSpec
from predictor.support.errors import UserError

GATE_M = 12.0
"""A vehicle is not found again beyond this cost [m]; docs/envpool.md has what the motion within a step costs."""

_UNBOUNDED_X: tuple[AxisFrame, AxisFrame] = ("ego", "world")
_FIXED_MAP: tuple[AxisFrame, AxisFrame] = ("world", "world")
_STRAIGHT_ROADS = ("Highway-v0", "HighwayFast-v0", "TwoWay-v0")
_CHANGE_WEIGHT = 0.1  # as `IdentityTracker`
_STATE = tuple(map(attrgetter, ("x", "y", "speed", "heading")))


def is_envpool_env(env: gym.Env) -> bool:
    """Returns whether the environment is one of EnvPool's, behind `envs.simulators.envpool.EnvPoolEnv`."""
    inner = env.unwrapped
    return getattr(inner, "task_id", None) in HIGHWAY_ENV_OF and hasattr(inner, "debug_states")


def envpool_spec(
    task_id: str, config: Mapping[str, Any], perception_m: float | None = None, max_agents: int | None = None
) -> SceneSpec:
    """Returns the layout of a task's scenes, equal to `HighwayReader`'s for the highway-env id that it copies.

    Args:
        task_id: a key of `HIGHWAY_ENV_OF`.
        config: EnvPool's settings, with `simulation_frequency` and `policy_frequency` [Hz].
        perception_m: range of the ego's perception [m]; None takes `SceneSpec`'s default.
        max_agents: size of a scene, the ego included; None takes `SceneSpec`'s default.

    Raises:
        UserError: a task that is not covered, or numbers that `SceneSpec` refuses.
    """
    if task_id not in HIGHWAY_ENV_OF:
        raise UserError(f"no scene reader knows EnvPool's task '{task_id}'; known: {', '.join(HIGHWAY_ENV_OF)}")
    frame = _UNBOUNDED_X if task_id in _STRAIGHT_ROADS else _FIXED_MAP
    return bounded_spec(SceneSpec(dt_s=policy_step_s(config), frame=frame), perception_m, max_agents)


class PoolIdentity:
    """Numbers the agents of many environments at once, with the costs, pairs and numbers of `IdentityTracker`.

    If no two agents have the same cheapest observation, taking each agent's cheapest is optimal, and one argmin over
    all environments finds it. The other environments are paired one by one.

    Args:
        envs: number of parallel environments.
        gate_m: an agent is not found again at this cost or more [m].
    """

    def __init__(self, envs: int, gate_m: float = GATE_M) -> None:
        """Starts without known agents."""
        self._gate_m = gate_m
        self._next_id = np.zeros(envs, dtype=np.int64)
        self._ids: np.ndarray = np.zeros((envs, 0), dtype=np.int64)
        self._known: np.ndarray = np.zeros((envs, 0), dtype=np.bool_)
        self._place = np.zeros((envs, 0, 2))
        self._motion = np.zeros((envs, 0, 2))

    def reset(self, envs: Int[np.ndarray, " some"]) -> None:
        """Forgets the agents of some environments; their numbering starts anew at 0."""
        self._next_id[envs] = 0
        self._known[envs] = False

    def update(
        self,
        place: Float[np.ndarray, "some agents 2"],
        motion: Float[np.ndarray, "some agents 2"],
        valid: Bool[np.ndarray, "some agents"],
        envs: Int[np.ndarray, " some"],
        passed_s: Float[np.ndarray, " some"],
    ) -> Int[np.ndarray, "some agents"]:
        """Takes in one step of some environments; returns the number of each agent, -1 where there is none.

        Args:
            place: positions [m].
            motion: velocities [m/s].
            valid: which entries hold an agent.
            envs: index of each of these environments.
            passed_s: time since each environment's last update [s]; 0 repeats it.
        """
        if not place.shape[1]:
            self._known[envs] = False
            return np.zeros(valid.shape, dtype=np.int64)
        self._make_room(place.shape[1])
        cost = self._costs(place, motion, valid, envs, passed_s)
        first = cost.argmin(axis=2)
        near = np.take_along_axis(cost, first[:, :, None], axis=2)[:, :, 0] < self._gate_m
        found = np.full(valid.shape, PADDING_ID, dtype=np.int64)
        some, known = np.nonzero(near)
        found[some, first[some, known]] = self._ids[envs[some], known]
        for i in np.flatnonzero((found != PADDING_ID).sum(axis=1) != near.sum(axis=1)):
            found[i] = PADDING_ID
            agents, seen = best_pairs(cost[i], self._gate_m)
            found[i, seen] = self._ids[envs[i], agents]
        fresh = valid & (found == PADDING_ID)
        found[fresh] = (self._next_id[envs, None] + fresh.cumsum(axis=1) - 1)[fresh]
        self._next_id[envs] += fresh.sum(axis=1)
        width = place.shape[1]
        self._known[envs] = False
        self._ids[envs, :width], self._known[envs, :width] = found, valid
        self._place[envs, :width], self._motion[envs, :width] = place, motion
        return found

    def _costs(
        self, place: np.ndarray, motion: np.ndarray, valid: np.ndarray, envs: np.ndarray, passed_s: np.ndarray
    ) -> Float[np.ndarray, "some known agents"]:
        # Both parts of the cost are differences between a term of the old state and a term of the new one.
        half_s, weight_s = 0.5 * passed_s[:, None, None], _CHANGE_WEIGHT * passed_s[:, None, None]
        old_motion = self._motion[envs]
        old = np.concatenate([self._place[envs] + old_motion * half_s, old_motion * weight_s], axis=-1)
        new = np.concatenate([place - motion * half_s, motion * weight_s], axis=-1)
        squares = np.zeros((len(envs), old.shape[1], new.shape[1]))
        for column in range(old.shape[-1]):
            squares += np.square(new[:, None, :, column] - old[:, :, None, column])
        squares[~(self._known[envs][:, :, None] & valid[:, None])] = np.inf
        return np.sqrt(squares, out=squares)

    def _make_room(self, agents: int) -> None:
        missing = agents - self._ids.shape[1]
        if missing > 0:
            self._ids, self._known = (np.pad(a, ((0, 0), (0, missing))) for a in (self._ids, self._known))
            wide = ((0, 0), (0, missing), (0, 0))
            self._place, self._motion = np.pad(self._place, wide), np.pad(self._motion, wide)


class PoolReader:
    """Reads the scenes of all environments of a pool at once.

    An environment whose clock is at 0 begins a new episode; reading twice at the same instant changes nothing.

    Args:
        spec: layout of the scenes; its `perception_m` and `max_agents` decide what is perceived.
        envs: number of environments of the pool.
    """

    def __init__(self, spec: SceneSpec, envs: int) -> None:
        """Starts without known agents."""
        self.spec = spec
        self._identity = PoolIdentity(envs)
        self._step = np.zeros(envs, dtype=np.int64)

    def reset(self, envs: Int[np.ndarray, " some"]) -> None:
        """Forgets all identities of some environments: a new episode has begun."""
        self._identity.reset(envs)
        self._step[envs] = 0

    def read(self, states: Sequence[Any], envs: Int[np.ndarray, " some"]) -> SceneBatch:
        """Returns what each ego perceives: `envs.readers.base.perceive` for many environments.

        Args:
            states: `debug_states()` of these environments.
            envs: index of each of these environments.
        """
        return perceive_batch(self.read_all(states, envs), self.spec)

    def read_all(self, states: Sequence[Any], envs: Int[np.ndarray, " some"]) -> SceneBatch:
        """Returns all agents, ego first, padded to the fullest scene.

        Raises:
            UserError: a vehicle whose state is not finite.
        """
        kinematics, valid = vehicles_of(states)
        step = np.fromiter(map(attrgetter("elapsed_step"), states), np.int64, len(states))
        self._identity.reset(envs[(step == 0) | (step < self._step[envs])])
        passed_s = np.maximum(step - self._step[envs], 0) * self.spec.dt_s
        self._step[envs] = step
        scenes = np.empty_like(kinematics)
        scenes[..., :2] = kinematics[..., :2]
        np.multiply(kinematics[..., 2], np.cos(kinematics[..., 3]), out=scenes[..., 2])
        np.multiply(kinematics[..., 2], np.sin(kinematics[..., 3]), out=scenes[..., 3])
        ids = np.zeros(valid.shape, dtype=np.int64)
        ids[:, 1:] = 1 + self._identity.update(scenes[:, 1:, :2], scenes[:, 1:, 2:], valid[:, 1:], envs, passed_s)
        ids[~valid] = PADDING_ID
        return SceneBatch(scenes, ids, valid, kinematics[:, 0, 3].copy())


def vehicles_of(
    states: Sequence[Any],
) -> tuple[Float[np.ndarray, "envs agents 4"], Bool[np.ndarray, "envs agents"]]:
    """Returns position, speed and heading of each vehicle of each environment, ego first, zeros in padded entries.

    Raises:
        UserError: a vehicle whose state is not finite.
    """
    lists = [state.vehicles for state in states]  # each access copies the list out of the simulator
    vehicles = [vehicle for listed in lists for vehicle in listed]
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
        perception_m: range of the ego's perception [m]; None takes `SceneSpec`'s default.
        max_agents: size of a scene, the ego included; None takes `SceneSpec`'s default.

    Raises:
        UserError: not such an environment.
    """

    def __init__(self, env: gym.Env, perception_m: float | None = None, max_agents: int | None = None) -> None:
        """Derives the spec from the environment."""
        if not is_envpool_env(env):
            raise UserError(
                f"EnvPoolReader needs an EnvPoolEnv (envs.simulators.envpool), got {type(env.unwrapped).__name__}"
            )
        inner: Any = env.unwrapped
        super().__init__(envpool_spec(inner.task_id, inner.envpool_config, perception_m, max_agents))
        self._env = np.zeros(1, dtype=np.int64)
        self._pool = PoolReader(self._spec, 1)

    def reset(self) -> None:
        """Forgets all identities; numbering starts anew, so equal seeds give equal ids."""
        self._pool.reset(self._env)

    def read_all(self, env: gym.Env) -> Scene:
        """Returns every vehicle on the road, ego first, unpadded: ground truth for collection and evaluation."""
        inner: Any = env.unwrapped
        scenes = self._pool.read_all(inner.debug_states(), self._env)
        return Scene(scenes.states[0], scenes.ids[0], scenes.valid[0], float(scenes.heading_rad[0]))
