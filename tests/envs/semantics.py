"""What `test_semantics` runs over: environments of every family with their readers, and how an episode is recorded.

A recorded moment holds what the wrapper showed and, beside it, who stood where by the simulator's own objects. A view
of one ego is kept like that of one learner among many, so that one test serves both.
"""

import importlib.util
import itertools
import weakref
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from pettingzoo import ParallelEnv

from envs.entries import FORECAST_KEYS, PATH_KEYS, UNCERTAINTY_KEYS, ego_entries, path_entries
from envs.multiagent_observation import MultiagentStream
from envs.observation import ForecastStream
from envs.parallel import ForecastParallelEnv
from envs.readers import multiagent_reader_for, reader_for
from envs.readers.base import MultiagentScene, Reader, pad_multiagent_scene
from envs.readers.entities import EntityRowsReader
from envs.readers.function import FunctionReader
from envs.registry import envpool_task_of, make_env, make_multiagent_env
from envs.scene_stream import ForecastConfig
from envs.simulators.envpool import VARIED_SINCE, envpool_release
from envs.wrappers import ForecastObservation
from predictor.checkpoint import CheckpointInfo, save_checkpoint
from predictor.dgvae import DGVAE
from predictor.dgvae import model as dgvae
from predictor.scene import Forecast, Scene, SceneBatch, SceneSpec
from tests.envs.helpers import HORIZON, SIZES, agent_entries

Views = dict[str, dict[str, Any]]
Bodies = list[tuple[Hashable, tuple[float, ...]]]
EGO = "ego"
MODES = 3
"""Number of futures of each agent, all of which a view holds."""
_serials = itertools.count()


def serial(body: Any) -> int:
    """A number for this object alone; unlike id() never reused, and unlike a reference it keeps no agent alive."""
    if not hasattr(body, "serial"):
        body.serial = next(_serials)
    number: int = body.serial
    return number


# --- Toys -------------------------------------------------------------------------------------------------------------

DT_S = 0.5
COLUMNS = ("presence", "x", "y", "vx", "vy", "id", "heading")
TABLE_ROWS = 8


class Walker:
    """Somebody under constant acceleration."""

    def __init__(self, number: int, state: np.ndarray, push: np.ndarray) -> None:
        self.number, self.state, self.push = number, np.array(state, dtype=np.float64), push

    def walk(self) -> None:
        self.state[:2] += self.state[2:] * DT_S + self.push * DT_S**2 / 2
        self.state[2:] += self.push * DT_S

    def succeeded(self, number: int, shift_m: float = 0.0) -> "Walker":
        """Another one, at this one's place and with its motion, who then turns."""
        return Walker(number, self.state + np.array([0, shift_m, 0, 0]), -2 * self.push)


def walkers(rng: np.random.Generator, count: int) -> list[Walker]:
    places = rng.permutation(count) * 9.0 - 4.0 * count
    return [Walker(i, [place, *rng.normal(size=3)], rng.uniform(-1, 1, 2)) for i, place in enumerate(places)]


class Crowd(gym.Env):
    """An ego among walkers. At step 4 one leaves and another appears in its place; at 6 one leaves, at 7 one enters.

    Observation: a table of `COLUMNS`, in another order at each step.
    """

    observation_space = gym.spaces.Box(-np.inf, np.inf, (TABLE_ROWS, len(COLUMNS)), np.float64)
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, shift_m: float = 0.0, duration: int = 9) -> None:
        """The newcomer of step 4 appears `shift_m` beside the leaver."""
        self.shift_m, self.duration = shift_m, duration

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.time = 0
        self.people = walkers(self.np_random, 5)
        return self._table(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.time += 1
        self.people[0].push = np.asarray(action, dtype=np.float64)
        for walker in self.people:
            walker.walk()
        if self.time == 4:
            self.people[2] = self.people[2].succeeded(7, self.shift_m)
        if self.time == 6:
            del self.people[1]
        if self.time == 7:
            self.people.append(Walker(9, [3.0, 25.0, 0.5, -1.0], np.array([0.2, 0.3])))
        return self._table(), 0.0, False, self.time == self.duration, {}

    @property
    def heading_rad(self) -> float:
        return float(np.arctan2(*self.people[0].state[:1:-1]))

    def _table(self) -> np.ndarray:
        table = np.zeros((TABLE_ROWS, len(COLUMNS)))
        for i, walker in enumerate(self.people):
            table[i] = (1.0, *walker.state, walker.number, self.heading_rad)
        table[1:] = table[1 + self.np_random.permutation(TABLE_ROWS - 1)]
        return table


def read_crowd(env: Any) -> Scene:
    """A plain function as a reader."""
    people = env.unwrapped.people
    states = np.array([walker.state for walker in people])
    ids = np.array([walker.number for walker in people], dtype=np.int64)
    return Scene(states, ids, np.ones(len(people), dtype=np.bool_), env.unwrapped.heading_rad)


class CrowdReader(Reader):
    """A reader of one's own, which numbers the environment's objects in the order of first sight."""

    def reset(self) -> None:
        self._ids: weakref.WeakKeyDictionary[Walker, int] = weakref.WeakKeyDictionary()
        self._next = itertools.count()

    def read_all(self, env: Any) -> Scene:
        for walker in env.unwrapped.people:
            if walker not in self._ids:
                self._ids[walker] = next(self._next)
        ids = [self._ids[walker] for walker in env.unwrapped.people]
        return replace(read_crowd(env), ids=np.array(ids, dtype=np.int64))


@dataclass(frozen=True)
class Life:
    first: int = 0
    last: int = 100
    learns: bool = True


LIVES = {
    "stays": Life(),
    "dies": Life(last=4),
    "joins": Life(first=4),  # in the step in which "dies" dies
    "heir": Life(first=5),  # where "dies" would be
    "traffic": Life(learns=False),
    "guest": Life(first=2, last=6, learns=False),
}


class Swarm(ParallelEnv):
    """Learners and traffic that come and go by `LIVES`; actions push the learners."""

    metadata = {"name": "swarm_v0", "render_modes": []}
    render_mode = None

    def __init__(self, duration: int = 9) -> None:
        self.duration = duration
        self.possible_agents = [name for name, life in LIVES.items() if life.learns]
        self.agents: list[str] = []
        box = gym.spaces.Box(-1, 1, (2,), np.float32)
        self.action_spaces = dict.fromkeys(self.possible_agents, box)
        self.observation_spaces = {n: gym.spaces.Box(0, np.inf, (1,), np.float32) for n in self.possible_agents}

    def observation_space(self, agent: str) -> gym.Space:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gym.Space:
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[dict, dict]:
        self.time = 0
        self._cast = dict(zip(LIVES, walkers(np.random.default_rng(seed), len(LIVES)), strict=True))
        self.bodies: dict[str, Walker] = {}
        return self._show()

    def step(self, actions: Mapping[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        self.time += 1
        for name, action in actions.items():
            self.bodies[name].push = np.asarray(action, dtype=np.float64)
        for walker in self.bodies.values():
            walker.walk()
        observations, infos = self._show()
        died = {name: LIVES[name].last == self.time for name in observations}
        over = dict.fromkeys(observations, self.time == self.duration)
        self.agents = [name for name in observations if not (died[name] or over[name])]
        return observations, dict.fromkeys(observations, 0.0), died, over, infos

    def _show(self) -> tuple[dict, dict]:
        if self.time == LIVES["heir"].first:
            self._cast["heir"] = self.bodies["dies"].succeeded(self._cast["heir"].number)
        there = [name for name, life in LIVES.items() if life.first <= self.time <= life.last]
        self.bodies = {name: self.bodies.get(name, self._cast[name]) for name in there}
        self.agents = [name for name in there if LIVES[name].learns]
        shown = {name: np.full(1, self.time, np.float32) for name in self.agents}
        return shown, {name: {} for name in self.agents}


class SwarmReader:
    """All agents; each looks where it walks."""

    spec = SceneSpec(
        dt_s=DT_S, frame=("centroid", "centroid"), has_ego=False, perception_m=1000.0, max_agents=len(LIVES)
    )

    def __init__(self, env: Any) -> None:
        """Nothing to derive."""

    def reset(self) -> None:
        """The numbers are the cast's."""

    def read(self, env: Any) -> MultiagentScene:
        bodies = env.unwrapped.bodies
        states = np.array([walker.state for walker in bodies.values()])
        ids = np.array([walker.number for walker in bodies.values()], dtype=np.int64)
        index_of = {name: i for i, name in enumerate(bodies) if LIVES[name].learns}
        scene = Scene(states, ids, np.ones(len(bodies), dtype=np.bool_))
        return pad_multiagent_scene(scene, index_of, np.arctan2(states[:, 3], states[:, 2]), self.spec)


# --- Who stands where, by the simulators' own objects -----------------------------------------------------------------


def crowd_bodies(env: Any) -> Bodies:
    return [(serial(walker), tuple(walker.state[:2])) for walker in env.unwrapped.people]


def swarm_bodies(env: Any) -> Bodies:
    return [(serial(walker), tuple(walker.state[:2])) for walker in env.unwrapped.bodies.values()]


def highway_bodies(env: Any) -> Bodies:
    inner = getattr(env.unwrapped, "highway", env.unwrapped)
    return [(serial(vehicle), tuple(vehicle.position)) for vehicle in inner.road.vehicles]


def envpool_bodies(env: Any) -> Bodies:
    """EnvPool's list keeps its order within an episode (`test_envpool`), so a place in it is a body."""
    return [(i, (vehicle.x, vehicle.y)) for i, vehicle in enumerate(env.unwrapped.debug_states()[0].vehicles)]


def mpe_bodies(env: Any) -> Bodies:
    """A thing that cannot move but is elsewhere is another thing: a new treasure in an old one's object."""
    there = [entity for entity in env.unwrapped.world.entities if getattr(entity, "alive", True)]
    places = [tuple(map(float, entity.state.p_pos)) for entity in there]
    return [
        ((serial(entity), None if entity.movable else place), place)
        for entity, place in zip(there, places, strict=True)
    ]


def pursuit_bodies(env: Any) -> Bodies:
    grid = env.unwrapped.env
    bodies = [*grid.pursuer_layer.allies, *grid.evader_layer.allies]
    return [(serial(body), tuple(map(float, body.current_position()))) for body in bodies]


# --- Subjects ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Subject:
    """An environment and how it is read."""

    make: Callable[[], Any]
    bodies: Callable[[Any], Bodies]
    """Ids of all agents that are there."""
    near_m: float
    """A perception that leaves an agent out."""
    seed: int = 0
    multiagent: bool = False
    """Whether many learn, with `ForecastParallelEnv`."""
    reader: Callable[[SceneSpec], Any] | None = None
    """From a spec to what makes a reader; None takes the family's."""
    spec: Any = None
    """A `SceneSpec` for `reader`."""
    enters: bool = False
    """Whether an agent comes into sight in the recorded episode."""
    leaves: bool = False
    """Whether an agent goes out of sight."""
    dies: bool = False
    """Whether a learner is gone before the end."""
    sight_m: float = 1000.0
    """Perception in the recorded episode; the default sees all agents."""
    tolerance_m: float = 1e-9
    """Between a scene and the simulator."""


SIZE = 16
"""Size of a scene around one ego in a recorded episode: enough for all agents in sight."""
HIGHWAY = SceneSpec(dt_s=1.0, frame=("ego", "world"))
CROWD = SceneSpec(dt_s=DT_S, frame=("ego", "ego"))
KINEMATICS = {
    "type": "Kinematics", "vehicles_count": 12, "see_behind": True, "normalize": False, "absolute": True,
    "order": "shuffled", "features": list(COLUMNS[:5]),
}  # fmt: skip
SMALL = {"vehicles_count": 8, "lanes_count": 4, "duration": 8}


def highway(env_id: str, **config: Any) -> Callable[[], gym.Env]:
    return partial(make_env, env_id, config=config, disable_env_checker=True)


def envpool_intersection() -> gym.Env:
    """Makes the intersection under its newest version in the EnvPool that is installed: older ones warn."""
    return make_env(f"envpool/{envpool_task_of('intersection-v2')}")


def table_reader(spec: SceneSpec, columns: Sequence[str], gate_m: float) -> EntityRowsReader:
    return EntityRowsReader(tuple(columns), spec, gate_m)


def crowd(reader: Callable[[SceneSpec], Any], shift_m: float = 0.0) -> Subject:
    return Subject(partial(Crowd, shift_m), crowd_bodies, 10.0, 3, False, reader, CROWD, enters=True, leaves=True)


def parallel(env_id: str, **kwargs: Any) -> Callable[[], Any]:
    return partial(make_multiagent_env, env_id, **kwargs)


UNNAMED = ("presence", "x", "y", "vx", "vy", "", "heading")
SUBJECTS: dict[str, Subject] = {
    "highway": Subject(highway("highway-fast-v0", **SMALL), highway_bodies, 60.0),
    "highway-mixed": Subject(highway("highway-mixed-v0", **SMALL), highway_bodies, 60.0),
    "intersection": Subject(
        highway("intersection-v2", duration=11), highway_bodies, 25.0, enters=True, leaves=True, sight_m=60.0
    ),
    "envpool-highway": Subject(
        partial(make_env, "envpool/HighwayFast-v0", vehicles_count=8, duration=8), envpool_bodies, 20.0, 1,
        enters=True, leaves=True, sight_m=30.0,
    ),
    "envpool-intersection": Subject(
        envpool_intersection, envpool_bodies, 25.0, enters=True, sight_m=50.0,
        leaves=envpool_release() >= VARIED_SINCE,  # vehicles leave in Intersection-v2, not in Intersection-v0
    ),
    "table-highway": Subject(
        highway("highway-fast-v0", **SMALL, observation=KINEMATICS), highway_bodies, 60.0,
        reader=partial(table_reader, columns=COLUMNS[:5], gate_m=10.0), spec=HIGHWAY, tolerance_m=1e-3,
    ),
    "table-crowd": crowd(partial(table_reader, columns=UNNAMED, gate_m=3.0), shift_m=12.0),
    "table-crowd-ids": crowd(partial(table_reader, columns=COLUMNS, gate_m=3.0)),
    "function": crowd(partial(FunctionReader, read_crowd)),
    "own-reader": crowd(lambda spec: lambda env: CrowdReader(spec)),
    "tag": Subject(parallel("simple_tag_v3", max_cycles=10), mpe_bodies, 0.8, multiagent=True),
    "spread": Subject(parallel("simple_spread_v3", max_cycles=10), mpe_bodies, 0.8, multiagent=True),
    "treasure": Subject(
        parallel("collect_treasure_v1", num_collectors=5, num_treasures=8, max_cycles=8), mpe_bodies, 0.8, 6,
        multiagent=True, enters=True, leaves=True,
    ),
    "pursuit": Subject(
        parallel("pursuit_v5", x_size=7, y_size=7, n_pursuers=4, n_evaders=6, n_catch=1, surround=False, max_cycles=10),
        pursuit_bodies, 3.0, multiagent=True, leaves=True,
    ),
    "intersection-agents": Subject(
        parallel("intersection-multi-agent-v1", controlled_vehicles=3, initial_vehicle_count=4, duration=8),
        highway_bodies, 30.0, multiagent=True, enters=True, dies=True,
    ),
    "swarm": Subject(
        Swarm, swarm_bodies, 12.0, multiagent=True, reader=lambda spec: SwarmReader, spec=SwarmReader.spec,
        enters=True, leaves=True, dies=True,
    ),
}  # fmt: skip
NEEDS_ENVPOOL = pytest.mark.skipif(importlib.util.find_spec("envpool") is None, reason="needs envpool")


def named(condition: Callable[[Subject], bool] = lambda subject: True) -> Any:
    """Runs a test for each subject of which a condition holds."""
    marks = {name: NEEDS_ENVPOOL if name.startswith("envpool") else () for name in SUBJECTS}
    chosen = [pytest.param(name, marks=marks[name]) for name, subject in SUBJECTS.items() if condition(subject)]
    return pytest.mark.parametrize("name", chosen)


# --- Recording --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Moment:
    """One instant of an episode."""

    multi: MultiagentScene
    """What the forecaster got; with one ego, it is the one agent that has an environment."""
    views: Views
    """The entries that each agent got."""
    forecast: Forecast
    """Behind them."""
    bodies: Bodies
    """Ids of all agents that are there."""

    @property
    def present(self) -> set[int]:
        scene = self.multi.scene
        return set(scene.ids[scene.valid].tolist())


def tiny(spec: SceneSpec) -> DGVAE:
    """Random weights for any number of features, with modes, large enough that the history has a say."""
    scales = tuple(0.1 * scale for scale in spec.feature_scales)
    config = replace(SIZES, delta_scales=scales, num_modes=MODES, rollout_graph="frozen")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = DGVAE(spec, config, HORIZON)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.mul_(2.0)
    return model.eval()


class Session:
    """A subject, wrapped, with a tiny dG-VAE.

    Args:
        subject: what to wrap.
        folder: for the checkpoint.
        sight_m: perception; None takes the recorded episode's.
        size: size of a view, the viewer included; None takes enough for all agents.
    """

    def __init__(self, subject: Subject, folder: Path, sight_m: float | None = None, size: int | None = None) -> None:
        self.subject, bare = subject, subject.make()
        self.env: Any
        sight_m = subject.sight_m if sight_m is None else sight_m
        if subject.multiagent:
            maker = subject.reader and subject.reader(subject.spec)
            spec = (multiagent_reader_for(bare) if maker is None else maker(bare)).spec
            self.model = tiny(spec)
            self.env = ForecastParallelEnv(
                bare, forecaster=self.model, reader=maker, perception_m=sight_m, max_agents=size, num_samples=MODES
            )
        else:
            size = SIZE if size is None else size
            maker = subject.reader and subject.reader(replace(subject.spec, perception_m=sight_m, max_agents=size))
            spec = (reader_for(bare, sight_m, size) if maker is None else maker(bare)).spec
            self.model = tiny(spec)
            save_checkpoint(folder, self.model, CheckpointInfo(spec, self.model.config, HORIZON))
            self.env = ForecastObservation(
                bare, str(folder), reader=maker, perception_m=sight_m, max_agents=size, num_samples=MODES
            )
        self.spec = spec
        self.view = replace(spec, perception_m=sight_m, max_agents=spec.max_agents if size is None else size)

    def play(self, seed: int, steps: int = 100, turn: int | None = None) -> list[Moment]:
        """An episode, or its first steps, with random actions: from step `turn` on, others."""
        moments = [self._moment(self.env.reset(seed=seed)[0])]
        for t in range(steps):
            rng = np.random.default_rng([seed, t, 5 * (turn is not None and t >= turn)])
            moments.append(self._moment(self._step(rng)))
            if self.ended:
                break
        return moments

    def stream(self) -> "Stream":
        """Empty memory."""
        return Stream(self)

    def first_sight(self, multi: MultiagentScene) -> "Stream":
        """Memory of nothing but this scene."""
        stream = Stream(self)
        stream.observe(multi)
        return stream

    def windowed(self, moments: Sequence[Moment]) -> Views:
        """The entries after these moments by the other way: no stream, one window with a column for each stay."""
        multi = moments[-1].multi
        forecast = full_window(self.model, [moment.multi.scene for moment in moments])
        if self.subject.multiagent:
            return agent_entries(multi, forecast, self.view, uncertainty=True)
        scenes = SceneBatch.stack([multi.scene])
        entries = ego_entries(scenes, forecast, uncertainty=True)
        entries |= path_entries(scenes, entries["forecast"], self.model.spec.dt_s)
        return {EGO: {key: value[0] for key, value in entries.items()}}

    def _step(self, rng: np.random.Generator) -> Any:
        if not self.subject.multiagent:
            obs, _, terminated, truncated, _ = self.env.step(draw(self.env.action_space, rng))
            self.ended = bool(terminated or truncated)
            return obs
        obs, *_ = self.env.step({name: draw(self.env.action_space(name), rng) for name in self.env.agents})
        self.ended = not self.env.agents
        return obs

    def _moment(self, seen: Any) -> Moment:
        scene: Any = self.env.scene
        if not self.subject.multiagent:
            scene, seen = MultiagentScene(scene, {EGO: 0}, np.full(len(scene.ids), scene.heading_rad)), {EGO: seen}
        views = {name: {key: view[key] for key in view if key != "observation"} for name, view in seen.items()}
        assert all(set(view) == {*FORECAST_KEYS, *PATH_KEYS, *UNCERTAINTY_KEYS} for view in views.values())
        return Moment(scene, views, self.env.forecast, self.subject.bodies(self.env))


class Stream:
    """The forecaster's memory of one subject, fed by hand."""

    def __init__(self, session: Session) -> None:
        self._multiagent, view = session.subject.multiagent, session.view
        config = ForecastConfig(num_samples=MODES)
        self._stream: Any = (
            MultiagentStream(session.model, session.spec, config, view.perception_m, view.max_agents)
            if self._multiagent
            else ForecastStream(session.model, session.spec, 1, config)
        )

    def observe(self, multi: MultiagentScene) -> Views:
        if self._multiagent:
            views: Views = self._stream.observe(multi)
            return views
        entries = self._stream.observe(SceneBatch.stack([multi.scene]))
        return {EGO: {key: value[0] for key, value in entries.items()}}

    @property
    def forecast(self) -> Forecast:
        forecast: Forecast = self._stream.forecast
        return forecast


def draw(space: gym.Space, rng: np.random.Generator) -> Any:
    if isinstance(space, gym.spaces.Discrete):
        return int(rng.integers(space.n))
    assert isinstance(space, gym.spaces.Box)
    return rng.uniform(space.low, space.high).astype(space.dtype)


def full_window(model: DGVAE, scenes: Sequence[Scene]) -> Forecast:
    """The forecast after these scenes, from one pass over all of them; every stay of an agent has its own column."""
    column: dict[tuple[int, int], int] = {}  # (id, step at which this stay began); the ego's is the first
    began: dict[int, int] = {}
    places: list[list[int]] = []
    for t, scene in enumerate(scenes):
        present = scene.ids[scene.valid].tolist()
        began = {agent: began.get(agent, t) for agent in present}
        places.append([column.setdefault((agent, began[agent]), len(column)) for agent in present])
    states = np.zeros((1, len(scenes), len(column), model.spec.num_features))
    valid = np.zeros(states.shape[:3], dtype=np.bool_)
    for t, (scene, place) in enumerate(zip(scenes, places, strict=True)):
        states[0, t, place], valid[0, t, place] = scene.states[scene.valid], True
    for axis, frame in enumerate(model.spec.frame):
        states[..., axis] -= states[:, :, :1, axis] * valid * (frame == "ego")
    tensor, present_ = torch.from_numpy(states.astype(np.float32)), torch.from_numpy(valid)
    with torch.inference_mode(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(dgvae, "concrete_sample", lambda logits, *_: torch.softmax(logits, dim=-1))
        window = model.window(tensor, present_, torch.tensor([len(scenes) - 1]), HORIZON, num_modes=MODES)
    last, place = scenes[-1], places[-1]
    known, count = np.flatnonzero(last.valid), len(last.valid)
    modes = window.modes
    assert window.prior_logits is not None and window.features is not None
    assert modes is not None and modes.mode_probs is not None and modes.scale is not None
    xy, scale = torch.zeros(1, MODES, count, HORIZON, 2), torch.zeros(1, MODES, count, HORIZON, 2)
    shares = torch.zeros(1, MODES, count)
    probs = torch.zeros(1, count, count, model.num_edge_types)
    features = torch.zeros(1, count, count, model.edge_feature_dim)
    xy[0, :, known] = modes.states[0][:, place, :, :2] - tensor[0, -1, 0, :2] * model.spec.has_ego
    scale[0, :, known], shares[0, :, known] = modes.scale[0][:, place], modes.mode_probs[0][:, place]
    probs[0, known[:, None], known] = window.prior_logits[0, -1][place][:, place].softmax(-1)
    features[0, known[:, None], known] = window.features[0, -1][place][:, place]
    return Forecast(xy, probs, features, torch.from_numpy(last.valid)[None], mode_probs=shares, xy_scale=scale)
