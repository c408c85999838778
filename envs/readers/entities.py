"""Reads scenes out of observations whose rows are entities: `EntityRowsReader`, given the names of the columns.

Many environments show a table of agents, row 0 the ego (highway-env's Kinematics, crowds of robots and walkers). What
is not in the observation is not in the scene: collection and evaluation then also know only what the ego saw. Where the
environment itself can be asked, a `Reader` of its own sees more and knows its agents' names.
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
_HEADINGS = ("heading", "cos_h", "sin_h")


@dataclass(frozen=True)
class EntityRowsReader:
    """Makes readers of the env's own observation, a Box of entities × columns (or the same as one row of numbers).

        >>> from envs import ForecastObservation, make_env
        >>> columns = ("presence", "x", "y", "vx", "vy")
        >>> observation = {"type": "Kinematics", "features": [*columns], "absolute": True, "normalize": False}
        >>> env = make_env("highway-fast-v0", config={"observation": observation})
        >>> reader = EntityRowsReader(columns, SceneSpec(dt_s=1.0))
        >>> env = ForecastObservation(env, "highway", reader=reader)

    An observation that is clipped cannot be undone: take it without, or with bounds that are never met.
    """

    columns: tuple[str, ...]
    """What each column holds, in order: "x", "y", "vx" and "vy" ("z" and "vz" where the spec has three axes);
    "presence", more than 0.5 where there is an agent; "id"; the heading as "heading" or as "cos_h" and "sin_h", of
    which the ego's is used; further features by their names in the spec. Others ("") are skipped."""
    spec: SceneSpec
    """Layout of the scenes. Features beyond the kinematic ones need a column of that name."""
    gate_m: float = 10.0
    """Without an "id" column: an agent found at this distance or more from where its motion led is a new one [m]; see
    `envs.readers.identity`. The default is for cars at 1 s per step; less where agents are closer."""
    scales: tuple[float, ...] | None = None
    """What 1.0 is in SI units, for each column, where the observation is normalised; None takes SI units."""
    relative: bool = False
    """Whether the rows after the first hold positions and velocities relative to the ego's; axes are the world's."""
    dead_reckoning: bool = False
    """Whether the ego's position is summed up from its velocity, from 0 on, on axes that are not of frame "world": for
    relative observations in which the ego is always at the same place, or leaves the bounds."""
    padding: float | None = None
    """Without a "presence" column: a row with nothing but this number holds no agent; None if every row holds one."""
    memory_steps: int = 0
    """Without an "id" column: for how many steps an agent that is out of sight is remembered."""

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
        if ("cos_h" in named) != ("sin_h" in named) or {"heading", "cos_h"} <= set(named):
            raise UserError(f"the heading is one column 'heading', or 'cos_h' and 'sin_h', got {self.columns}")
        scales = self.scales
        if scales is not None and not (len(scales) == len(self.columns) and np.isfinite(scales).all() and all(scales)):
            raise UserError(f"scales needs one number for each of {len(self.columns)} columns, not 0, got {scales}")
        if self.dead_reckoning and not (self.relative and set(self.spec.frame) != {"world"}):
            raise UserError(
                "dead_reckoning needs relative=True and an axis of another frame than 'world', since it knows no place "
                f"on a map, got relative={self.relative} and frame={self.spec.frame}"
            )

    def __call__(self, env: gym.Env) -> Reader:
        """Returns a reader for this environment.

        Raises:
            UserError: its observation does not have these columns.
        """
        space = env.observation_space
        if not isinstance(space, gym.spaces.Box):
            raise UserError(f"EntityRowsReader needs a Box of entities × columns as observation, got {space}")
        self.rows_of(np.zeros(space.shape))
        return _EntityRows(self)

    def rows_of(self, observation: Any) -> Float[np.ndarray, "entities columns"]:
        """Returns the table of an observation, in SI units, float64.

        Raises:
            UserError: it does not have these columns.
        """
        table = np.asarray(observation, dtype=np.float64)
        width = len(self.columns)
        fits = table.shape[-1:] == (width,) if table.ndim == 2 else table.ndim == 1 and table.size % width == 0
        if not fits or not table.size:
            raise UserError(
                f"EntityRowsReader needs an observation of entities × {width} columns {self.columns}, or the same in "
                f"one row, got shape {table.shape}"
            )
        return table.reshape(-1, width) * (1.0 if self.scales is None else np.array(self.scales))


class _EntityRows(Reader):
    """Reader that `EntityRowsReader` makes; the work is done once per observation, in `see`."""

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
        rows = self._config.rows_of(observation)
        rows = rows[self._present(rows)]
        if not np.isfinite(rows).all():
            raise UserError(f"EntityRowsReader: the observation must be finite, got {rows.tolist()}")
        states = rows[:, self._state]
        self._restore(states)
        self._scene = Scene(states, self._identify(rows, states), np.ones(len(rows), np.bool_), self._heading(rows[0]))

    def _present(self, rows: Float[np.ndarray, "entities columns"]) -> np.ndarray:
        present = np.ones(len(rows), dtype=np.bool_)
        if "presence" in self._column:
            present = rows[:, self._column["presence"]] > 0.5
            if not present[0]:
                raise UserError("EntityRowsReader: row 0 must hold the ego, but its presence is 0")
        elif self._config.padding is not None:
            scales = 1.0 if self._config.scales is None else np.array(self._config.scales)
            present[1:] = (rows[1:] != self._config.padding * scales).any(axis=1)
        return present

    def _restore(self, states: Float[np.ndarray, "agents state"]) -> None:
        """Makes positions and velocities those of the world, in place."""
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
        self, rows: Float[np.ndarray, "agents columns"], states: Float[np.ndarray, "agents state"]
    ) -> Int[np.ndarray, " agents"]:
        if "id" in self._column:
            given = rows[:, self._column["id"]]
            ids = np.rint(given)
            if (np.abs(given - ids) > 1e-3).any():
                raise UserError(f"EntityRowsReader: ids must be whole numbers, got {given.tolist()}")
            return ids.astype(np.int64)
        axes = self.spec.position_dim
        others, keys = states[1:], states[1:, self._constant]
        found = self._tracker.update(others[:, :axes], others[:, axes : 2 * axes], keys=keys)
        return np.concatenate([np.zeros(1, dtype=np.int64), found + 1])  # the ego is 0, whatever it does

    def _heading(self, ego: Float[np.ndarray, " columns"]) -> float:
        if "heading" in self._column:
            return float(ego[self._column["heading"]])
        if "cos_h" in self._column:
            return float(np.arctan2(ego[self._column["sin_h"]], ego[self._column["cos_h"]]))
        return 0.0
