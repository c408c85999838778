"""Reads scenes out of PettingZoo's pursuit: pursuers, and the evaders that are not caught yet, on their grid.

A cell counts as one metre and a step as one second, since the grid has no units. Velocities are differences of
positions, since the grid has none. The other SISL environment, multiwalker, is not read.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from envs.readers.base import MultiagentScene, pad_multiagent_scene
from envs.readers.identity import IdentityDict
from envs.readers.mpe import agents_in_sight
from predictor.scene import KINEMATIC_FEATURES, Scene, SceneSpec
from predictor.support.errors import UserError

PURSUIT_FEATURES = (*KINEMATIC_FEATURES, "evader")
"""Motion in cells and cells per step, and 1 for an evader, 0 for a pursuer."""
_SCALES = (10.0, 10.0, 1.0, 1.0, 1.0)


def is_pursuit_env(env: Any) -> bool:
    """Returns whether the environment is PettingZoo's pursuit."""
    return any(cls.__module__ == "pettingzoo.sisl.pursuit.pursuit" for cls in type(env.unwrapped).__mro__)


@dataclass
class _Track:
    """Body on the grid, as of the last step at which it was read."""

    number: int
    frame: int
    position: Float[np.ndarray, " axes"]
    velocity: Float[np.ndarray, " axes"]


class PursuitReader:
    """Reads pursuit's parallel environment; no agent is the ego, and only pursuers are learners.

    A caught evader is missing from the next scene on; its id is not used again.

    Args:
        env: the environment, wrapped or not.
        max_agents: size of a scene; None takes the number of pursuers and evaders at the start.
        perception_m: range of an agent's perception [cells]; None covers the whole grid, which is more than pursuit's
            own observations show (`obs_range`).

    Raises:
        UserError: not pursuit.
    """

    def __init__(self, env: Any, max_agents: int | None = None, perception_m: float | None = None) -> None:
        """Derives the spec from the environment."""
        if not is_pursuit_env(env):
            raise UserError(f"PursuitReader needs PettingZoo's pursuit, got {type(env.unwrapped).__name__}")
        grid = env.unwrapped.env
        self._spec = SceneSpec(
            dt_s=1.0,
            feature_names=PURSUIT_FEATURES,
            feature_scales=_SCALES,
            has_ego=False,
            perception_m=float(np.hypot(grid.x_size, grid.y_size)) if perception_m is None else float(perception_m),
            max_agents=grid.n_pursuers + grid.n_evaders if max_agents is None else int(max_agents),
            constant_features=("evader",),
        )
        self.reset()

    @property
    def spec(self) -> SceneSpec:
        """Returns the layout of the scenes; ``("world", "world")`` frame: the walls stay."""
        return self._spec

    def reset(self) -> None:
        """Forgets all identities and positions."""
        self._tracks: IdentityDict[_Track] = IdentityDict()
        self._next_id = 0

    def read(self, env: Any) -> MultiagentScene:
        """Returns all bodies on the grid; reading twice at a step gives the same scene.

        Velocities [cells/step] are zero when a body is first read, and means over the steps since it was last read.

        Raises:
            ProtocolError: before the first reset.
            UserError: more than `max_agents`.
        """
        names = set(agents_in_sight(env))
        unwrapped = env.unwrapped
        pursuers, evaders = unwrapped.env.pursuer_layer.allies, unwrapped.env.evader_layer.allies
        bodies = [*pursuers, *evaders]
        tracks = [self._follow(body, unwrapped.env.frames) for body in bodies]
        states = np.zeros((len(bodies), len(PURSUIT_FEATURES)))
        for i, track in enumerate(tracks):
            states[i] = (*track.position, *track.velocity, float(i >= len(pursuers)))
        ids = np.array([track.number for track in tracks], dtype=np.int64)
        indices = {name: i for name, i in unwrapped.agent_name_mapping.items() if name in names}
        scene = Scene(states, ids, np.ones(len(bodies), dtype=np.bool_))
        return pad_multiagent_scene(scene, indices, np.zeros(len(bodies)), self._spec, type(self).__name__)

    def _follow(self, body: Any, frame: int) -> _Track:
        position = np.array(body.current_position(), dtype=np.float64)  # a copy: the grid moves bodies in place
        track = self._tracks.get(body)
        if track is None:
            track = self._tracks[body] = _Track(self._next_id, frame, position, np.zeros(2))
            self._next_id += 1
        elif track.frame != frame:
            track.velocity = (position - track.position) / (frame - track.frame)
            track.frame, track.position = frame, position
        return track
