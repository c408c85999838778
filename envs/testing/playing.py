"""Plays episodes with random actions and keeps what the reader reports of them."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from pettingzoo import ParallelEnv

from envs.multiagent_observation import check_multiagent_scene
from envs.own_observation import own_spaces, require_space
from envs.readers import FunctionReader, MakeReader, multiagent_reader_for, reader_for
from envs.readers.base import build_multiagent_reader, build_reader, require_scene, show
from envs.testing.asking import ReaderProblem, asked_reset, asked_step
from predictor.scene import Scene, SceneSpec
from predictor.support.errors import UserError

MAX_LENGTH = 300
"""Largest number of characters of a line that quotes what arrived."""


@dataclass(frozen=True)
class Moment:
    """All agents at one instant, without padding."""

    states: Float[np.ndarray, "agents state"]
    """States in the world frame."""
    ids: Int[np.ndarray, " agents"]
    """Identities."""
    heading_rad: float
    """Heading of the ego."""
    named: Mapping[str, int] = field(default_factory=dict)
    """Id of each agent that a reader names; nothing where there is an ego."""

    @property
    def index_of(self) -> dict[int, int]:
        """Row of each id."""
        return {number: row for row, number in enumerate(self.ids.tolist())}


@dataclass
class Episode:
    """Moments of an episode."""

    moments: list[Moment] = field(default_factory=list)
    """What the reader reported, from the reset on."""
    shown: list[Mapping[str, Any]] = field(default_factory=list)
    """Observations of each agent, by its name, from the reset on; of an ego, whose name is empty."""
    rewards: list[Mapping[str, Any]] = field(default_factory=list)
    """Rewards of each step, likewise."""
    living: list[list[str]] = field(default_factory=list)
    """Names of the agents that live, from the reset on; nothing where there is an ego."""

    def pairs(self) -> Iterator[tuple[Moment, Moment]]:
        """Yields each moment with the one that follows it."""
        yield from zip(self.moments, self.moments[1:], strict=False)


@dataclass(frozen=True)
class OpenReader:
    """Reader of an environment, of either kind."""

    reader: Any
    """A `SceneReader` or a `MultiagentReader`."""
    name: str
    """Name for messages."""

    @property
    def spec(self) -> SceneSpec:
        """Layout of the scenes."""
        spec: SceneSpec = self.reader.spec
        return spec

    def begin(self, observation: Any) -> None:
        """Resets the reader and shows it the first observation.

        Raises:
            ReaderProblem: it raised.
        """
        with self._named("reset"):
            self.reader.reset()
        self.see(observation)

    def see(self, observation: Any) -> None:
        """Shows the reader an observation.

        Raises:
            ReaderProblem: it raised.
        """
        with self._named("see"):
            show(self.reader, observation)

    @contextmanager
    def _named(self, what: str) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            kind = "" if isinstance(error, UserError) else f"{self.name}: {what} failed with {type(error).__name__}: "
            raise ReaderProblem(_line(f"{kind}{error}")) from error

    def read(self, env: Any) -> Moment:
        """Reads all agents, twice, and checks what arrives.

        Raises:
            ReaderProblem: the contract is broken.
        """
        first, second = self._all(env), self._all(env)
        if not (np.array_equal(first.states, second.states) and np.array_equal(first.ids, second.ids)):
            raise ReaderProblem(f"{self.name}: reading twice within a step gives two scenes; it must give the same one")
        return first

    def _all(self, env: Any) -> Moment:
        with self._named("reading"):
            index_of: Mapping[str, int] = {}
            if self.spec.has_ego:
                self._check_view(self.reader.read(env))
                scene = require_scene(self.reader.read_all(env), self.name)
                scene.check(self.name, self.spec)
            else:
                several = check_multiagent_scene(self.reader.read(env), self.spec, self.name)
                scene, index_of = several.scene, several.index_of
        there = scene.valid
        named = {name: int(scene.ids[index]) for name, index in index_of.items()}
        return Moment(scene.states[there].copy(), scene.ids[there].copy(), float(scene.heading_rad), named)

    def _check_view(self, view: Scene) -> None:
        spec = self.spec
        require_scene(view, self.name).check(self.name, spec, agents=spec.max_agents)
        axes = spec.position_dim
        distance_m = np.linalg.norm(view.states[view.valid, :axes] - view.states[0, :axes], axis=-1)
        if distance_m.max() > spec.perception_m * (1 + 1e-6):
            raise UserError(
                f"{self.name}: read() gives an agent {distance_m.max():.4g} m away, but perception_m is "
                f"{spec.perception_m:g}; return perceive(scene, spec) (envs.readers)"
            )


def _line(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= MAX_LENGTH else f"{line[:MAX_LENGTH]}…"


def open_reader(env: Any, make_reader: MakeReader | None) -> OpenReader:
    """Makes the reader of an environment.

    Raises:
        UserError: no reader knows the env, or `make_reader` makes none.
    """
    if isinstance(env, ParallelEnv):
        reader = multiagent_reader_for(env) if make_reader is None else build_multiagent_reader(make_reader, env)
    else:
        reader = reader_for(env) if make_reader is None else build_reader(make_reader, env)
        lacks = [part for part in ("read", "read_all") if not hasattr(reader, part)]
        if lacks:
            raise UserError(f"{type(reader).__name__} has no {', '.join(lacks)}; derive it from envs.readers.Reader")
    given = make_reader if make_reader is not None else reader
    given = given.read if isinstance(given, FunctionReader) else given
    return OpenReader(reader, str(getattr(given, "__name__", type(given).__name__)))


def space_problems(env: Any) -> list[str]:
    """Returns a line for the first space that a wrapper would refuse; nothing if there is none."""
    if isinstance(env, ParallelEnv):
        agents = [
            (f"'{agent}': ", f"'{agent}'", env.observation_space(agent), env.action_space(agent))
            for agent in env.possible_agents
        ]
    else:
        agents = [("", "the environment", env.observation_space, env.action_space)]
    for whose, source, observation, action in agents:
        try:
            require_space(observation, f"{whose}the observation space")
            require_space(action, f"{whose}the action space")
            own_spaces(observation, source)
        except UserError as error:
            return [str(error)]
    return []


def shown_spaces(env: Any) -> dict[str, Any]:
    """Returns the space of each agent's own observation, by its name; of an ego, whose name is empty."""
    if isinstance(env, ParallelEnv):
        return {agent: env.observation_space(agent) for agent in env.possible_agents}
    return {"": env.observation_space}


Act = Callable[[int], Any]
"""Takes the number of the step and returns the action."""


def begin(env: Any, opened: OpenReader | None, seed: int) -> Any:
    """Resets the environment, and the reader if there is one; returns the observation.

    Raises:
        ReaderProblem: the environment or the reader raised, or the environment returned something else.
    """
    observation = asked_reset(env, seed)
    if opened is not None:
        opened.begin(observation)
    return observation


def step(env: Any, opened: OpenReader | None, action: Any) -> tuple[Any, Any, bool]:
    """Steps the environment; returns observation, reward, and whether the episode is over.

    Raises:
        ReaderProblem: the environment or the reader raised, or the environment returned something else.
    """
    observation, reward, terminated, truncated, _ = asked_step(env, action)
    if opened is not None:
        opened.see(observation)
    return observation, reward, not env.agents if isinstance(env, ParallelEnv) else bool(terminated or truncated)


def frozen(seen: Any) -> Any:
    """Returns a value that is equal if what was seen is."""
    if isinstance(seen, Mapping):
        return tuple((key, frozen(value)) for key, value in seen.items())
    if isinstance(seen, tuple | list):
        return tuple(map(frozen, seen))
    return np.asarray(seen).tobytes()


def random_actions(env: Any, seed: int) -> Act:
    """Returns random actions, equal for equal seeds, also where a reset makes new spaces (highway-env)."""
    if not isinstance(env, ParallelEnv):
        space = env.action_space
        space.seed(seed)
        return lambda _: space.sample()
    spaces = {agent: env.action_space(agent) for agent in env.possible_agents}
    for number, space in enumerate(spaces.values()):
        space.seed(seed + number)

    def act(_: int) -> dict[str, Any]:
        unknown = [agent for agent in env.agents if agent not in spaces]
        if unknown:
            raise ReaderProblem(
                f"agent '{unknown[0]}' is alive, but possible_agents has {list(spaces)} alone: it must name all agents "
                "that may ever be there"
            )
        return {agent: spaces[agent].sample() for agent in env.agents}

    return act


def play(env: Any, opened: OpenReader, seed: int, max_steps: int) -> Episode:
    """Plays an episode with random actions.

    Raises:
        ReaderProblem: the environment or the reader breaks its contract.
    """
    episode, act = Episode(), random_actions(env, seed)

    def by_agent(seen: Any) -> Mapping[str, Any]:
        return deepcopy(dict(seen) if isinstance(env, ParallelEnv) else {"": seen})  # some write into old observations

    def living() -> list[str]:
        return list(env.agents) if isinstance(env, ParallelEnv) else []

    episode.shown.append(by_agent(begin(env, opened, seed)))
    episode.moments.append(opened.read(env))
    episode.living.append(living())
    for number in range(max_steps):
        observation, reward, over = step(env, opened, act(number))
        episode.shown.append(by_agent(observation))
        episode.rewards.append(by_agent(reward))
        episode.moments.append(opened.read(env))
        episode.living.append(living())
        if over:
            break
    return episode
