"""Interfaces of scene readers, and what they have in common: how they are made, and what an ego perceives.

A reader reports all agents (`read_all`): their ids, positions and velocities. What the ego perceives of them
(`read`) is decided by `predictor.scene.perceived_agents`: itself first, then the nearest within `perception_m`, at most
`max_agents`, padded with zeros. A PettingZoo environment has many learners and no single ego: its reader returns a
`MultiagentScene`, from which every agent's own view is cut.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from predictor.scene import MOST_AGENTS, PADDING_ID, Scene, SceneBatch, SceneSpec, perceived_agents
from predictor.support.config_checks import is_whole
from predictor.support.errors import UserError, short
from predictor.support.importing import load_named


@runtime_checkable
class SceneReader(Protocol):
    """Reads the agents of one environment with an ego; keeps their identities from step to step."""

    @property
    def spec(self) -> SceneSpec:
        """Returns the layout of the scenes."""

    def reset(self) -> None:
        """Forgets all identities: a new episode has begun."""

    def read(self, env: Any) -> Scene:
        """Returns what the ego perceives: agents within `perception_m`, at most `max_agents`, padded."""

    def read_all(self, env: Any) -> Scene:
        """Returns all agents, ego first, unpadded: ground truth for collection and evaluation."""


@dataclass(frozen=True)
class MultiagentScene:
    """All agents of an environment with many learners, none of which is the ego."""

    scene: Scene
    """All agents, padded to `max_agents`; an agent's index may change from step to step, its id does not."""
    index_of: Mapping[str, int]
    """Index in `scene` of each agent that is observed now, by its name: agents that live, and agents that get their
    last observation."""
    heading_rad: Float[np.ndarray, " agents"]
    """Heading of each agent, which turns world axes into its own; 0 where agents have none."""
    true_xy: Float[np.ndarray, "agents horizon 2"] | None = None
    """Positions of all agents if the learners keep on [m], world frame; None unless an oracle has played them
    (`envs.plans.keeping_on`)."""


@runtime_checkable
class MultiagentReader(Protocol):
    """Reads all agents of one PettingZoo environment; keeps their identities from step to step."""

    @property
    def spec(self) -> SceneSpec:
        """Returns the layout of the scenes: `has_ego` is False, and all agents fit into `max_agents`."""

    def reset(self) -> None:
        """Forgets all identities: a new episode has begun."""

    def read(self, env: Any) -> MultiagentScene:
        """Returns all agents that are present now."""


MakeReader = Callable[[Any], Any] | str
"""Takes an environment and returns its reader, a `SceneReader` or a `MultiagentReader`; or the name of what does so, as
"module:name", which alone can stand in the JSON of an environment's spec."""


class Reader(ABC):
    """Base of `SceneReader`s that only have to report all agents; derive from it for a new family.

    Args:
        spec: layout of the scenes.
    """

    def __init__(self, spec: SceneSpec) -> None:
        """Keeps the spec."""
        self._spec = spec

    @property
    def spec(self) -> SceneSpec:
        """Returns the layout of the scenes."""
        return self._spec

    def reset(self) -> None:  # noqa: B027 (a default, not a duty)
        """Forgets all identities; does nothing for a reader whose environment numbers its agents."""

    def see(self, observation: Any) -> None:  # noqa: B027
        """Takes in the env's own observation, once after each reset and step, before anything is read.

        For readers of observations; a reader of the simulator ignores them.
        """

    @abstractmethod
    def read_all(self, env: Any) -> Scene:
        """Returns all agents, ego first, unpadded; equal at each call until the environment steps."""

    def read(self, env: Any) -> Scene:
        """Returns what the ego perceives, padded to `max_agents`."""
        name = type(self).__name__
        return perceive(require_scene(self.read_all(env), name), self._spec, name)


def comes_from(env: Any, package: str) -> bool:
    """Returns whether the unwrapped environment is of a class of this package or module; does not import it."""
    return any(f"{cls.__module__}.".startswith(f"{package}.") for cls in type(env.unwrapped).__mro__)


def build_reader(make_reader: Any, env: Any) -> Any:
    """Calls what a user gave as `reader=`, or registered, on an environment with one ego.

    Raises:
        UserError: it returns no `SceneReader`; the message says what to pass instead.
    """
    make_reader = load_named(make_reader) if isinstance(make_reader, str) else make_reader
    name = _name_of(make_reader)
    advice = f"for a function that reads a scene, give FunctionReader({name}, SceneSpec(dt_s=...))"
    if isinstance(make_reader, type):
        advice = f"{name} needs read_all(env), and an __init__(self, env) that calls super().__init__(SceneSpec(...))"
    reader = _build(make_reader, env, advice)
    if not reader.spec.has_ego:
        raise UserError(
            f"{name}: an environment with one ego needs a reader whose spec has has_ego=True, got a "
            f"{type(reader).__name__} with has_ego=False, which serves multiagent (PettingZoo) environments"
        )
    return reader


def build_multiagent_reader(make_reader: Any, env: Any) -> Any:
    """Calls what a user gave as `reader=`, or registered, on a PettingZoo environment.

    Raises:
        UserError: it returns no `MultiagentReader`; the message says what to pass instead.
    """
    make_reader = load_named(make_reader) if isinstance(make_reader, str) else make_reader
    name = _name_of(make_reader)
    advice = "pass a class with spec (has_ego=False), reset() and read(env) -> MultiagentScene (envs.readers)"
    reader = _build(make_reader, env, advice)
    if reader.spec.has_ego:
        raise UserError(
            f"{name}: a multiagent (PettingZoo) environment needs a reader whose spec has has_ego=False, got "
            f"a {type(reader).__name__} with has_ego=True, which serves environments with one ego; {advice}"
        )
    return reader


def check_bounds(perception_m: Any, max_agents: Any) -> None:
    """Checks what an ego perceives; None leaves the reader's value.

    Raises:
        UserError: a value is no positive number, or no whole one.
    """
    is_number = is_whole(perception_m) or isinstance(perception_m, float | np.floating)
    if perception_m is not None and not (is_number and perception_m > 0):
        raise UserError(f"perception_m must be a positive number, got {perception_m!r}")
    if max_agents is not None and not (is_whole(max_agents) and 1 <= max_agents <= MOST_AGENTS):
        raise UserError(f"max_agents must be a whole number from 1 to {MOST_AGENTS:,}, got {max_agents!r}")


def bounded_spec(spec: SceneSpec, perception_m: float | None, max_agents: int | None) -> SceneSpec:
    """Returns the spec with what its ego perceives; None leaves the spec's value.

    Raises:
        UserError: see `check_bounds`.
    """
    check_bounds(perception_m, max_agents)
    if perception_m is not None:
        spec = replace(spec, perception_m=float(perception_m))
    return spec if max_agents is None else replace(spec, max_agents=int(max_agents))


def check_registration(env_class: Any, make: Any, what: str) -> None:
    """Checks what is registered for a class of environments.

    Raises:
        UserError: the class is none, or what makes the thing cannot be called.
    """
    if not isinstance(env_class, type):
        raise UserError(
            f"a {what} is registered for a class of environments, got {env_class!r}; pass type(env.unwrapped)"
        )
    if not callable(make):
        raise UserError(
            f"a {what} is registered as a function or class that is called with an environment, got {make!r}"
        )


def bounded(reader: Any, perception_m: float | None, max_agents: int | None) -> Any:
    """Returns a reader of one's own after setting what its ego perceives; None leaves the reader's value.

    Raises:
        UserError: a value out of range, or a reader that is no `Reader` and has another value.
    """
    spec = bounded_spec(reader.spec, perception_m, max_agents)
    if spec == reader.spec:
        return reader
    if not isinstance(reader, Reader):
        given = {"perception_m": spec.perception_m, "max_agents": spec.max_agents}
        asked = ", ".join(f"{name}={value:g}" for name, value in given.items() if value != getattr(reader.spec, name))
        raise UserError(
            f"{type(reader).__name__} sets what the ego perceives itself, so {asked} has no effect: derive it from "
            "envs.readers.Reader, or make it with these values"
        )
    reader._spec = spec
    return reader


def _name_of(make_reader: Any) -> str:
    return str(getattr(make_reader, "__name__", type(make_reader).__name__))


def _build(make_reader: Any, env: Any, advice: str) -> Any:
    """Calls `make_reader` and checks what both kinds of reader have in common."""
    name = _name_of(make_reader)
    if not callable(make_reader):
        raise UserError(f"reader= takes what makes a reader, a Reader class for example, got an object of {name}")
    returned = getattr(make_reader, "__annotations__", {}).get("return")
    if returned in (Scene, Scene.__name__, MultiagentScene, MultiagentScene.__name__):
        kind = getattr(returned, "__name__", returned)
        raise UserError(f"reader= takes what makes a reader, but {name} gives a {kind}; {advice}")
    try:
        reader = make_reader(env)
    except UserError:
        raise
    except Exception as error:
        raise UserError(
            f"reader= takes what makes a reader for an env that is not reset yet, but {name} failed with "
            f"{type(error).__name__}: {error}; {advice}"
        ) from error
    lacks = [part for part in ("spec", "reset", "read") if not hasattr(reader, part)]
    if lacks:
        raise UserError(
            f"reader= takes what makes a reader, but {name} gives {type(reader).__name__} without {', '.join(lacks)}; "
            + advice
        )
    if not isinstance(reader.spec, SceneSpec):
        raise UserError(
            f"{name}: the spec of a reader must be a SceneSpec, got {type(reader.spec).__name__}; a class of one's own "
            "is called with the env and gives a spec to Reader.__init__"
        )
    if reader.spec.position_dim != 2:
        raise UserError(
            f"{name}: environments need positions in a plane, got {reader.spec.position_dim} axes; give x_m, y_m, "
            "vx_mps and vy_mps alone, or the height as a further feature (feature_names of SceneSpec)"
        )
    return reader


def policy_step_s(config: Mapping[str, Any]) -> float:
    """Returns the time that a policy step of highway-env or EnvPool simulates [s]: whole frames, rounded down.

    Raises:
        UserError: the frequencies are no positive numbers, or a policy step is shorter than a frame.
    """
    simulated, decided = config["simulation_frequency"], config["policy_frequency"]
    if not all(isinstance(each, int | float) and each > 0 for each in (simulated, decided)) or simulated < decided:
        raise UserError(
            "simulation_frequency and policy_frequency must be positive numbers, the first not below the second, got "
            f"{short(simulated)} and {short(decided)}"
        )
    return float(simulated // decided / simulated)


def show(reader: Any, observation: Any) -> None:
    """Passes the env's own observation to a reader that has `see`; once after each reset and step."""
    see = getattr(reader, "see", None)
    if see is not None:
        see(observation)


def require_scene(scene: Any, source: str) -> Scene:
    """Returns `scene`, which must be a `Scene`.

    Raises:
        UserError: it is of another type.
    """
    if not isinstance(scene, Scene):
        raise UserError(f"{source}: reading must give a Scene (predictor.scene), got {type(scene).__name__}")
    return scene


def perceive(full: Scene, spec: SceneSpec, source: str = "reader") -> Scene:
    """Returns the ego and the nearest agents that it perceives, nearest first, padded to `max_agents`.

    Agents beyond the nearest `max_agents` are not perceived, which is no error. Entries that are not valid are dropped.

    Args:
        full: all agents, ego first, any number.
        spec: its `perception_m` and `max_agents` decide.
        source: name of the reader, for messages.

    Raises:
        UserError: `full` breaks the contract of a scene.
    """
    full.check(source, spec)
    order, seen = perceived_agents(full.states, full.valid, 0, spec)
    return padded(full, order[seen], spec.max_agents)


def padded(scene: Scene, indices: np.ndarray, max_agents: int) -> Scene:
    """Returns the agents at these indices of a scene, in this order, padded to `max_agents`."""
    states = np.zeros((max_agents, scene.states.shape[1]))
    ids = np.full(max_agents, PADDING_ID, dtype=np.int64)
    valid = np.zeros(max_agents, dtype=np.bool_)
    states[: len(indices)] = scene.states[indices]
    ids[: len(indices)] = scene.ids[indices]
    valid[: len(indices)] = True
    return Scene(states, ids, valid, scene.heading_rad)


def pad_multiagent_scene(
    full: Scene, index_of: Mapping[str, int], heading_rad: np.ndarray, spec: SceneSpec, source: str = "reader"
) -> MultiagentScene:
    """Returns the `MultiagentScene` of an unpadded scene.

    Args:
        full: all agents, all valid, in any order.
        index_of: index of each observed agent, by its name.
        heading_rad: heading of each agent [rad].
        spec: its `max_agents` is the size to pad to.
        source: name of the reader, for messages.

    Raises:
        UserError: more agents than `max_agents`, absent ones, another number of headings, or `full` breaks the
            contract of a scene.
    """
    if not isinstance(index_of, Mapping):
        raise UserError(f"{source}: index_of must be a dict from names to indices, got {type(index_of).__name__}")
    full.check(source, spec)
    count = len(full.ids)
    if not full.valid.all():
        raise UserError(f"{source}: a full scene holds only agents that are there, {int((~full.valid).sum())} are not")
    if np.shape(heading_rad) != (count,):
        raise UserError(f"{source}: {count} agents need as many headings, got shape {np.shape(heading_rad)}")
    if count > spec.max_agents:
        raise UserError(
            f"{source}: {count} agents do not fit max_agents={spec.max_agents} of the reader's spec; raise it there"
        )
    if count == spec.max_agents:
        return MultiagentScene(full, dict(index_of), np.array(heading_rad, dtype=np.float64))
    headings = np.zeros(spec.max_agents)
    headings[:count] = heading_rad
    return MultiagentScene(padded(full, np.arange(count), spec.max_agents), dict(index_of), headings)


def role_of(agent: str) -> str:
    """Returns an agent's name without its number; that of an agent whose name is a number is the number."""
    name = str(agent)
    return name.rstrip("0123456789").rstrip("_- ") or name


def perceive_batch(full: SceneBatch, spec: SceneSpec) -> SceneBatch:
    """Returns what each ego of a batch perceives: `perceive` for many scenes at once."""
    order, seen = perceived_agents(full.states, full.valid, 0, spec)
    batch, nearest = order.shape
    states = np.zeros((batch, spec.max_agents, full.states.shape[-1]))
    ids = np.full((batch, spec.max_agents), PADDING_ID, dtype=np.int64)
    valid = np.zeros((batch, spec.max_agents), dtype=np.bool_)
    states[:, :nearest] = np.where(seen[..., None], np.take_along_axis(full.states, order[..., None], axis=1), 0.0)
    ids[:, :nearest] = np.where(seen, np.take_along_axis(full.ids, order, axis=1), PADDING_ID)
    valid[:, :nearest] = seen
    return SceneBatch(states, ids, valid, full.heading_rad)
