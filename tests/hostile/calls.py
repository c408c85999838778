"""Calls of the Python interface with one thing wrong in each, as data: what is called, and what must be named."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from predictor.scene import Scene, SceneBatch, SceneSpec
from tests.hostile.inputs import LONG

NAN, INF = float("nan"), float("inf")
SPEC = SceneSpec(1.0, ("ego", "world"), max_agents=3)


@dataclass(frozen=True)
class Call:
    """A call that must be refused."""

    what: str
    """Name of what is called."""
    name: str
    """What is wrong."""
    call: Callable[[], Any]
    """Makes the call, in a folder of inputs."""
    expected: tuple[str, ...] = ("",)
    """Parts of the message, of which one must be there."""

    @property
    def title(self) -> str:
        """Name of the call."""
        return f"{self.what}: {self.name}"

    def run(self) -> None:
        """Makes the call."""
        self.call()


class Road(gym.Env[Any, Any]):
    """An environment with three cars on lines."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begins an episode."""
        super().reset(seed=seed)
        self.step_number = 0
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> Any:
        """Steps."""
        self.step_number += 1
        return np.zeros(2, np.float32), 0.0, False, False, {}


def good_scene() -> Scene:
    """Returns a scene of two agents and one place that is empty."""
    states = np.array([[0.0, 0, 1, 0], [5, 1, 2, 0], [0, 0, 0, 0]])
    return Scene(states, np.array([7, 9, -1]), np.array([True, True, False]))


def _states(place: Any, value: Any) -> Any:
    states = good_scene().states.copy()
    states[place] = value
    return states


BAD_FIELDS: dict[str, dict[str, Any]] = {
    "states": {
        "None": None,
        "a list": [[0.0] * 4] * 3,
        "whole numbers": np.zeros((3, 4), int),
        "objects": np.full((3, 4), None),
        "texts": np.full((3, 4), "a"),
        "complex": np.zeros((3, 4), complex),
        "one axis": np.zeros(4),
        "three axes": np.zeros((1, 3, 4)),
        "too few rows": np.zeros((2, 4)),
        "too many features": np.zeros((3, 5)),
        "too few features": np.zeros((3, 3)),
        "empty": np.zeros((0, 4)),
        "NaN": _states((1, 0), NAN),
        "NaN of the ego": _states((0, 0), NAN),
        "infinite": _states((1, 2), INF),
        "NaN in padding": _states((2, 0), NAN),
    },
    "ids": {
        "None": None,
        "a list": [7, 9, -1],
        "numbers": np.array([7.0, 9.0, -1.0]),
        "twice": np.array([7, 7, -1]),
        "negative": np.array([7, -2, -1]),
        "texts": np.array(["a", "b", "c"]),
        "too few": np.array([7, 9]),
        "two axes": np.array([[7, 9, -1]]),
        "padding of a valid agent": np.array([7, -1, -1]),
        "booleans": np.ones(3, bool),
    },
    "valid": {
        "None": None,
        "whole numbers": np.array([1, 1, 0]),
        "a list": [True, True, False],
        "too few": np.array([True]),
        "two axes": np.ones((3, 1), bool),
        "no ego": np.array([False, True, False]),
        "nobody": np.zeros(3, bool),
    },
    "heading_rad": {
        "None": None,
        "NaN": NAN,
        "infinite": INF,
        "a text": "north",
        "an array": np.zeros(2),
        "a list": [0],
    },
}
"""Field of a scene → what is wrong → its value."""
NO_SCENES: dict[str, Any] = {
    "None": None,
    "a dict": {"states": 1},
    "an array": np.zeros((3, 4)),
    "a tuple": (1, 2, 3),
    "a class": Scene,
}
"""What is returned in the place of a scene."""


def _raises(error: BaseException) -> Callable[[Any], Scene]:
    def read(env: Any) -> Scene:
        raise error

    return read


def _read_by(wrap: str, read: Callable[[Any], Any]) -> None:
    """Wraps an environment whose reader gives something, and plays two steps."""
    from envs import ForecastObservation, FunctionReader, SceneObservation, VectorForecast

    def observe() -> Any:
        reader = FunctionReader(read, SPEC)
        return SceneObservation(Road(), reader=reader)

    if wrap == "SceneObservation":
        env = observe()
    elif wrap == "ForecastObservation":
        env = ForecastObservation(observe(), "constant-velocity")
    else:
        env = VectorForecast(gym.vector.SyncVectorEnv([observe]), "constant-velocity")
    env.reset(seed=0)
    env.step(np.zeros(1, int) if wrap == "VectorForecast" else 0)


def scenes() -> Iterator[Call]:
    """Yields readers that give what is no scene, behind each wrapper and checked by itself."""
    for field, bad in BAD_FIELDS.items():
        for name, value in bad.items():
            scene = replace(good_scene(), **{field: value})
            yield Call(
                "Scene.check", f"{field} {name}", lambda s=scene: s.check("x", SPEC, 3), (field, "ids", "ego", "states")
            )
            for wrap in ("ForecastObservation", "VectorForecast"):
                yield Call(
                    wrap,
                    f"reader gives {field} {name}",
                    lambda w=wrap, s=scene: _read_by(w, lambda _: s),
                    (field, "ids", "ego", "states"),
                )
    for name, value in NO_SCENES.items():
        for wrap in ("SceneObservation", "ForecastObservation", "VectorForecast"):
            yield Call(wrap, f"reader gives {name}", lambda w=wrap, v=value: _read_by(w, lambda _: v), ("Scene",))


def _observe(**fields: Any) -> None:
    """Lets an `OnlineForecaster` observe a batch of two scenes with some fields changed."""
    from predictor.baselines.constant_velocity import ConstantVelocity
    from predictor.online import OnlineForecaster

    online = OnlineForecaster(ConstantVelocity(SPEC), 2, 3)
    batch = SceneBatch.stack([good_scene(), good_scene()])
    online.observe(batch)
    online.observe(replace(batch, **fields))
    online.forecast(2)


def _batched(values: dict[str, Any]) -> dict[str, Any]:
    found = {}
    for name, value in values.items():
        is_array = isinstance(value, np.ndarray)
        found[name] = np.stack([value, value]) if is_array else value
    return found


def online() -> Iterator[Call]:
    """Yields batches that an `OnlineForecaster` must refuse."""
    for field in ("states", "ids", "valid"):
        for name, value in _batched(BAD_FIELDS[field]).items():
            if name in ("NaN in padding", "booleans", "no ego", "nobody", "empty"):
                continue  # padding is not read, and scenes without an ego are forecast from the world's origin
            yield Call(
                "OnlineForecaster",
                f"{field} {name}",
                lambda f=field, v=value: _observe(**{f: v}),
                ("states", "ids", "valid"),
            )
    for name, count in (("one scene too few", 1), ("one scene too many", 3), ("no scene", 0)):
        batch = SceneBatch.stack([good_scene()] * count) if count else SceneBatch.stack([good_scene()])[np.arange(0)]
        yield Call(
            "OnlineForecaster", name, lambda b=batch: _observe(states=b.states, ids=b.ids, valid=b.valid), ("scenes",)
        )
    for name, bad in _FORECASTS.items():
        yield Call("OnlineForecaster.forecast", name, lambda b=bad: _forecast(**b), tuple(bad))


_FORECASTS: dict[str, dict[str, Any]] = {
    "no steps": {"horizon_steps": -1},
    "half a step": {"horizon_steps": 1.5},
    "steps of letters": {"horizon_steps": "a"},
    "too many steps": {"horizon_steps": 10**12},
    "no sample": {"num_samples": 0},
    "a negative sample": {"num_samples": -1},
    "too many samples": {"num_samples": 10**12},
    "samples of letters": {"num_samples": "a"},
    "a plan of NaN": {"ego_plan": np.full((1, 1, 2, 4), NAN)},
    "a plan of one axis": {"ego_plan": np.zeros(4)},
    "a plan of letters": {"ego_plan": np.full((1, 1, 2, 4), "a")},
    "a plan too long": {"ego_plan": np.zeros((1, 1, 9, 4))},
}


def _forecast(**settings: Any) -> None:
    from predictor.checkpoint import load_checkpoint
    from predictor.online import OnlineForecaster

    model, info = load_checkpoint("highway")
    online = OnlineForecaster(model, 1, 3)
    online.observe(SceneBatch.stack([good_scene()]))
    online.forecast(**({"horizon_steps": 2} | settings))


SETTINGS: dict[str, tuple[Any, ...]] = {
    "checkpoint": (
        "absent",
        "",
        5,
        "fifo",
        "zero",
        "loop",
        "file",
        "file/below",
        LONG,
        Path("absent"),
        "own:absent:x",
        "own:json:loads",
        b"highway",
        {},
        np.zeros(3),
    ),
    "horizon_steps": (-1, 0.5, "a", NAN, 10**12, INF, [3]),
    "num_samples": (0, -1, 1.5, "a", None, 10**12, NAN),
    "perception_m": (-1.0, NAN, "a", 0.0, [5]),
    "max_agents": (-1, 2.5, "a", 10**12, NAN),
    "device": ("tpu", "", 5, "cuda:99", "meta", None),
    "seed": (-1, 1.5, "a", None, 10**40),
    "reader": (5, "json:loads", lambda: None, lambda env: None, print, Scene, object()),
    "what_if": ("yes", 5, object()),
    "arm": ("forecast", 5),
    "forecaster": (5, "highway", object()),
}
"""Argument of the wrappers → values that do not fit."""


def _wrap(wrap: str, **settings: Any) -> None:
    from stable_baselines3.common.vec_env import DummyVecEnv

    from envs import (
        ForecastObservation,
        ForecastParallelEnv,
        SceneObservation,
        VecForecast,
        VectorForecast,
        make_env,
        make_multiagent_env,
    )

    def road() -> gym.Env[Any, Any]:
        return make_env("highway-fast-v0")

    if wrap == "ForecastParallelEnv":
        env: Any = ForecastParallelEnv(make_multiagent_env("simple_tag_v3"), **settings)
    elif wrap == "VecForecast":
        env = VecForecast(DummyVecEnv([lambda: SceneObservation(road())]), **settings)
        env.reset()
        return
    elif wrap == "VectorForecast":
        env = VectorForecast(gym.vector.SyncVectorEnv([lambda: SceneObservation(road())]), **settings)
    else:
        env = {"ForecastObservation": ForecastObservation, "SceneObservation": SceneObservation}[wrap](
            road(), **settings
        )
    env.reset(seed=0)


TAKES = {
    "SceneObservation": ("perception_m", "max_agents", "reader"),
    "ForecastObservation": tuple(SETTINGS),
    "VectorForecast": ("checkpoint", "horizon_steps", "num_samples", "device", "seed", "reader", "what_if", "arm"),
    "VecForecast": ("checkpoint", "horizon_steps", "num_samples", "device", "seed", "reader", "what_if", "arm"),
    "ForecastParallelEnv": (
        "checkpoint",
        "horizon_steps",
        "num_samples",
        "perception_m",
        "max_agents",
        "device",
        "seed",
        "reader",
        "arm",
    ),
}
"""Arguments of each wrapper."""


def wrappers() -> Iterator[Call]:
    """Yields wrappers with an argument that does not fit."""
    for wrap, arguments in TAKES.items():
        for argument in arguments:
            for value in SETTINGS[argument]:
                name = f"{argument}={_shown(value)}"
                yield Call(
                    wrap,
                    name,
                    lambda w=wrap, a=argument, v=value: _wrap(w, **{a: v}),
                    (argument, _shown(value)[:12], "forecaster"),
                )


def _shown(value: Any) -> str:
    text = value if isinstance(value, str) else getattr(value, "__name__", None) or repr(value)
    return text if len(text) < 40 else f"{text[:20]}…"


FILES = (
    "absent",
    "fifo",
    "zero",
    "loop",
    "dangling",
    "file",
    "empty",
    "file/below",
    LONG,
    "",
    "a\0b",
    5,
    None,
    b"x",
    {},
)
"""What is given in the place of a path."""


@cache
def loaders() -> dict[str, Callable[[Any], Any]]:
    """Returns public functions that take a path or a name."""
    import dgvae_rl as public
    from agents.runs import load_model, read_config, read_curve
    from agents.studies.plan import read_study
    from agents.studies.results import read_result
    from predictor.data.store import read_info_of

    return {
        "load_checkpoint": public.load_checkpoint,
        "load_forecaster": lambda path: public.load_forecaster(path, SPEC, "x"),
        "load_policy": public.load_policy,
        "read_store": public.read_store,
        "read_info_of": read_info_of,
        "load_model": lambda path: load_model(path, "ppo"),
        "read_config": lambda path: read_config(Path(path)),
        "read_curve": lambda path: read_curve(Path(path)),
        "read_study": lambda path: read_study(Path(path)),
        "read_result": lambda path: read_result(Path(path)),
        "make_env": public.make_env,
        "make_multiagent_env": public.make_multiagent_env,
    }


def paths() -> Iterator[Call]:
    """Yields functions that load something, given what is none."""
    for name in (
        "load_checkpoint",
        "load_forecaster",
        "load_policy",
        "read_store",
        "read_info_of",
        "load_model",
        "read_config",
        "read_curve",
        "read_study",
        "read_result",
        "make_env",
        "make_multiagent_env",
    ):
        for path in FILES:
            if not isinstance(path, str) and name.startswith("read_c"):
                continue  # `Path` refuses it, no function of ours
            if name == "read_curve" and path == "absent":
                continue  # a training without measurements
            yield Call(name, _shown(path), lambda n=name, p=path: loaders()[n](p))


def values() -> Iterator[Call]:
    """Yields objects that are made from values that do not fit."""
    from predictor.checkpoint import CheckpointInfo
    from predictor.data.store import Episode, StoreInfo, write_store
    from predictor.dgvae.config import DGVAEConfig

    bad: dict[str, tuple[Any, ...]] = {
        "dt_s": (0, -1.0, NAN, INF),
        "frame": (("moon", "world"), ("ego",), ()),
        "feature_names": ((), ("x_m",)),
        "feature_scales": ((0.0,) * 4, (NAN,) * 4, (1.0,), (-1.0,) * 4),
        "perception_m": (0.0, -1.0, NAN),
        "max_agents": (0, -1, 10**12),
        "constant_features": (("x_m",), ("moon",)),
    }
    for field, many in bad.items():
        for value in many:
            make = lambda f=field, v=value: replace(SPEC, **{f: v})  # noqa: E731
            yield Call("SceneSpec", f"{field}={value}", make, (field, "features"))
    states, valid, ids = np.zeros((4, 2, 4), np.float32), np.ones((4, 2), bool), np.arange(2)
    episodes = {
        "none": [],
        "NaN": [Episode(np.full_like(states, NAN), valid, ids)],
        "infinite": [Episode(np.full_like(states, INF), valid, ids)],
        "too few features": [Episode(states[..., :3], valid, ids)],
        "too few ids": [Episode(states, valid, ids[:1])],
        "too few steps of valid": [Episode(states, valid[:2], ids)],
        "no step": [Episode(states[:0], valid[:0], ids)],
        "ids twice": [Episode(states, valid, np.zeros(2, int))],
        "negative ids": [Episode(states, valid, ids - 5)],
        "two axes": [Episode(states[0], valid[0], ids)],
        "a dict": [{"states": states}],
        "None": [None],
    }
    info = StoreInfo(SPEC, "x")
    for name, given in episodes.items():
        yield Call("write_store", f"episodes: {name}", lambda g=given: write_store(Path("new"), info, g))
    config = DGVAEConfig()
    for name, change in {
        "horizon_steps 0": {"horizon_steps": 0},
        "std_m NaN": {"std_m": (NAN,)},
        "std_m too short": {"std_m": (1.0,), "horizon_steps": 2},
    }.items():
        made = {"spec": SPEC, "config": config, "horizon_steps": 1, "std_m": (1.0,), "sources": ("x",)} | change
        yield Call("CheckpointInfo", name, lambda m=made: CheckpointInfo(**m), ("horizon_steps", "std_m"))


def registrations() -> Iterator[Call]:
    """Yields registrations of what is no class or cannot be called."""
    from envs.plans import register_plan_model
    from envs.readers import register_reader

    for what, register in (("register_reader", register_reader), ("register_plan_model", register_plan_model)):
        for name, words in {
            "an object as class": (Road(), lambda env: None),
            "a text as class": ("Road", lambda env: None),
            "None as class": (None, lambda env: None),
            "a number to call": (Road, 5),
            "None to call": (Road, None),
            "a text to call": (Road, "json:loads"),
        }.items():
            yield Call(what, name, lambda r=register, w=words: r(*w), ("class", "call"))
    for key in ("", 5, "a..b", ".", b"x"):
        yield Call(
            "register_reader",
            f"crash_key={key!r}",
            lambda k=key: register_reader(Road, lambda env: None, crash_key=k),
            ("crash_key",),
        )


class _Plans:
    """A plan model that gives what it is told."""

    def __init__(self, given: Any, names: Any = ("a", "b")) -> None:
        self.names, self._given = names, given

    def plans(self, env: Any, horizon_steps: int) -> Any:
        if isinstance(self._given, Exception):
            raise self._given
        return self._given(horizon_steps) if callable(self._given) else self._given


def plans() -> Iterator[Call]:
    """Yields plan models that give what are no plans."""
    given: dict[str, Any] = {
        "None": None,
        "a list": [1],
        "too few plans": lambda n: np.zeros((1, n, 4)),
        "too few steps": lambda n: np.zeros((2, 1, 4)),
        "too few features": lambda n: np.zeros((2, n, 3)),
        "NaN": lambda n: np.full((2, n, 4), NAN),
        "texts": lambda n: np.full((2, n, 4), "a"),
        "an error": ValueError("no lane"),
    }
    for name, value in given.items():
        yield Call("what_if", f"plans are {name}", lambda v=value: _wrap("ForecastObservation", what_if=_Plans(v)))
    for name, names in {"none": (), "a number": 5, "numbers": (1, 2), "twice the same": ("a", "a")}.items():
        yield Call(
            "what_if",
            f"names are {name}",
            lambda v=names: _wrap("ForecastObservation", what_if=_Plans(lambda n: np.zeros((2, n, 4)), v)),
        )


def calls() -> Iterator[Call]:
    """Yields all calls."""
    for source in (scenes, online, wrappers, paths, values, registrations, plans):
        yield from source()
