"""What every scene reader is: who is there, where, and who they are; the same rules of perception for all families.

A reader reports everyone (`read_all`); what the ego perceives of it (`read`) is decided here, once: agents within
`perception_m`, the nearest `max_agents`, the ego in row 0, padded rows of zeros. A PettingZoo environment has many
learners and no single ego: its reader gives a `MultiagentScene`, from which every agent's own view is cut.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from predictor.errors import UserError
from predictor.scene import PADDING_ID, Scene, SceneBatch, SceneSpec, perceived_agents


@runtime_checkable
class SceneReader(Protocol):
    """Sees the agents of one environment; keeps their identities from step to step."""

    @property
    def spec(self) -> SceneSpec:
        """What the scenes of this reader look like."""

    def reset(self) -> None:
        """Forget all identities: a new episode has begun."""

    def read(self, env: Any) -> Scene:
        """The scene as a perception system would have it: within `perception_m`, at most `max_agents`."""

    def read_all(self, env: Any) -> Scene:
        """Everyone, ego first, unpadded: ground truth for collection and evaluation."""


@dataclass(frozen=True)
class MultiagentScene:
    """Everyone in an environment with many learners; nobody is the ego."""

    scene: Scene
    """Everyone, padded to `max_agents` rows; a row need not stay an agent's, its id does."""
    rows: Mapping[str, int]
    """Row of each agent that is observed now, by its name: the living, and those whose last observation this is."""
    heading_rad: Float[np.ndarray, " agents"]
    """Heading of each row, which turns world axes into the agent's; 0 where agents have none."""


@runtime_checkable
class MultiagentReader(Protocol):
    """Sees everyone in one PettingZoo parallel environment."""

    @property
    def spec(self) -> SceneSpec:
        """What the scenes look like: `has_ego` is False; `max_agents` holds everyone."""

    def reset(self) -> None:
        """Forget all identities: a new episode has begun."""

    def read(self, env: Any) -> MultiagentScene:
        """Everyone who is there now."""


MakeReader = Callable[[Any], Any]
"""Takes an environment and returns its reader, a `SceneReader` or a `MultiagentReader`."""


class Reader(ABC):
    """A `SceneReader` that only has to say who is there; derive from it for a new family.

    Args:
        spec: what the scenes look like.
    """

    def __init__(self, spec: SceneSpec) -> None:
        """Keep the spec."""
        self._spec = spec

    @property
    def spec(self) -> SceneSpec:
        """What the scenes of this reader look like."""
        return self._spec

    def reset(self) -> None:  # noqa: B027 (a default, not a duty)
        """Forget all identities; a reader whose environment names its agents has none to forget."""

    def see(self, observation: Any) -> None:  # noqa: B027
        """Take in the env's own observation, once after each reset and step, before anything is read.

        For a reader that lives on observations; one that looks into the environment has no use for them.
        """

    @abstractmethod
    def read_all(self, env: Any) -> Scene:
        """Everyone, ego first, unpadded. The same at each call until the environment steps."""

    def read(self, env: Any) -> Scene:
        """What the ego perceives of everyone, padded to `max_agents` rows."""
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
    name = _name_of(make_reader)
    advice = f"for a function that reads a scene, pass reader=FunctionReader({name}, SceneSpec(dt_s=...))"
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
    name = _name_of(make_reader)
    advice = "pass a class with spec (has_ego=False), reset() and read(env) -> MultiagentScene (envs.readers)"
    reader = _build(make_reader, env, advice)
    if reader.spec.has_ego:
        raise UserError(
            f"{name}: a multiagent (PettingZoo) environment needs a reader whose spec has has_ego=False, got "
            f"a {type(reader).__name__} with has_ego=True, which serves environments with one ego; {advice}"
        )
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
    return reader


def show(reader: Any, observation: Any) -> None:
    """Hand the env's own observation to a reader that wants to `see` it; once after each reset and step."""
    see = getattr(reader, "see", None)
    if see is not None:
        see(observation)


def require_scene(scene: Any, source: str) -> Scene:
    """What a reader gave, which must be a `Scene`.

    Raises:
        UserError: it is something else.
    """
    if not isinstance(scene, Scene):
        raise UserError(f"{source}: reading must give a Scene (predictor.scene), got {type(scene).__name__}")
    return scene


def perceive(everyone: Scene, spec: SceneSpec, source: str = "reader") -> Scene:
    """The ego and the nearest agents within perception, nearest first, padded to `max_agents` rows.

    Agents beyond the nearest `max_agents` are out of perception, not an error. Rows that are not valid are dropped.

    Args:
        everyone: ego first, any number of rows.
        spec: its `perception_m` and `max_agents` decide.
        source: who read the scene, for messages.

    Raises:
        UserError: `everyone` breaks the contract of a scene.
    """
    everyone.check(source, spec)
    order, seen = perceived_agents(everyone.states, everyone.valid, 0, spec)
    return padded(everyone, order[seen], spec.max_agents)


def padded(scene: Scene, rows: np.ndarray, agents: int) -> Scene:
    """The given rows of a scene, in this order, and rows of padding up to `agents`."""
    states = np.zeros((agents, scene.states.shape[1]))
    ids = np.full(agents, PADDING_ID, dtype=np.int64)
    valid = np.zeros(agents, dtype=np.bool_)
    states[: len(rows)] = scene.states[rows]
    ids[: len(rows)] = scene.ids[rows]
    valid[: len(rows)] = True
    return Scene(states, ids, valid, scene.heading_rad)


def pad_multiagent_scene(
    everyone: Scene, rows: Mapping[str, int], heading_rad: np.ndarray, spec: SceneSpec, source: str = "reader"
) -> MultiagentScene:
    """A `MultiagentScene` of an unpadded scene.

    Args:
        everyone: all rows valid, any order.
        rows: row of each living agent.
        heading_rad: of each row.
        spec: `max_agents` is the number of rows to pad to.
        source: who read the scene, for messages.

    Raises:
        UserError: more agents than `max_agents`, or `everyone` breaks the contract of a scene.
    """
    everyone.check(source, spec)
    count = len(everyone.ids)
    if count > spec.max_agents:
        raise UserError(f"{source}: {count} agents do not fit max_agents={spec.max_agents}; raise max_agents")
    headings = np.zeros(spec.max_agents)
    headings[:count] = heading_rad
    return MultiagentScene(padded(everyone, np.arange(count), spec.max_agents), dict(rows), headings)


def role_of(agent: str) -> str:
    """An agent's name without its number."""
    return agent.rstrip("0123456789").rstrip("_- ") or agent


def perceive_batch(everyone: SceneBatch, spec: SceneSpec) -> SceneBatch:
    """Returns what each ego of a batch perceives: `perceive` for many scenes at once."""
    order, seen = perceived_agents(everyone.states, everyone.valid, 0, spec)
    batch, nearest = order.shape
    states = np.zeros((batch, spec.max_agents, everyone.states.shape[-1]))
    ids = np.full((batch, spec.max_agents), PADDING_ID, dtype=np.int64)
    valid = np.zeros((batch, spec.max_agents), dtype=np.bool_)
    states[:, :nearest] = np.where(seen[..., None], np.take_along_axis(everyone.states, order[..., None], axis=1), 0.0)
    ids[:, :nearest] = np.where(seen, np.take_along_axis(everyone.ids, order, axis=1), PADDING_ID)
    valid[:, :nearest] = seen
    return SceneBatch(states, ids, valid, everyone.heading_rad)
