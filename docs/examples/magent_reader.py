"""MAgent2 0.3.4's battle on a grid: who stands where, and how far each has just moved.

pip install magent2==0.3.4
"""

from typing import Any

import numpy as np
from magent2.environments import battle_v4
from magent2.environments.magent_env import magent_parallel_env

from dgvae_rl import MultiagentScene, Scene, SceneSpec, pad_multiagent_scene, register_reader


class BattleReader:
    """All that live; a cell is a metre, a step a second, and a velocity the last move."""

    def __init__(self, env: Any) -> None:
        """Say what a scene holds."""
        self.spec = SceneSpec(
            dt_s=1.0, feature_scales=(5.0, 5.0, 1.0, 1.0), has_ego=False, perception_m=8.0,
            max_agents=len(env.possible_agents),
        )  # fmt: skip

    def reset(self) -> None:
        """Forget the last step."""
        self.places: dict[int, np.ndarray] = {}
        self.frame, self.scene = -1, None

    def read(self, env: Any) -> MultiagentScene:
        """Return all that live; within a step, the same scene."""
        battle = env.unwrapped
        if self.scene is None or battle.frames != self.frame:
            self.frame, self.scene = battle.frames, self._read(battle)
        return self.scene

    def _read(self, battle: Any) -> MultiagentScene:
        ids = np.concatenate([battle.env.get_agent_id(handle) for handle in battle.handles]).astype(np.int64)
        places = np.concatenate([battle.env.get_pos(handle) for handle in battle.handles]).astype(float)
        moves = np.array([p - self.places.get(int(i), p) for i, p in zip(ids, places, strict=True)]).reshape(-1, 2)
        self.places = dict(zip(ids.tolist(), places, strict=True))
        scene = Scene(np.hstack([places, moves]), ids, np.ones(len(ids), dtype=bool))
        index_of = {battle.possible_agents[number]: i for i, number in enumerate(ids)}
        return pad_multiagent_scene(scene, index_of, np.arctan2(moves[:, 1], moves[:, 0]), self.spec)


register_reader(magent_parallel_env, BattleReader)


def make_battle(map_size: int = 16, max_cycles: int = 100, **kwargs: Any) -> Any:
    """Makes the environment, for commands: --env-id magent_reader:make_battle."""
    return battle_v4.parallel_env(map_size=map_size, max_cycles=max_cycles, **kwargs)
