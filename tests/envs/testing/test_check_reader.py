"""`check_reader`: finds nothing in the readers of this project, and each of the planted mistakes."""

import itertools
import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from envs.own_observation import own_spaces
from envs.readers.base import Reader
from envs.readers.function import FunctionReader
from envs.readers.highway import HighwayReader
from envs.registry import make_env
from envs.sampled_actions import uniform_action
from envs.testing import check_reader, examine_reader, reader_problems
from envs.testing.ego import extreme_actions
from predictor.scene import Scene, SceneSpec
from predictor.support.errors import UserError
from tests.envs.semantics import DT_S, LIVES, SUBJECTS, Crowd, Swarm, SwarmReader, named, read_crowd

BOX = gym.spaces.Box(-np.inf, np.inf, (2,))
SPEC = SceneSpec(dt_s=DT_S, feature_scales=(10.0, 10.0, 1.0, 1.0), perception_m=1000.0)


def changed(change: Callable[[Scene, Any], Scene]) -> FunctionReader:
    """Returns a reader of the crowd, whose scenes are changed."""

    def reads(env: Any) -> Any:
        return change(read_crowd(env), env.unwrapped)

    return FunctionReader(reads, SPEC)


def with_states(change: Callable[[np.ndarray], np.ndarray]) -> FunctionReader:
    return changed(lambda scene, _: replace(scene, states=change(scene.states)))


def with_ids(change: Callable[[np.ndarray, Any], np.ndarray]) -> FunctionReader:
    return changed(lambda scene, crowd: replace(scene, ids=change(scene.ids, crowd)))


def with_rows(order: Callable[[Scene, Any], np.ndarray]) -> FunctionReader:
    def reorder(scene: Scene, crowd: Any) -> Scene:
        rows = order(scene, crowd)
        return Scene(scene.states[rows], scene.ids[rows], scene.valid[rows], scene.heading_rad)

    return changed(reorder)


def columns(*order: int, factor: tuple[float, ...] = (1, 1, 1, 1)) -> FunctionReader:
    return with_states(lambda states: states[:, list(order)] * np.array(factor))


def by_distance(scene: Scene) -> np.ndarray:
    away = np.linalg.norm(scene.states[:, :2] - scene.states[0, :2], axis=1)
    return np.argsort(away)


def numbered_by_row(scene: Scene, crowd: Any) -> Scene:
    """Sorts by distance, as observations do, and takes the row numbers as ids."""
    rows = by_distance(scene)
    return Scene(scene.states[rows], np.arange(len(rows)), scene.valid[rows], scene.heading_rad)


def swapped_once(ids: np.ndarray, crowd: Any) -> np.ndarray:
    """Two agents change their ids in the middle of the episode."""
    swapped = {3: 4, 4: 3} if crowd.time >= 5 else {}
    return np.array([swapped.get(number, number) for number in ids.tolist()])


class NewIds(Reader):
    """Numbers the agents anew at each step."""

    def __init__(self, env: Any) -> None:
        super().__init__(SPEC)
        self._times = itertools.count()

    def see(self, observation: Any) -> None:
        self._base = 100 * next(self._times)

    def read_all(self, env: Any) -> Scene:
        scene = read_crowd(env)
        return replace(scene, ids=scene.ids + self._base)


class NewOthers(NewIds):
    """Numbers the others anew at each step, and keeps the ego's id."""

    def read_all(self, env: Any) -> Scene:
        scene = super().read_all(env)
        return replace(scene, ids=np.append(0, scene.ids[1:] + 1))


def in_body_frame(scene: Scene, crowd: Any) -> Scene:
    """Turns each velocity into the frame of its agent, which looks where it walks."""
    states = scene.states.copy()
    states[:, 2:] = np.linalg.norm(states[:, 2:], axis=1, keepdims=True) * np.array([1.0, 0.0])
    return replace(scene, states=states)


def with_ghost(scene: Scene, crowd: Any) -> Scene:
    """Adds a place that nobody takes, with a velocity."""
    states = np.vstack([scene.states, [30.0, 30.0, 2.0, 0.0]])
    return Scene(states, np.append(scene.ids, 50), np.append(scene.valid, True), scene.heading_rad)


def only(rows: slice, factor: tuple[float, ...]) -> FunctionReader:
    """Returns a reader of which some agents' states are multiplied."""

    def change(states: np.ndarray) -> np.ndarray:
        states = states.copy()
        states[rows] *= np.array(factor)
        return states

    return with_states(change)


class Stale(Reader):
    """Keeps the first scene of an episode."""

    def __init__(self, env: Any) -> None:
        super().__init__(SPEC)

    def reset(self) -> None:
        self._scene: Scene | None = None

    def read_all(self, env: Any) -> Scene:
        self._scene = self._scene or read_crowd(env)
        return self._scene


class Uncut(Reader):
    """Gives the ego all agents, however far away."""

    def __init__(self, env: Any) -> None:
        super().__init__(replace(SPEC, perception_m=5.0, max_agents=5))

    def read_all(self, env: Any) -> Scene:
        return read_crowd(env)

    def read(self, env: Any) -> Scene:
        scene = read_crowd(env)
        return Scene(scene.states[:5], scene.ids[:5], scene.valid[:5])


def draws(scene: Scene, crowd: Any) -> Scene:
    """Uses up the environment's random numbers."""
    crowd.np_random.random()
    return scene


def twice(scene: Scene, crowd: Any) -> Scene:
    """Gives other states at each call."""
    crowd.calls = getattr(crowd, "calls", 0) + 1
    return replace(scene, states=scene.states + crowd.calls)


class Pushed(Crowd):
    """A crowd whose ego takes the action's push tenfold, so that actions show in the first step."""

    def step(self, action: np.ndarray) -> Any:
        return super().step(10 * np.asarray(action))


MISTAKES: dict[str, tuple[Any, str]] = {
    "dt_s": (
        FunctionReader(read_crowd, replace(SPEC, dt_s=1.0)),
        "positions change by 0.5 × velocity × dt_s: either a step lasts 0.5 s, not dt_s=1,",
    ),
    "units": (columns(0, 1, 2, 3, factor=(1, 1, 3.6, 3.6)), "in different units (velocities in km/h?)"),
    "centimetres": (columns(0, 1, 2, 3, factor=(1e3, 1e3, 1e3, 1e3)), "feature_scales say 10: give SI units"),
    "mirrored axis": (columns(0, 1, 2, 3, factor=(1, -1, 1, 1)), "positions along y change against their velocity"),
    "swapped axes": (columns(0, 1, 3, 2), "velocities along x and y are swapped"),
    "no velocities": (columns(0, 1, 2, 3, factor=(1, 1, 0, 0)), "all velocities are zero, although positions change"),
    "relative": (
        with_states(lambda s: s - s[:1] * np.array([1, 1, 0, 0])),
        "the ego never changes its position, although it has a velocity: positions must be in the world frame",
    ),
    "old scene": (Stale, "no position ever changes while the environment steps; does the reader return an old scene?"),
    "degrees": (
        changed(lambda scene, crowd: replace(scene, heading_rad=float(np.rad2deg(crowd.heading_rad)))),
        "heading_rad is in degrees; give radians",
    ),
    "mirrored heading": (
        changed(lambda scene, crowd: replace(scene, heading_rad=-crowd.heading_rad)),
        "heading_rad is mirrored: it must grow from x to y",
    ),
    "row numbers": (changed(numbered_by_row), "the ids are the row numbers 0, 1, 2, … of every scene, but rows change"),
    "ids change hands": (with_ids(swapped_once), "ids change hands: in step 5 id "),
    "id returns": (
        with_ids(lambda ids, _: np.where(ids == 9, 1, ids)),
        "an id returns: id 1 was gone after step 5 and came back in step 7",
    ),
    "id of the newcomer": (with_ids(lambda ids, _: np.where(ids == 7, 2, ids)), "an id jumps: in step 4 id 2 is "),
    "new ids": (NewIds, "no agent is there in two scenes that follow each other: ids must stay with an agent"),
    "new ids of the others": (NewOthers, "0% of the others' ids are there after a step, too; an id must stay with its"),
    "ego not first": (with_rows(lambda scene, _: np.roll(np.arange(len(scene.ids)), 1)), "agent 1 of the scene obeys"),
    "others relative": (
        with_states(lambda s: np.vstack([s[:1], s[1:] - s[:1]])),
        "the others' positions are relative to the ego: where an action moves the ego, they change by as much",
    ),
    "velocities relative": (
        with_states(lambda s: np.vstack([s[:1], s[1:] - s[:1] * np.array([0, 0, 1, 1])])),
        "the others' velocities are relative to the ego",
    ),
    "body frame": (changed(in_body_frame), "the ego moves along its velocity turned by heading_rad: velocities are in"),
    "ghost": (changed(with_ghost), "id 50 never moves, although it has a velocity (2 m/s): what stands has velocity"),
    "ego without velocity": (only(slice(0, 1), (1, 1, 0, 0)), "the ego moves, but its velocity is always zero"),
    "ego in pixels": (only(slice(0, 1), (10, 10, 1, 1)), "the ego's positions change by 10 × velocity × dt_s"),
    "others in km/h": (only(slice(1, None), (1, 1, 3.6, 3.6)), "velocities in km/h?"),
    "ego moves": (
        with_rows(lambda scene, crowd: np.roll(np.arange(len(scene.ids)), crowd.time)),
        "the first agent has id 0 and, from step 1 on, id ",
    ),
    "nan": (with_states(lambda s: np.where(s > 3, np.nan, s)), "reads: states must be finite"),
    "columns": (with_states(lambda s: s[:, :2]), "reads: states need 4 features"),
    "same ids": (with_ids(lambda ids, _: ids * 0), "reads: ids must be unique within a scene"),
    "type": (changed(lambda scene, _: scene.states), "reads: reading must give a Scene (predictor.scene), got ndarray"),
    "error": (changed(lambda scene, crowd: crowd.absent), "reads: reading failed with AttributeError: 'Pushed' object"),
    "perception": (Uncut, "Uncut: read() gives an agent "),
    "reading draws": (changed(draws), "reads: reading changes what happens in the environment"),
    "reading twice": (changed(twice), "reads: reading twice within a step gives two scenes"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_is_found_and_said_in_a_line(mistake: str):
    reader, sentence = MISTAKES[mistake]
    with pytest.raises(UserError) as error:
        check_reader(Pushed(shift_m=40.0), reader)
    lines = str(error.value).splitlines()
    assert any(sentence in line for line in lines), lines
    assert len(lines) <= (3 if mistake == "ego moves" else 2), lines
    assert all(len(line) < 400 for line in lines)


@pytest.mark.slow
@named()
def test_nothing_is_found_in_the_readers_of_this_project(name: str):
    subject = SUBJECTS[name]
    reader = subject.reader and subject.reader(subject.spec)
    assert reader_problems(subject.make(), reader, episodes=2, max_steps=20) == []


@pytest.mark.slow
@pytest.mark.parametrize("env_id", ["roundabout-v1", "merge-v1", "racetrack-v1", "parking-v0"])
def test_nothing_is_found_on_other_roads(env_id: str):
    """Those on which drivers brake, turn and steer; a parking lot, on which the ego drives backwards, too."""
    reader = None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = make_env(env_id)
        if env_id == "parking-v0":
            env = gym.wrappers.FlattenObservation(env)
        assert reader_problems(env, reader, episodes=2, max_steps=40) == []


class Drawing(HighwayReader):
    """Uses up random numbers of the road, with which traffic is made."""

    def read_all(self, env: gym.Env) -> Scene:
        env.unwrapped.np_random.random()
        return super().read_all(env)


@pytest.mark.slow
def test_a_reader_that_draws_is_found_where_a_reset_makes_new_spaces():
    """highway-env makes its action space anew at each reset: a seed of the old one must determine the actions."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = make_env("intersection-v2")
        problems = reader_problems(env, Drawing, episodes=1, max_steps=20)
    assert any("reading changes what happens" in line for line in problems), problems


def test_ids_of_which_some_are_lost_are_no_mistake():
    """In each step every second of the others gets a new id, as where a tracker loses some."""
    kept = with_ids(lambda ids, crowd: ids + 100 * crowd.time * (np.arange(len(ids)) % 2 == 1))
    assert not any("after a step, too" in line for line in reader_problems(Pushed(shift_m=40.0), kept))
    assert examine_reader(Pushed(shift_m=40.0), FunctionReader(read_crowd, SPEC)).lasting > 0.9


def test_it_finds_nothing_in_the_crowd():
    check_reader(Pushed(shift_m=40.0), FunctionReader(read_crowd, SPEC))


class SwarmMistaken(SwarmReader):
    def read(self, env: Any) -> Any:
        seen = super().read(env)
        return replace(seen, scene=replace(seen.scene, states=seen.scene.states * np.array([1, 1, 3.6, 3.6])))


def test_many_agents_are_checked_too():
    assert "velocities in km/h?" in "\n".join(reader_problems(Swarm(), SwarmMistaken))
    with pytest.raises(UserError, match="no scene reader knows swarm_v0; pass reader="):
        check_reader(Swarm())


class Stranger(Swarm):
    """An agent that `possible_agents` does not name lives on."""

    def reset(self, **options: Any) -> Any:
        found = super().reset(**options)
        self.agents = [*self.agents, "stranger"]
        return found


def test_an_agent_that_is_not_named_is_found():
    problems = reader_problems(Stranger(), SwarmReader)
    assert any("agent 'stranger' is alive, but possible_agents has [" in line for line in problems), problems


def test_names_of_agents_are_needed():
    swarm = Swarm()
    del swarm.possible_agents
    assert any("Swarm has no possible_agents; set it" in line for line in reader_problems(swarm, SwarmReader))


class Shows(Pushed):
    """Shows something else than a crowd does."""

    def __init__(self, space: gym.Space, shown: Any) -> None:
        super().__init__()
        self.observation_space, self.shown = space, shown

    def reset(self, **options: Any) -> Any:
        return self.shown, super().reset(**options)[1]

    def step(self, action: np.ndarray) -> Any:
        return self.shown, *super().step(action)[1:]


@pytest.mark.parametrize(
    ("space", "shown", "found"),
    [
        (gym.spaces.Dict({"valid": BOX}), {"valid": np.zeros(2)}, "the environment has an entry 'valid', as forecasts"),
        (gym.spaces.Tuple([BOX]), (np.zeros(2),), "the environment must be one array or a Dict of arrays, got Tuple"),
        (BOX, [[1.0, 2.0], [3.0]], "observation is a list and no array of numbers, its space Box"),
        (gym.spaces.Discrete(3), np.array([3]), r"observation is array\(\[3\]\), its space Discrete\(3\)"),
    ],
)
def test_what_wrappers_refuse_is_found(space: gym.Space, shown: Any, found: str):
    with pytest.raises(UserError, match=found):
        check_reader(Shows(space, shown), FunctionReader(read_crowd, SPEC))


def test_a_counted_observation_may_be_an_array_of_one():
    problems = reader_problems(Shows(gym.spaces.Discrete(3), np.array([2])), FunctionReader(read_crowd, SPEC))
    assert not any("its space" in problem for problem in problems)


def test_agents_whose_observations_wrappers_refuse_are_found():
    swarm = Swarm()
    swarm.observation_space = lambda agent: gym.spaces.Tuple([BOX])  # type: ignore[method-assign]
    assert any(
        "must be one array or a Dict of arrays, got Tuple" in line for line in reader_problems(swarm, SwarmReader)
    )


def test_without_a_reader_there_is_nothing_to_check():
    with pytest.raises(UserError, match="no scene reader"):
        check_reader(gym.make("CartPole-v1"))


class Parked(Pushed):
    """A crowd that all but stands still and, once in an episode, sinks by less than a centimetre."""

    def reset(self, **options: Any) -> Any:
        found = super().reset(**options)
        self._park()
        return found

    def step(self, action: np.ndarray) -> Any:
        found = super().step(action)
        self._park()
        return found

    def _park(self) -> None:
        for walker in self.people:
            x_m = 10.0 * walker.number + 0.002 * SPEC.dt_s * self.time
            walker.state = np.array([x_m, 0.008 * (self.time > 3), 0.002, 0.0])


def test_what_sinks_by_less_than_a_centimetre_has_not_jumped():
    """As vehicles do that a simulator has just put on the road: far below the 10 m of the scene's scale."""
    problems = reader_problems(Parked(shift_m=40.0), FunctionReader(read_crowd, SPEC))
    assert not any("jumps" in line or "hands" in line for line in problems), problems


class OldSpace:
    """A space of another package, as VMAS has them of gym."""

    low, high, shape, dtype = -1.0, 1.0, (2,), np.float32

    def seed(self, seed: int) -> None: ...

    def sample(self) -> np.ndarray:
        return np.zeros(2, np.float32)


class OldSwarm(Swarm):
    def action_space(self, agent: str) -> Any:
        return OldSpace()


@pytest.mark.unchecked
def test_spaces_of_another_package_are_found_and_refused():
    sentence = r"the action space must be a space of gymnasium, got .*\.OldSpace; make it anew, for example gymnasium"
    problems = reader_problems(OldSwarm(), SwarmReader)
    assert any(re.search(sentence, line) for line in problems), problems
    with pytest.raises(UserError, match=sentence):
        uniform_action(OldSpace(), np.random.default_rng(0), "drivers")  # type: ignore[arg-type]
    with pytest.raises(UserError, match="the own observation space of 'it' must be a space of gymnasium, got"):
        own_spaces(OldSpace(), "'it'")  # type: ignore[arg-type]


class Nameless(SwarmReader):
    """Names nobody from a step on."""

    def __init__(self, env: Any, first_step: int = 0) -> None:
        super().__init__(env)
        self.first_step = first_step

    def read(self, env: Any) -> Any:
        seen = super().read(env)
        return replace(seen, index_of=seen.index_of if env.unwrapped.time < self.first_step else {})


class Renumbered(SwarmReader):
    """Gives everybody another id in the middle of the episode."""

    def read(self, env: Any) -> Any:
        seen = super().read(env)
        shift = 100 if env.unwrapped.time >= 5 else 0
        return replace(seen, scene=replace(seen.scene, ids=np.where(seen.scene.valid, seen.scene.ids + shift, -1)))


class Swapped(SwarmReader):
    """Gives each name the place of the next agent."""

    def read(self, env: Any) -> Any:
        seen = super().read(env)
        names, places = list(seen.index_of), list(seen.index_of.values())
        return replace(seen, index_of=dict(zip(names, np.roll(places, -1).tolist(), strict=True)))


@pytest.mark.parametrize(
    ("reader", "sentence"),
    [
        (Nameless, "index_of must have the index of each agent that lives, but lacks ["),
        (partial(Nameless, first_step=2), "] in step 2; its names are []; the view of an agent without one would be"),
        (Renumbered, "lives on in step 5, but its id changes from "),
        (Swapped, "each name must have the index of its own agent"),
    ],
)
def test_names_that_go_wrong_are_found(reader: Any, sentence: str):
    assert reader_problems(Swarm(), SwarmReader) == []
    problems = reader_problems(Swarm(), reader)
    assert any(sentence in line for line in problems), problems
    assert all(len(line) < 400 for line in problems)


def test_obedience_is_told_of_the_agents_own_name():
    *_, line = reader_problems(Swarm(), Swapped)
    first, second = [name for name, life in LIVES.items() if life.learns and life.first == 0][:2]
    assert line.startswith(f"the actions of '{first}' move what index_of calls '"), line
    assert f"calls '{first}'" not in line and second in LIVES


class Cut(Pushed):
    """Shows floats in a space of whole numbers, which cuts them."""

    def __init__(self, floats: bool) -> None:
        super().__init__(shift_m=40.0)
        self.observation_space = gym.spaces.Box(0, 255, (2,), np.uint8)
        self.floats = floats

    def _seen(self, found: Any) -> Any:
        number = 1 + self.time % 50
        return np.full(2, number + 0.5) if self.floats else np.full(2, number, np.int64), *found[1:]

    def reset(self, **options: Any) -> Any:
        return self._seen(super().reset(**options))

    def step(self, action: np.ndarray) -> Any:
        return self._seen(super().step(action))


def test_floats_in_a_space_of_whole_numbers_are_found():
    reader = FunctionReader(read_crowd, SPEC)
    assert reader_problems(Cut(floats=False), reader) == []
    (line,) = reader_problems(Cut(floats=True), reader)
    assert "has numbers of type float64, its space uint8, which would cut them, in step 0" in line


def test_actions_that_differ_most_lie_in_the_space():
    space = gym.spaces.Box(200, 250, (2,), np.uint8)
    low, middle, high = extreme_actions(space)
    assert all(space.contains(action) for action in (low, middle, high)) and middle.tolist() == [225, 225]


def test_an_ego_that_sees_nobody_is_told():
    near = replace(SPEC, perception_m=0.5)
    problems = reader_problems(Crowd(), FunctionReader(read_crowd, near), episodes=2, max_steps=5)
    (line,) = (p for p in problems if "perception_m" in p)
    assert line.startswith("no other agent is ever within perception_m=0.5 m of the ego, the nearest is ")
    assert reader_problems(Crowd(), FunctionReader(read_crowd, SPEC), episodes=2, max_steps=5) == []


def test_positions_that_a_recording_would_round_are_told():
    far = with_states(lambda states: states + np.array([500_000.0, 5_400_000.0, 0.0, 0.0]))
    (line,) = reader_problems(Crowd(), far, episodes=2, max_steps=5)
    assert line.startswith("recordings of states: y_m lies up to 54000")
    assert line.endswith("float32 has steps of 0.5; subtract one fixed point of the map from all positions")


@pytest.mark.parametrize("numbers", [{"episodes": 0}, {"max_steps": 0}, {"episodes": 1.5}, {"max_steps": True}])
def test_there_must_be_a_step_to_look_at(numbers: dict[str, Any]):
    (name,) = numbers
    with pytest.raises(UserError, match=f"{name} must be a whole number from 1 on, got"):
        check_reader(make_env("highway-fast-v0"), **numbers)
