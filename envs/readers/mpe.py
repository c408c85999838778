"""Reads scenes out of mpe2, PettingZoo's particle worlds: every agent and, unless left out, every landmark.

All scenarios have one layout, so that a forecaster trained in one runs in another. An agent's identity is the
simulator's own object, never its place in a list. Goals, messages and what an agent carries are not read: they are
not visible in the arena.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from envs.readers.base import MultiagentScene, pad_multiagent_scene
from envs.readers.identity import IdentityDict
from predictor.scene import KINEMATIC_FEATURES, Scene, SceneSpec
from predictor.support.errors import ProtocolError, UserError

MPE_IDS = (
    "simple_v3",
    "simple_spread_v3",
    "simple_tag_v3",
    "simple_adversary_v3",
    "simple_push_v3",
    "simple_world_comm_v3",
    "simple_formation_v1",
    "simple_line_v1",
    "simple_reference_v3",
    "simple_speaker_listener_v4",
    "collect_treasure_v1",
)

MPE_CONSTANTS = ("adversary", "landmark", "radius_m")
"""Visible properties of an entity besides its motion: 1 or 0, 1 or 0, and its size."""

MPE_FEATURES = (*KINEMATIC_FEATURES, *MPE_CONSTANTS)
_SCALES = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.1)
_EVERYTHING_M = 1000.0  # the arena is 2 m wide; it has no walls, but no agent gets this far in an episode


def is_mpe_env(env: Any) -> bool:
    """Returns whether the environment comes from mpe2, without importing it."""
    return any(_module_path(cls)[0] == "mpe2" for cls in type(env.unwrapped).__mro__)


def mpe_scenario(env: Any) -> str:
    """Returns the mpe2 scenario without its version ("simple_tag"); "" for other environments.

    `metadata["name"]` is not used: mpe2's environments share one such dictionary, which names the one made last.
    """
    paths = (_module_path(cls) for cls in type(env.unwrapped).__mro__)
    return next((path[1] for path in paths if path[0] == "mpe2" and path[1] != "_mpe_utils"), "")


def _module_path(cls: type) -> tuple[str, str]:
    parts = [*cls.__module__.split("."), ""]
    return parts[0], parts[1]


def agents_in_sight(env: Any) -> Sequence[str]:
    """Returns names of the agents that are observed: those that live, or all of them after an episode's last step.

    The last observation of an agent shows its last position, although PettingZoo counts no agent as living by then, and
    a wrapper that ends an agent alone does not count it either.

    Raises:
        ProtocolError: before the first reset.
    """
    if getattr(env, "agents", None) is None:
        raise ProtocolError("the environment has no agents yet; call reset() first")
    inside = env.unwrapped
    living: Sequence[str] = inside.agents or inside.possible_agents
    return living


@dataclass(frozen=True)
class _Known:
    number: int
    place: tuple[float, ...] | None
    """Position of an entity that cannot move; None for one that moves."""


class MpeReader:
    """Reads mpe2's parallel environments; no agent is the ego.

    Args:
        env: the environment, wrapped or not; its world gives `dt_s`.
        landmarks: whether to read landmarks (obstacles, goals, treasures), as agents at rest: they explain the others'
            motion. A collected treasure leaves the scene; one that appears elsewhere is a new agent.
        max_agents: size of a scene; None takes the number of entities in the world.
        perception_m: range of an agent's perception [m]; None covers the whole arena and far beyond.

    Raises:
        UserError: not from mpe2, or nothing can move in it (simple_crypto).
    """

    def __init__(
        self, env: Any, landmarks: bool = True, max_agents: int | None = None, perception_m: float | None = None
    ) -> None:
        """Derives the spec from the environment."""
        if not is_mpe_env(env):
            raise UserError(f"MpeReader needs an mpe2 environment, got {type(env.unwrapped).__name__}")
        world = env.unwrapped.world
        if not any(agent.movable for agent in world.agents):
            raise UserError(f"nothing moves in {mpe_scenario(env) or env}, so there is nothing to forecast")
        self.landmarks = landmarks
        self._spec = SceneSpec(
            dt_s=float(world.dt),
            feature_names=MPE_FEATURES,
            feature_scales=_SCALES,
            has_ego=False,
            perception_m=_EVERYTHING_M if perception_m is None else float(perception_m),
            max_agents=len(self._listed(world)) if max_agents is None else int(max_agents),
            constant_features=MPE_CONSTANTS,
        )
        self.reset()

    @property
    def spec(self) -> SceneSpec:
        """Returns the layout of the scenes; ``("world", "world")`` frame: the arena is fixed."""
        return self._spec

    def reset(self) -> None:
        """Forgets all identities; numbers start anew in the order of `world.entities`."""
        self._known: IdentityDict[_Known] = IdentityDict()
        self._next_id = 0

    def read(self, env: Any) -> MultiagentScene:
        """Returns all entities that are present now, at rest or not.

        Raises:
            ProtocolError: before the first reset.
            UserError: more than `max_agents`.
        """
        names = set(agents_in_sight(env))
        world = env.unwrapped.world
        entities = [entity for entity in self._listed(world) if getattr(entity, "alive", True)]
        still = set(map(id, world.landmarks))
        states = np.array([_state(entity, id(entity) in still) for entity in entities], dtype=np.float64)
        ids = np.array([self._identify(entity) for entity in entities], dtype=np.int64)
        indices = {entity.name: i for i, entity in enumerate(entities) if entity.name in names}
        scene = Scene(states, ids, np.ones(len(entities), dtype=np.bool_))
        return pad_multiagent_scene(scene, indices, np.zeros(len(entities)), self._spec, type(self).__name__)

    def body_of(self, env: Any, agent: int) -> Any:
        """Returns the entity with this id, if it is present; None otherwise."""
        present = (entity for entity in self._listed(env.unwrapped.world) if getattr(entity, "alive", True))
        return next((e for e in present if (known := self._known.get(e)) is not None and known.number == agent), None)

    def _listed(self, world: Any) -> list[Any]:
        return list(world.entities if self.landmarks else world.agents)

    def _identify(self, entity: Any) -> int:
        place = None if entity.movable else tuple(float(x) for x in entity.state.p_pos)
        known = self._known.get(entity)
        if known is None or known.place != place:  # an immovable entity at another position is a new one
            known = self._known[entity] = _Known(self._next_id, place)
            self._next_id += 1
        return known.number


def _state(entity: Any, landmark: bool) -> tuple[float, ...]:
    state = entity.state
    adversary = bool(getattr(entity, "adversary", False))
    return (*state.p_pos.tolist(), *state.p_vel.tolist(), float(adversary), float(landmark), entity.size)
