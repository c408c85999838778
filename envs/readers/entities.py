"""Reads scenes out of observations that are tables of entities: `EntityRowsReader`, given the names of the columns.

The observation of many environments is a table with one line per agent, the ego's first (highway-env's Kinematics,
crowds of robots and walkers). Agents that are not in the observation are not in the scene, in collection and evaluation
too. Where the simulator's state is accessible, a `Reader` of your own reads all agents and their identities.
"""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from jaxtyping import Float, Int

from envs.readers.base import Reader
from envs.readers.identity import IdentityTracker
from predictor.scene import Scene, SceneSpec
from predictor.support.errors import ProtocolError, UserError

_KINEMATIC = (("x", "y", "vx", "vy"), ("x", "y", "z", "vx", "vy", "vz"))


@dataclass(frozen=True)
class EntityRowsReader:
    """Makes readers of the env's own observation, a Box of entities × columns, or that table flattened.

        >>> from envs import ForecastObservation, make_env
        >>> columns = ("presence", "x", "y", "vx", "vy")
        >>> observation = {"type": "Kinematics", "features": [*columns], "absolute": True, "normalize": False}
        >>> env = make_env("highway-fast-v0", config={"observation": observation})
        >>> reader = EntityRowsReader(columns, SceneSpec(dt_s=1.0))
        >>> env = ForecastObservation(env, "highway", reader=reader)

    Clipping cannot be undone: switch it off in the environment, or choose bounds that are never reached.
    """

    columns: tuple[str, ...]
    """Content of each column, in order: "x", "y", "vx" and "vy" ("z" and "vz" where the spec has three axes);
    "presence", more than 0.5 where there is an agent; "id"; the heading as "heading" or as "cos_h" and "sin_h", of
    which the ego's is used; further features by their names in the spec. Others ("") are skipped."""
    spec: SceneSpec
    """Layout of the scenes. Features beyond the kinematic ones need a column of that name."""
    gate_m: float = 10.0
    """Without an "id" column: an agent observed at this distance or more from its extrapolated position is a new one
    [m]; see `envs.readers.identity`. The default is for cars at 1 s per step; less where agents are closer."""
    scales: tuple[float, ...] | None = None
    """Value of 1.0 in SI units, for each column of a normalised observation; None: the observation is in SI units."""
    relative: bool = False
    """Whether the lines after the first hold positions and velocities relative to the ego's; axes are the world's."""
    dead_reckoning: bool = False
    """Whether the ego's position is summed up from its velocity, from 0 on, on axes that are not of frame "world": for
    relative observations in which the ego is always at the same place, or leaves the bounds."""
    padding: float | None = None
    """Without a "presence" column: a line of this number alone holds no agent; None if all lines hold one."""
    memory_steps: int = 0
    """Without an "id" column: number of steps for which an agent that is out of sight is remembered."""

    def __post_init__(self) -> None:
        """Checks that columns, scales and spec fit together."""
        named = [name for name in self.columns if name]
        needed = (*_KINEMATIC[self.spec.position_dim - 2], *self.spec.feature_names[2 * self.spec.position_dim :])
        missing = [name for name in needed if name not in named]
        if missing or len(set(named)) != len(named):
            raise UserError(
                f"EntityRowsReader needs each of the columns {', '.join(needed)} once, got {self.columns}; "
                "name columns of no interest ''"
            )
        known = {*needed, "presence", "id", "heading", "cos_h", "sin_h"}
        if unknown := [name for name in named if name not in known]:
            raise UserError(
                f"EntityRowsReader knows no column '{unknown[0]}'; there are {', '.join(sorted(known))}; name "
                "columns of no interest ''"
            )
        if ("cos_h" in named) != ("sin_h" in named) or {"heading", "cos_h"} <= set(named):
            raise UserError(f"the heading is one column 'heading', or 'cos_h' and 'sin_h', got {self.columns}")
        scales = self.scales
        if scales is not None and not (len(scales) == len(self.columns) and np.isfinite(scales).all() and all(scales)):
            raise UserError(f"scales needs one number for each of {len(self.columns)} columns, not 0, got {scales}")
        if self.dead_reckoning and not (self.relative and set(self.spec.frame) != {"world"}):
            raise UserError(
                "dead_reckoning needs relative=True and an axis of another frame than 'world', since it gives no "
                f"position on a map, got relative={self.relative} and frame={self.spec.frame}"
            )

    def __call__(self, env: gym.Env) -> Reader:
        """Returns a reader for this environment.

        Raises:
            UserError: its observation does not have these columns.
        """
        space = env.observation_space
        if not isinstance(space, gym.spaces.Box):
            raise UserError(f"EntityRowsReader needs a Box of entities × columns as observation, got {space}")
        self.table_of(np.zeros(space.shape))
        return _EntityRows(self)

    def table_of(self, observation: Any) -> Float[np.ndarray, "entities columns"]:
        """Returns the table of an observation, in SI units, float64.

        Raises:
            UserError: it does not have these columns.
        """
        table = np.asarray(observation, dtype=np.float64)
        width = len(self.columns)
        fits = table.shape[-1:] == (width,) if table.ndim == 2 else table.ndim == 1 and table.size % width == 0
        if not fits or not table.size:
            raise UserError(
                f"EntityRowsReader needs an observation of entities × {width} columns {self.columns}, or that "
                f"table flattened, got shape {table.shape}"
            )
        return table.reshape(-1, width) * (1.0 if self.scales is None else np.array(self.scales))


class _EntityRows(Reader):
    """Reader that `EntityRowsReader` makes; reads each observation once, in `see`."""

    def __init__(self, config: EntityRowsReader) -> None:
        super().__init__(config.spec)
        self._config = config
        self._column = {name: i for i, name in enumerate(config.columns) if name}
        axes = config.spec.position_dim
        names = (*_KINEMATIC[axes - 2], *config.spec.feature_names[2 * axes :])
        self._state = [self._column[name] for name in names]
        self._constant = [config.spec.feature_names.index(name) for name in config.spec.constant_features]
        self._reckoned = np.flatnonzero([frame != "world" for frame in config.spec.frame])
        self._tracker = IdentityTracker(config.spec.dt_s, config.gate_m, config.memory_steps)
        self.reset()

    def reset(self) -> None:
        self._tracker.reset()
        self._ego_m: np.ndarray | None = None
        self._ego_mps: np.ndarray = np.zeros(self.spec.position_dim)
        self._scene: Scene | None = None

    def read_all(self, env: Any) -> Scene:
        if self._scene is None:
            raise ProtocolError("EntityRowsReader has seen no observation of this episode; call see(observation) first")
        return self._scene

    def see(self, observation: Any) -> None:
        table = self._config.table_of(observation)
        table = table[self._valid(table)]
        if not np.isfinite(table).all():
            raise UserError(f"EntityRowsReader: the observation must be finite, got {table.tolist()}")
        states = table[:, self._state]
        self._restore(states)
        self._scene = Scene(
            states, self._identify(table, states), np.ones(len(table), np.bool_), self._heading(table[0])
        )

    def _valid(self, table: Float[np.ndarray, "entities columns"]) -> np.ndarray:
        valid = np.ones(len(table), dtype=np.bool_)
        if "presence" in self._column:
            valid = table[:, self._column["presence"]] > 0.5
            if not valid[0]:
                raise UserError("EntityRowsReader: the first line must hold the ego, but its presence is 0")
        elif self._config.padding is not None:
            scales = 1.0 if self._config.scales is None else np.array(self._config.scales)
            valid[1:] = ~np.isclose(table[1:], self._config.padding * scales, rtol=1e-6, atol=0.0).all(axis=1)
        return valid

    def _restore(self, states: Float[np.ndarray, "agents state"]) -> None:
        """Converts positions and velocities to world coordinates, in place."""
        axes = self.spec.position_dim
        if self._config.dead_reckoning:
            velocity = states[0, axes : 2 * axes].copy()
            passed = 0.5 * (self._ego_mps + velocity) * self.spec.dt_s
            self._ego_m = np.zeros(axes) if self._ego_m is None else self._ego_m + passed
            self._ego_mps = velocity
            states[0, self._reckoned] = self._ego_m[self._reckoned]
        if self._config.relative:
            states[1:, : 2 * axes] += states[0, : 2 * axes]

    def _identify(
        self, table: Float[np.ndarray, "agents columns"], states: Float[np.ndarray, "agents state"]
    ) -> Int[np.ndarray, " agents"]:
        if "id" in self._column:
            given = table[:, self._column["id"]]
            ids = np.rint(given)
            if (np.abs(given - ids) > 1e-3).any():
                raise UserError(f"EntityRowsReader: ids must be whole numbers, got {given.tolist()}")
            return ids.astype(np.int64)
        axes = self.spec.position_dim
        others, keys = states[1:], states[1:, self._constant]
        found = self._tracker.update(others[:, :axes], others[:, axes : 2 * axes], keys=keys)
        return np.concatenate([np.zeros(1, dtype=np.int64), found + 1])  # the ego's id is always 0

    def _heading(self, ego: Float[np.ndarray, " columns"]) -> float:
        if "heading" in self._column:
            return float(ego[self._column["heading"]])
        if "cos_h" in self._column:
            return float(np.arctan2(ego[self._column["sin_h"]], ego[self._column["cos_h"]]))
        return 0.0
