"""Drivers of all agents of a PettingZoo parallel environment in data collection and evaluation.

Every agent draws its own habits anew in each episode, from a random stream of its own that is independent of the
environment's (`envs.seeding`): the start of an episode carries no information on the habits, only an agent's history
does. Heuristics use the simulator's state; recordings hold only what a scene reader reads. Drivers are partials
and bound methods, not closures: `copy.deepcopy` of a running world copies their state too.
"""

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from jaxtyping import Float

from envs.drivers.own import OwnDriver
from envs.readers import multiagent_env_id
from envs.readers.mpe import mpe_scenario
from envs.readers.pursuit import is_pursuit_env
from envs.sampled_actions import first_action, uniform_action, varied_actions
from predictor.own_forecasters import is_own
from predictor.support.errors import UserError

Driver = Callable[[Mapping[str, Any]], dict[str, Any]]
"""Maps the observations of a step, of all agents or of some, to actions of those that live."""

AgentDriver = Callable[[Any], Any]
"""Maps one agent's observation to its action."""

DrawAgentDriver = Callable[[str, np.random.Generator], AgentDriver]
"""Maps an agent's name and a generator of its own to its driver for one episode."""

WHO = "drivers"
DRIVER_NAMES = ("random", "idle", "varied", "heuristic", "mixed")

_PURSUIT_STAY = 4
_PURSUIT_STEPS = np.array([(-1, 0), (1, 0), (0, 1), (0, -1), (0, 0)])
_PUSHES = np.array([(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)], dtype=np.float64)  # mpe2's five discrete actions
_DEFAULT_ACCEL = 5.0  # mpe2's sensitivity where an agent has no `accel`
_NEAR_M = 0.1  # an agent this close to its place has reached it
_WALL_M = 0.7  # from here on, prey is driven back to the middle; the arena ends at 1


def make_driver(name: str, env: Any, rng: np.random.Generator) -> Driver:
    """Returns a driver of all agents, for one episode.

    Args:
        name: "random" (uniform actions), "idle" (no action), "varied" (each agent draws its preferences and how long
            a choice is kept), "heuristic" (each agent pursues what its scenario rewards, with its own `Habits`;
            mpe2 and pursuit only), "mixed" (each agent is one of random, varied and, where there is one,
            heuristic), or one of a user's own ("own:module:function", `envs.drivers.own`).
        env: the parallel environment that will be driven, wrapped or not; need not be reset yet.
        rng: source of all randomness of this episode.

    Raises:
        UserError: unknown name, no heuristic for this environment, or an action space that `uniform_action` does not
            draw from.
    """
    if is_own(name):
        return OwnDriver(name, env, rng)
    for agent in getattr(env, "possible_agents", ()):
        uniform_action(env.action_space(agent), np.random.default_rng(0), WHO)
    return partial(_drive, env, rng, _agent_drivers(name, env, rng), {})


def _drive(
    env: Any,
    rng: np.random.Generator,
    draw: DrawAgentDriver,
    drivers: dict[str, AgentDriver],
    observations: Mapping[str, Any],
) -> dict[str, Any]:
    living = set(env.agents)
    for agent in observations:
        if agent in living and agent not in drivers:
            drivers[agent] = draw(agent, rng.spawn(1)[0])
    return {agent: drivers[agent](seen) for agent, seen in observations.items() if agent in living}


def _agent_drivers(name: str, env: Any, rng: np.random.Generator) -> DrawAgentDriver:
    """Returns the function that makes the driver of an agent; `rng` is for the agents' common decisions."""
    if name in ("random", "idle", "varied"):
        return partial(_draw, name, env)
    if name == "heuristic":
        return _heuristic(env, rng)
    if name == "mixed":
        kinds = ("random", "varied", "heuristic") if has_heuristic(env) else ("random", "varied")
        return partial(_draw_any, [_agent_drivers(kind, env, rng) for kind in kinds])
    raise UserError(f"driver must be one of {', '.join(DRIVER_NAMES)} or own:module:function, got '{name}'")


def _draw(name: str, env: Any, agent: str, own: np.random.Generator) -> AgentDriver:
    if name == "varied":
        return varied_actions(env.action_space(agent), own, WHO)
    return partial(_idle, env, agent) if name == "idle" else partial(_random, env.action_space(agent), own)


def _random(space: gym.Space, own: np.random.Generator, seen: Any) -> Any:
    return uniform_action(space, own, WHO)


def _idle(env: Any, agent: str, seen: Any) -> Any:
    return idle_action(env, agent)


def _draw_any(draws: list[DrawAgentDriver], agent: str, own: np.random.Generator) -> AgentDriver:
    return draws[own.integers(len(draws))](agent, own)


def idle_action(env: Any, agent: str) -> Any:
    """Returns the action that changes nothing: of the env's own `idle_action(agent)`, of its family, or zeros."""
    own = getattr(env.unwrapped, "idle_action", None)
    if own is not None:
        return own(agent)
    first = first_action(env.action_space(agent))
    return first + _PURSUIT_STAY if is_pursuit_env(env) else first


@dataclass(frozen=True)
class Habits:
    """Skill and manner of driving of one agent in one episode."""

    attention: float
    """Probability of a new decision at a step; otherwise the last action is repeated."""
    slip: float
    """Probability of a random action instead of the intended one."""
    lead_s: float
    """Time over which it extrapolates the others with constant velocity [s]."""
    pace: float
    """Share of its top speed that it uses."""
    lean_rad: float
    """Angle between its course and the straight line to its target [rad]."""

    @staticmethod
    def draw(rng: np.random.Generator) -> "Habits":
        """Draws the habits of one agent."""
        return Habits(
            attention=float(rng.uniform(0.5, 1.0)),
            slip=float(rng.uniform(0.0, 0.1)),
            lead_s=float(rng.uniform(0.0, 0.6)),
            pace=float(rng.uniform(0.5, 1.0)),
            lean_rad=float(rng.normal(0.0, 0.3)),
        )


def has_heuristic(env: Any) -> bool:
    """Returns whether the driver "heuristic" knows this environment."""
    return is_pursuit_env(env) or mpe_scenario(env) in _AIMS


def _heuristic(env: Any, rng: np.random.Generator) -> DrawAgentDriver:
    if not has_heuristic(env):
        raise UserError(
            f"no heuristic drives {multiagent_env_id(env)}, only pursuit and mpe2's {', '.join(_AIMS)}; use "
            + ", ".join(name for name in DRIVER_NAMES if name != "heuristic")
        )
    family = _PursuitIntentions(env) if is_pursuit_env(env) else _MpeIntentions(env, rng)

    return partial(_draw_heuristic, env, family)


def _draw_heuristic(env: Any, family: Any, agent: str, own: np.random.Generator) -> AgentDriver:
    habits = Habits.draw(own)
    return partial(_choose, env.action_space(agent), own, habits, family.of(agent, habits, own), [])


def _choose(
    space: gym.Space,
    own: np.random.Generator,
    habits: Habits,
    intend: Callable[[], Any],
    last: list[Any],
    seen: Any,
) -> Any:
    if not last or own.random() < habits.attention:
        last[:] = [uniform_action(space, own, WHO) if own.random() < habits.slip else intend()]
    return copy.deepcopy(last[0])  # an environment may change the action it is given


class _PursuitIntentions:
    """Makes each pursuer head for its preferred side of the nearest evader, along its preferred axis first."""

    def __init__(self, env: Any) -> None:
        self._env = env.unwrapped

    def of(self, agent: str, habits: Habits, rng: np.random.Generator) -> Callable[[], int]:
        index = self._env.agent_name_mapping[agent]
        side = _PURSUIT_STEPS[rng.integers(4)]
        axes = rng.permutation([1.0, 1.01])  # breaks ties between the two axes
        return partial(self._intend, index, side, axes)

    def _intend(self, index: int, side: np.ndarray, axes: np.ndarray) -> int:
        grid = self._env.env
        if not grid.evader_layer.allies:
            return _PURSUIT_STAY
        here = np.array(grid.pursuer_layer.get_position(index))
        evaders = np.array([evader.current_position() for evader in grid.evader_layer.allies])
        target = evaders[np.abs(evaders - here).sum(axis=1).argmin()] + side
        distance = (np.abs(here + _PURSUIT_STEPS - target) * axes).sum(axis=1)
        free = [self._free(grid, cell) for cell in here + _PURSUIT_STEPS]
        return int(np.where(free, distance, np.inf).argmin())

    @staticmethod
    def _free(grid: Any, cell: np.ndarray) -> bool:
        inside = 0 <= cell[0] < grid.x_size and 0 <= cell[1] < grid.y_size
        return bool(inside and grid.map_matrix[cell[0], cell[1]] != -1)


class _MpeIntentions:
    """Makes each agent push so that its velocity comes closest to the target velocity of its scenario's aim."""

    def __init__(self, env: Any, rng: np.random.Generator) -> None:
        self.env = env.unwrapped
        self.world = self.env.world
        self.rng = rng
        self._aim = _AIMS[mpe_scenario(env)]
        self._places: dict[str, Float[np.ndarray, " axes"]] = {}
        self._new_round_at = 0

    def of(self, agent: str, habits: Habits, rng: np.random.Generator) -> Callable[[], Any]:
        body = next(body for body in self.world.agents if body.name == agent)
        word = 0 if body.silent else int(rng.integers(self.world.dim_c))
        return partial(self._intend, body, habits, word)

    def _intend(self, body: Any, habits: Habits, word: int) -> Any:
        velocity = self._aim(self, body, habits) if body.movable else np.zeros(2)
        act = self._continuous if self.env.continuous_actions else self._discrete
        return act(body, velocity, word)

    def _discrete(self, body: Any, velocity: Float[np.ndarray, " axes"], word: int) -> int:
        if not body.movable:
            return word
        after = self._coasting(body) + _PUSHES * self._push_mps(body)  # of these five velocities, the closest
        return int(np.linalg.norm(after - velocity, axis=1).argmin()) + len(_PUSHES) * word

    def _continuous(self, body: Any, velocity: Float[np.ndarray, " axes"], word: int) -> Float[np.ndarray, " action"]:
        push = np.clip((velocity - self._coasting(body)) / self._push_mps(body), -1.0, 1.0)
        moves = [0.0, max(-push[0], 0), max(push[0], 0), max(-push[1], 0), max(push[1], 0)] if body.movable else []
        words = [] if body.silent else [float(i == word) for i in range(self.world.dim_c)]
        return np.array(moves + words, dtype=np.float32)

    def _coasting(self, body: Any) -> Float[np.ndarray, " axes"]:
        """Returns its velocity after the next step without a push."""
        velocity: np.ndarray = body.state.p_vel * (1 - self.world.damping)
        return velocity

    def _push_mps(self, body: Any) -> float:
        """Returns the change of its velocity by a full push in one step [m/s]."""
        return float((body.accel or _DEFAULT_ACCEL) / body.mass * self.world.dt)

    def cruise_mps(self, body: Any, habits: Habits) -> float:
        terminal = self._push_mps(body) / self.world.damping
        return habits.pace * min(terminal, body.max_speed or np.inf)

    def towards(self, body: Any, target: np.ndarray, habits: Habits, brake: bool = True) -> np.ndarray:
        """Returns the velocity that leads to a place; with `brake`, slower near it, to stop there."""
        gap = target - body.state.p_pos
        distance_m = float(np.linalg.norm(gap))
        cos, sin = np.cos(habits.lean_rad), np.sin(habits.lean_rad)
        way = np.array([cos * gap[0] - sin * gap[1], sin * gap[0] + cos * gap[1]])
        speed = self.cruise_mps(body, habits)
        if brake:  # damping alone stops an agent after v·dt / damping
            speed = min(speed, distance_m * self.world.damping / self.world.dt)
        return way * (speed / max(distance_m, 1e-6))

    def place(self, body: Any, bodies: list[Any], places: np.ndarray) -> np.ndarray:
        """Returns the agent's place: nearest pairs first; drawn anew when all places are reached, or after a while."""
        here = np.array([b.state.p_pos for b in bodies])
        if not self._places:
            self._assign(bodies, places, _nearest_pairs(here, places))
        there = all(np.linalg.norm(b.state.p_pos - self._places[b.name]) < _NEAR_M for b in bodies)
        if there or self.env.steps >= self._new_round_at:
            self._assign(bodies, places, self.rng.permutation(len(places)))
        return self._places[body.name]

    def _assign(self, bodies: list[Any], places: np.ndarray, order: np.ndarray) -> None:
        self._places = {b.name: places[order[i % len(order)]] for i, b in enumerate(bodies)}
        self._new_round_at = self.env.steps + int(self.rng.integers(20, 41))


def _nearest_pairs(here: Float[np.ndarray, "agents axes"], places: Float[np.ndarray, "places axes"]) -> np.ndarray:
    """Returns the place of each agent: the nearest pair first, then the nearest of the rest."""
    distance = np.linalg.norm(here[:, None] - places[None], axis=-1)
    order = np.arange(len(here)) % len(places)
    for _ in range(min(distance.shape)):
        agent, place = np.unravel_index(distance.argmin(), distance.shape)
        order[agent] = place
        distance[agent], distance[:, place] = np.inf, np.inf
    return order


def _of_role(world: Any, adversary: bool) -> list[Any]:
    return [body for body in world.agents if bool(getattr(body, "adversary", False)) == adversary]


def _nearest(body: Any, others: list[Any]) -> Any:
    return min(others, key=lambda other: float(np.linalg.norm(other.state.p_pos - body.state.p_pos)))


def _hunt(intentions: _MpeIntentions, body: Any, habits: Habits) -> np.ndarray:
    """Returns a velocity: adversaries intercept the nearest prey; prey flees, or seeks food if no adversary is near."""
    world = intentions.world
    if body.adversary:
        nearest = _nearest(body, _of_role(world, adversary=False) or [body])
        target = nearest.state.p_pos + nearest.state.p_vel * habits.lead_s
        return intentions.towards(body, target, habits, brake=False)
    hunters = _of_role(world, adversary=True)
    gaps = [body.state.p_pos - h.state.p_pos - h.state.p_vel * habits.lead_s for h in hunters]
    food = getattr(world, "food", [])
    if food and all(np.linalg.norm(gap) > 0.6 for gap in gaps):
        return intentions.towards(body, _nearest(body, food).state.p_pos, habits)
    push = sum((gap / max(float(gap @ gap), 1e-3) for gap in gaps), start=np.zeros(2))
    for landmark in world.landmarks:
        gap = body.state.p_pos - landmark.state.p_pos
        clear_m = float(np.linalg.norm(gap)) - landmark.size - body.size
        if landmark.collide and clear_m < 0.15:
            push += 3.0 * gap / max(float(np.linalg.norm(gap)), 1e-6)
    position = body.state.p_pos
    push -= 20.0 * np.sign(position) * np.maximum(np.abs(position) - _WALL_M, 0.0)
    return intentions.towards(body, position + push, habits, brake=False)


def _stand(places: Callable[[Any], np.ndarray]) -> "Aim":
    """Returns the aim to take one of the places; adversaries go to the landmark that the agents are nearest to."""

    def aim(intentions: _MpeIntentions, body: Any, habits: Habits) -> np.ndarray:
        world = intentions.world
        good = _of_role(world, adversary=False)
        if getattr(body, "adversary", False):
            return intentions.towards(body, _likely_goal(good, world.landmarks).state.p_pos, habits)
        return intentions.towards(body, intentions.place(body, good, places(world)), habits)

    return aim  # a closure over a function without state, so that copies may share it


def _likely_goal(bodies: list[Any], landmarks: list[Any]) -> Any:
    pairs = [(float(np.linalg.norm(b.state.p_pos - m.state.p_pos)), i) for b in bodies for i, m in enumerate(landmarks)]
    return landmarks[min(pairs)[1]]


def _landmarks(world: Any) -> np.ndarray:
    return np.array([landmark.state.p_pos for landmark in world.landmarks])


def _circle(world: Any) -> np.ndarray:
    angles = 2 * np.pi * np.arange(len(world.agents)) / len(world.agents)
    return world.landmarks[0].state.p_pos + 0.5 * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _line(world: Any) -> np.ndarray:
    start, end = (landmark.state.p_pos for landmark in world.landmarks)
    return start + np.linspace(0, 1, len(world.agents))[:, None] * (end - start)


def _push(intentions: _MpeIntentions, body: Any, habits: Habits) -> np.ndarray:
    """Returns a velocity: the agent goes to its goal, the adversary to the landmark that the agents are nearest to."""
    good = _of_role(intentions.world, adversary=False)
    goal = _likely_goal(good, intentions.world.landmarks) if body.adversary else body.goal_a
    return intentions.towards(body, goal.state.p_pos, habits)


def _told(intentions: _MpeIntentions, body: Any, habits: Habits) -> np.ndarray:
    """Returns the velocity to the landmark that the other agent has to communicate."""
    speaker = next(other for other in intentions.world.agents if other is not body)
    return intentions.towards(body, speaker.goal_b.state.p_pos, habits)


def _collect(intentions: _MpeIntentions, body: Any, habits: Habits) -> np.ndarray:
    """Returns a velocity: collectors bring the nearest treasure to its deposit; deposits move towards collectors."""
    world = intentions.world
    collectors = [other for other in world.agents if other.collector]
    if not body.collector:
        goals = [c for c in collectors if c.holding == body.d_i] or collectors
    elif body.holding is None:
        goals = [treasure for treasure in world.landmarks if treasure.alive]
    else:
        goals = [other for other in world.agents if not other.collector and other.d_i == body.holding]
    return intentions.towards(body, _nearest(body, goals or [body]).state.p_pos, habits)


Aim = Callable[[_MpeIntentions, Any, Habits], np.ndarray]

_AIMS: dict[str, Aim] = {
    "simple": _stand(_landmarks),
    "simple_tag": _hunt,
    "simple_world_comm": _hunt,
    "simple_spread": _stand(_landmarks),
    "simple_adversary": _stand(_landmarks),
    "simple_formation": _stand(_circle),
    "simple_line": _stand(_line),
    "simple_push": _push,
    "simple_reference": _told,
    "simple_speaker_listener": _told,
    "collect_treasure": _collect,
}
