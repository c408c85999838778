"""Reads scenes out of highway-env: positions, velocities and identities of the vehicles around the ego.

A vehicle's identity is the simulator's own object, never its place in a list: highway-env sorts and filters its lists.
Reads what a perception system could measure: vehicles within `perception_m`, the nearest `max_agents`; no routes, no
driver parameters.
"""

from collections.abc import Sequence

import gymnasium as gym
import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.vehicle.kinematics import Vehicle

from envs.readers.base import Reader, bounded_spec, policy_step_s
from envs.readers.identity import IdentityDict
from predictor.scene import KINEMATIC_FEATURES, AxisFrame, Scene, SceneSpec
from predictor.support.errors import ProtocolError, UserError

# Straight roads without end: x is relative to the ego, y (the lane) is the map. All other ids have a fixed map.
_UNBOUNDED_X: tuple[AxisFrame, AxisFrame] = ("ego", "world")
_FIXED_MAP: tuple[AxisFrame, AxisFrame] = ("world", "world")
_FRAMES: dict[str, tuple[AxisFrame, AxisFrame]] = {
    "highway-v0": _UNBOUNDED_X,
    "highway-fast-v0": _UNBOUNDED_X,
    "two-way-v0": _UNBOUNDED_X,
    "highway-mixed-v0": _UNBOUNDED_X,
    "highway-mixed-costly-v0": _UNBOUNDED_X,
}


def is_highway_env(env: gym.Env) -> bool:
    """Returns whether the environment comes from highway-env."""
    return isinstance(env.unwrapped, AbstractEnv)


def vehicles_of(env: gym.Env) -> list[Vehicle]:
    """Returns every vehicle on the road, ego first, in the order of `HighwayReader.read_all`.

    Raises:
        ProtocolError: before the first reset.
    """
    road, ego = env.unwrapped.road, env.unwrapped.vehicle  # type: ignore[attr-defined]
    if road is None or ego is None:
        raise ProtocolError("the environment has no vehicles yet; call reset() first")
    return [ego] + [v for v in road.vehicles if v is not ego]


class HighwayReader(Reader):
    """Scene reader for single-ego highway-env environments (highway-env ≥ 1.12).

    Args:
        env: the environment; its `policy_frequency` gives `dt_s`, its id the frame.
        perception_m: range of the ego's perception [m]; None takes `SceneSpec`'s default.
        max_agents: size of a scene, the ego included; None takes `SceneSpec`'s default.
    """

    def __init__(self, env: gym.Env, perception_m: float | None = None, max_agents: int | None = None) -> None:
        """Derives the spec from the environment."""
        if not is_highway_env(env):
            raise UserError(f"HighwayReader needs a highway-env environment, got {env.unwrapped.__class__.__name__}")
        config = env.unwrapped.config  # type: ignore[attr-defined]
        env_id = env.unwrapped.spec.id if env.unwrapped.spec is not None else ""
        spec = SceneSpec(dt_s=policy_step_s(config), frame=_FRAMES.get(env_id, _FIXED_MAP))
        super().__init__(bounded_spec(spec, perception_m, max_agents))
        self.reset()

    def reset(self) -> None:
        """Forgets all identities; numbering starts anew, so equal seeds give equal ids."""
        self._ids: IdentityDict[int] = IdentityDict()
        self._next_id = 0
        self._read_at_s: float | None = None

    def read(self, env: gym.Env) -> Scene:
        """Returns what the ego perceives, padded to `max_agents`.

        Raises:
            UserError: since the scene before, neither a time step has passed nor none, or a new episode began.
        """
        now_s = float(env.unwrapped.time)  # type: ignore[attr-defined]
        passed_s = now_s - (now_s if self._read_at_s is None else self._read_at_s)
        # what highway-env's clock counts for a step, also where it simulates less (`policy_step_s`)
        step_s = 1.0 / env.unwrapped.config["policy_frequency"]  # type: ignore[attr-defined]
        if passed_s < -1e-6:
            raise UserError(
                "an episode began that the wrapper with the reader did not see, so that the history of one would leak "
                "into the next; call its reset(), and put a wrapper that resets by itself around it, not inside"
            )
        if min(abs(passed_s), abs(passed_s - step_s)) > 1e-6 * max(1.0, now_s):
            raise UserError(
                f"the env was wrapped at dt_s={self._spec.dt_s:g} but {passed_s:g} s passed between two scenes; put a "
                "wrapper that repeats steps around this one, not inside, or set policy_frequency instead"
            )
        self._read_at_s = now_s
        return super().read(env)

    def read_all(self, env: gym.Env) -> Scene:
        """Returns every vehicle on the road, ego first, unpadded: ground truth for collection and evaluation."""
        return self.read_vehicles(env, vehicles_of(env))

    def read_vehicles(self, env: gym.Env, vehicles: Sequence[Vehicle]) -> Scene:
        """Returns a scene of these vehicles of the environment; the heading is the first one's.

        Raises:
            UserError: the environment's time step is no longer the one of the spec.
        """
        dt_s = policy_step_s(env.unwrapped.config)  # type: ignore[attr-defined]
        if dt_s != self._spec.dt_s:
            raise UserError(
                f"the env was wrapped at dt_s={self._spec.dt_s:g} but now steps at dt_s={dt_s:g}; "
                "pass its config to gym.make, not to reset"
            )
        speed_mps = np.array([v.speed for v in vehicles], dtype=np.float64)
        headings_rad = np.array([v.heading for v in vehicles], dtype=np.float64)
        states = np.empty((len(vehicles), len(KINEMATIC_FEATURES)))
        states[:, :2] = np.array([v.position for v in vehicles]).reshape(-1, 2)
        states[:, 2] = speed_mps * np.cos(headings_rad)
        states[:, 3] = speed_mps * np.sin(headings_rad)
        ids = np.array([self._identify(v) for v in vehicles], dtype=np.int64)
        heading_rad = float(vehicles[0].heading) if len(vehicles) else 0.0
        return Scene(states, ids, np.ones(len(vehicles), dtype=np.bool_), heading_rad)

    def body_of(self, env: gym.Env, agent: int) -> Vehicle | None:
        """Returns the vehicle on the road with this id; None if there is none."""
        present = env.unwrapped.road.vehicles  # type: ignore[attr-defined]
        return next((vehicle for vehicle in present if self._ids.get(vehicle) == agent), None)

    def _identify(self, vehicle: Vehicle) -> int:
        number = self._ids.get(vehicle)
        if number is None:
            number = self._ids[vehicle] = self._next_id
            self._next_id += 1
        return number
