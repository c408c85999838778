import functools
import subprocess
import sys
import types
from typing import Any

import gymnasium as gym
import numpy as np
import pettingzoo
import pytest
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper

from envs import readers
from envs.parallel import ForecastParallelEnv
from envs.readers import multiagent_env_id, multiagent_reader_for, reader_for, register_reader
from envs.readers.base import MultiagentReader, Reader
from envs.readers.mpe import MpeReader
from envs.readers.pursuit import PursuitReader
from envs.registry import MULTIAGENT_CHECKPOINTS, MULTIAGENT_IDS, checkpoint_for, is_multiagent_id, make_multiagent_env
from predictor.scene import SceneSpec
from predictor.support.errors import UserError

HIGHWAY = [env_id for env_id in MULTIAGENT_IDS if env_id.startswith("intersection")]
SIMULATED = [env_id for env_id in MULTIAGENT_IDS if env_id not in HIGHWAY]


class Walk(ParallelEnv):
    """Two agents on a line."""

    metadata: dict[str, Any] = {"name": "walk_v0"}
    possible_agents = ["left", "right"]

    def __init__(self, length: int = 3) -> None:
        if length < 1:
            raise ValueError(f"length must be positive, got {length}")
        self.length = length
        self.agents: list[str] = []

    def action_space(self, agent: str) -> gym.Space:
        return gym.spaces.Discrete(2)


class WalkReader:
    """Reads nothing, but knows what it was asked for."""

    def __init__(self, **asked: Any) -> None:
        self.asked = asked
        self.spec = SceneSpec(dt_s=1.0, has_ego=False)

    def reset(self) -> None:
        pass

    def read(self, env: Any) -> Any:
        return None


class ReadableWalk(Walk):
    """Brings its own reader."""

    def make_scene_reader(self, **kwargs: Any) -> WalkReader:
        return WalkReader(**kwargs)


def make_walk(length: int = 3) -> Walk:
    return Walk(length)


def make_nothing() -> None:
    return None


HERE = types.ModuleType("walks")
HERE.make_walk = make_walk  # type: ignore[attr-defined]
HERE.make_nothing = make_nothing  # type: ignore[attr-defined]
HERE.Walk = Walk  # type: ignore[attr-defined]
HERE.CartPole = gym.Env  # type: ignore[attr-defined]
HERE.number = 3  # type: ignore[attr-defined]


@pytest.fixture(autouse=True)
def walks(monkeypatch: pytest.MonkeyPatch) -> None:
    """An importable module of a third party, and nothing registered."""
    monkeypatch.setitem(sys.modules, "walks", HERE)
    monkeypatch.setattr(readers, "_REGISTERED", {})


# --- Making -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", SIMULATED)
def test_every_id_makes_and_reads(env_id: str):
    assert is_multiagent_id(env_id)
    env = make_multiagent_env(env_id, max_cycles=3)
    assert multiagent_env_id(env) == env_id
    reader = multiagent_reader_for(env)
    assert isinstance(reader, MultiagentReader)
    env.reset(seed=0)
    steps = 0
    while env.agents:
        multi = reader.read(env)
        multi.scene.check(env_id, reader.spec, agents=reader.spec.max_agents)
        assert set(multi.index_of) == set(env.agents)
        env.step(dict.fromkeys(env.agents, 0))
        steps += 1
    assert steps == 3


@pytest.mark.parametrize("env_id", HIGHWAY)
def test_ids_of_highway_env_are_given_to_its_parallel_environment(env_id: str, monkeypatch: pytest.MonkeyPatch):
    class Highway(Walk):
        def __init__(self, env_id: str, **config: Any) -> None:
            self.asked = (env_id, config)

    module = types.ModuleType("envs.simulators.highway_multiagent")
    module.HighwayParallelEnv = Highway  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "envs.simulators.highway_multiagent", module)
    assert is_multiagent_id(env_id)
    env = make_multiagent_env(env_id, duration=9)
    assert isinstance(env, Highway)
    assert env.asked == (env_id, {"duration": 9})


def test_the_intersection_reads():
    env = make_multiagent_env(HIGHWAY[0])
    assert multiagent_env_id(env) == HIGHWAY[0]
    env.reset(seed=0)
    reader = multiagent_reader_for(env, perception_m=40.0)
    assert reader.spec.perception_m == 40.0
    assert set(reader.read(env).index_of) == set(env.agents)


def test_arguments_reach_the_environment():
    env = make_multiagent_env("simple_tag_v3", num_adversaries=5, continuous_actions=True)
    assert len(env.possible_agents) == 6
    assert isinstance(env.action_space("agent_0"), gym.spaces.Box)


@pytest.mark.parametrize("env_id", ["sisl/pursuit_v5", "sisl/pursuit-v5"])
def test_ids_in_pettingzoos_registry(env_id: str):
    assert is_multiagent_id(env_id)
    env = make_multiagent_env(env_id, n_evaders=4)
    assert isinstance(multiagent_reader_for(env), PursuitReader)
    assert env.unwrapped.env.n_evaders == 4


def test_ids_that_a_third_party_registered(monkeypatch: pytest.MonkeyPatch):
    registry = dict(pettingzoo.parallel_registry)
    monkeypatch.setattr("pettingzoo.env_registry.registration.parallel_registry", registry)
    pettingzoo.env_registry.registration._get_registry.cache_clear()
    try:
        pettingzoo.register("parallel", "park/walk-v0", entry_point="walks:make_walk")
        assert is_multiagent_id("park/walk-v0")
        assert make_multiagent_env("park/walk-v0", length=7).length == 7
    finally:
        pettingzoo.env_registry.registration._get_registry.cache_clear()


@pytest.mark.parametrize("path", ["walks:make_walk", "walks:Walk"])
def test_functions_and_classes_of_third_parties(path: str):
    assert is_multiagent_id(path)
    env = make_multiagent_env(path, length=5)
    assert isinstance(env, Walk)
    assert env.length == 5
    assert multiagent_env_id(env) == "walk_v0"


@pytest.mark.parametrize(
    "env_id",
    ["highway-v0", "CartPole-v1", "simple_tag", "nobody/nothing-v0", "a b", "", "walks:CartPole", "walks:number"]
    + ["walks:absent", "absent:make", "highway_env:highway-v0", ":make", "walks:"],
)
def test_other_ids_are_not_parallel(env_id: str):
    assert not is_multiagent_id(env_id)


# --- Errors of making -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("env_id", "kwargs", "message"),
    [
        ("highway-v0", {}, "unknown multiagent env 'highway-v0'; known: simple_v3, .*pursuit_v5.*'module:function'"),
        ("simple_tag_v3", {"bogus": 1}, "cannot make multiagent env 'simple_tag_v3' with {'bogus': 1}: .*'bogus'"),
        ("pursuit_v5", {"bogus": 1}, "cannot make multiagent env 'pursuit_v5' with {'bogus': 1}: .*'bogus'"),
        ("simple_spread_v3", {"local_ratio": 2.0}, "cannot make .*'local_ratio': 2.0}: local_ratio is a proportion"),
        ("walks:make_walk", {"length": 0}, "cannot make .* with {'length': 0}: length must be positive, got 0"),
        ("intersection-multi-agent-v2", {"action": {}}, "cannot make .* with {'action': {}}: KeyError: 'type'"),
        (".walks:make", {}, "cannot import '.walks' for '.walks:make': TypeError: the 'package' argument is required"),
        ("walks:make_nothing", {}, "'walks:make_nothing' must give a pettingzoo ParallelEnv, got NoneType"),
        ("walks:absent", {}, "module 'walks' has no function or class 'absent'"),
        ("walks:number", {}, "module 'walks' has no function or class 'number'"),
        ("absent:make", {}, "cannot import 'absent' for 'absent:make': No module named 'absent'; is its package inst"),
        (":make", {}, "cannot import '' for ':make'"),
    ],
)
def test_what_cannot_be_made_is_named_in_one_line(env_id: str, kwargs: dict[str, Any], message: str):
    with pytest.raises(UserError, match=message) as caught:
        make_multiagent_env(env_id, **kwargs)
    assert "\n" not in str(caught.value)


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "mpe2.simple_tag_v3", None)
    with pytest.raises(UserError, match="cannot import 'mpe2.simple_tag_v3' for .*; is its package installed, or"):
        make_multiagent_env("simple_tag_v3")


def test_a_missing_package_of_pettingzoo_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "pettingzoo.sisl.multiwalker.multiwalker", None)
    with pytest.raises(UserError, match="cannot make multiagent env 'sisl/multiwalker_v9': Failed to import entry"):
        make_multiagent_env("sisl/multiwalker_v9")


@pytest.mark.slow
def test_nothing_needs_mpe2_before_one_of_its_environments_is_made():
    code = (
        "import sys; sys.modules['mpe2'] = None; import envs.drivers.all_agents, envs.readers;"
        "from envs import registry;"
        "registry.is_multiagent_id('simple_tag_v3');"
        "envs.readers.multiagent_env_id(registry.make_multiagent_env('pursuit_v5'))"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


# --- Reading ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("env_id", "kind"), [("simple_tag_v3", MpeReader), ("pursuit_v5", PursuitReader)])
def test_readers_are_picked_by_family_and_told_what_to_see(env_id: str, kind: type):
    env = BaseParallelWrapper(make_multiagent_env(env_id))
    reader = multiagent_reader_for(env, perception_m=0.25, max_agents=50)
    assert isinstance(reader, kind)
    assert (reader.spec.perception_m, reader.spec.max_agents) == (0.25, 50)


def test_a_registered_reader_comes_first_and_holds_for_derived_classes():
    first, second = WalkReader(), WalkReader()
    register_reader(Walk, lambda env: first)
    assert multiagent_reader_for(ReadableWalk()) is first
    assert multiagent_reader_for(BaseParallelWrapper(Walk())) is first
    register_reader(ReadableWalk, lambda env: second)
    assert multiagent_reader_for(ReadableWalk()) is second
    env = make_multiagent_env("simple_tag_v3")
    register_reader(type(env.unwrapped), functools.partial(MpeReader, landmarks=False))
    assert multiagent_reader_for(env).spec.max_agents == 4


def test_an_environment_may_bring_its_own_reader():
    for env in (ReadableWalk(), BaseParallelWrapper(ReadableWalk())):
        assert multiagent_reader_for(env).asked == {}
        assert multiagent_reader_for(env, perception_m=5.0).asked == {"perception_m": 5.0}
        assert multiagent_reader_for(env, 5.0, 4).asked == {"perception_m": 5.0, "max_agents": 4}


class OneEgo(gym.Env):
    """Has one ego, and a reader for it."""


class OneEgoReader(Reader):
    """Reads nothing, for an environment with one ego."""

    def __init__(self, env: Any) -> None:
        super().__init__(SceneSpec(dt_s=1.0))

    def read_all(self, env: Any) -> Any:
        return None


def test_one_registry_serves_both_kinds_of_environments():
    register_reader(OneEgo, OneEgoReader)
    register_reader(Walk, lambda env: WalkReader())
    assert isinstance(reader_for(OneEgo()), OneEgoReader)
    assert isinstance(multiagent_reader_for(Walk()), WalkReader)


@pytest.mark.parametrize("ways", [(Walk, multiagent_reader_for), (OneEgo, reader_for)])
@pytest.mark.parametrize(
    ("make_reader", "message"),
    [
        (lambda env: None, "reader= takes what makes a reader, but <lambda> gives NoneType without spec, reset, read"),
        (lambda env: env.bogus, "reader= takes what makes a reader .*but <lambda> failed with AttributeError"),
        (lambda env: types.SimpleNamespace(spec=1, reset=1, read=1), "must be a SceneSpec, got int"),
    ],
    ids=["nothing", "fails", "spec"],
)
def test_what_is_no_reader_is_refused_for_both_kinds_alike(
    ways: tuple[type, Any], make_reader: Any, message: str, monkeypatch: pytest.MonkeyPatch
):
    env_class, find_reader = ways
    monkeypatch.setitem(readers._REGISTERED, env_class, make_reader)
    with pytest.raises(UserError, match=message):
        find_reader(env_class())


def test_a_registered_reader_of_the_other_kind_is_named():
    register_reader(Walk, OneEgoReader)
    needed = "OneEgoReader: a multiagent .* needs a reader whose spec has has_ego=False, got a OneEgoReader"
    with pytest.raises(UserError, match=needed + ".*read\\(env\\) -> MultiagentScene"):
        multiagent_reader_for(Walk())
    with pytest.raises(UserError, match=needed):
        ForecastParallelEnv(Walk(), "constant-velocity")
    register_reader(OneEgo, lambda env: WalkReader())
    with pytest.raises(UserError, match="one ego needs a reader .*has_ego=True, got a WalkReader with .*multiagent"):
        reader_for(OneEgo())


def test_an_environments_own_reader_is_checked_too():
    class Unreadable(Walk):
        def make_scene_reader(self) -> None:
            return None

    with pytest.raises(UserError, match="make_scene_reader gives NoneType without spec, reset, read"):
        multiagent_reader_for(Unreadable())


def test_ways_to_a_reader_are_named():
    with pytest.raises(UserError, match=r"no scene reader knows walk_v0; pass reader= .*make_scene_reader\(\).*regist"):
        multiagent_reader_for(Walk())


def test_environments_are_named_after_what_they_are():
    tag, spread = make_multiagent_env("simple_tag_v3"), make_multiagent_env("simple_spread_v3")
    assert [multiagent_env_id(env) for env in (tag, spread)] == ["simple_tag_v3", "simple_spread_v3"]
    assert multiagent_env_id(BaseParallelWrapper(tag)) == "simple_tag_v3"
    nameless = Walk()
    nameless.metadata = {}
    assert multiagent_env_id(nameless) == "Walk"


# --- Checkpoints ------------------------------------------------------------------------------------------------------


def test_checkpoints_serve_known_ids():
    assert set(MULTIAGENT_CHECKPOINTS) <= set(MULTIAGENT_IDS)
    assert checkpoint_for("simple_tag_v3") == "simple-tag"
    assert checkpoint_for("simple_spread_v3") == "simple-spread"


def test_ids_without_a_checkpoint_are_named():
    expected = "no checkpoint ships for env 'pursuit_v5'; pass one .*constant-velocity.*simple_tag_v3"
    with pytest.raises(UserError, match=expected):
        checkpoint_for("pursuit_v5")


def test_equal_seeds_give_equal_episodes():
    """No scenario draws from a generator that its seed does not fix."""
    for env_id in SIMULATED:
        env = make_multiagent_env(env_id, max_cycles=6)
        episodes = []
        for disturbance in (0, 1):
            gym.utils.seeding.np_random(disturbance)
            env.reset(seed=5)
            reader, rng, states = multiagent_reader_for(env), np.random.default_rng(5), []
            while env.agents:
                states.append(reader.read(env).scene.states)
                env.step({name: int(rng.integers(env.action_space(name).n)) for name in env.agents})
            episodes.append(np.stack(states))
        np.testing.assert_array_equal(episodes[0], episodes[1], err_msg=env_id)
