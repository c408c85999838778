import json
import math
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import gymnasium as gym
import numpy as np
import pytest

from agents.runs import save_model
from agents.task import Observe, Task, task_of
from agents.training import TrainingPlan, make_model
from agents.vec_envs import make_venv
from envs import ForecastObservation, make_env, readers
from envs.arms import ARMS
from envs.drivers.trained import env_for_driver, parallel_env_for_driver
from envs.readers import register_reader
from envs.readers.base import MultiagentScene, pad_multiagent_scene
from envs.registry import make_multiagent_env
from predictor.checkpoint import WEIGHTS, resolve
from predictor.scene import Scene, SceneSpec
from predictor.support.errors import UserError
from tests.agents.helpers import LIVES, TOY, Meadow
from tests.envs.helpers import HIGHWAY_SPEC, save_tiny

TAG = "simple_tag_v3"


@pytest.fixture
def without_envpool(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agents.task.importlib.util.find_spec", lambda name: None)


@pytest.mark.parametrize(
    ("env_id", "settings", "message"),
    [
        ("highway-mixed-v0", {"backend": "envpool"}, "EnvPool has no copy of 'highway-mixed-v0'; it has highway-v0, "),
        ("nonsense", {"backend": "envpool"}, "EnvPool has no copy of 'nonsense'"),
        (TAG, {"backend": "envpool"}, f"backend envpool has no {TAG}; leave it out"),
        ("highway-fast-v0", {"backend": "envpool", "observe": "oracle"}, "observe=oracle and what_if=False do not fit"),
        ("highway-fast-v0", {"backend": "envpool", "what_if": True}, "makes no plans and cannot be copied"),
        ("highway-fast-v0", {"learners": ("adversary",)}, "highway-fast-v0 has one ego; leave learners out"),
        ("nowhere:Env-v0", {"learners": ("one",)}, "cannot import 'nowhere' for 'nowhere:Env-v0': No module named"),
        (TAG, {"driver": "fast"}, "driver must be one of random, idle, varied, heuristic, mixed, got 'fast'"),
        (TAG, {"observe": "none", "checkpoint": "highway"}, "has no effect with observe=none"),
        (TAG, {"observe": "none", "sizes_of": "simple-tag"}, "sizes_of has no effect with observe=none"),
        (TAG, {"observe": "zeros", "sizes_of": "constant-velocity"}, "'constant-velocity' has no sizes of its own"),
        (
            TAG,
            {"checkpoint": "own:a:b", "sizes_of": "s3://bucket/ck"},
            "are both imported or fetched; copy that of siz",
        ),
        (TAG, {"observe": "zeros", "sizes_of": "own:my:forecaster"}, "'own:my:forecaster' has no sizes of its own"),
        (TAG, {"what_if": True}, f"what_if needs an environment with one ego, {TAG} has several learners"),
        ("merge-v1", {"env_kwargs": "{"}, "env_kwargs must be a JSON object, got '{': .*Expecting.*; write '"),
        ("merge-v1", {"env_kwargs": "[1]"}, r"env_kwargs must be a JSON object, got '\[1\]'"),
        (
            "highway-fast-v0",
            {"env_kwargs": '{"a": 1}', "backend": "envpool"},
            "env_kwargs are for the gymnasium backend",
        ),
        ("merge-v1", {"num_samples": 0}, "num_samples must be at least 1, got 0"),
        (
            "merge-v1",
            {"num_samples": 10_000, "horizon_steps": 10_000},
            "horizon_steps times num_samples=100,000,000 needs at least",
        ),
        (TAG, {"device": "tpu9"}, "device must be cpu, cuda or auto, got 'tpu9'"),
    ],
)
def test_what_does_not_go_together_is_named(env_id: str, settings: dict, message: str):
    with pytest.raises(UserError, match=message) as error:
        Task(env_id, **settings)
    assert "\n" not in str(error.value)


def test_a_missing_envpool_is_named(without_envpool: None):
    with pytest.raises(UserError, match=r"needs the envpool package; pip install 'dgvae-rl\[envpool\]'"):
        Task("highway-fast-v0", backend="envpool")


def test_a_missing_envpool_does_not_matter_to_other_backends(without_envpool: None):
    assert Task("highway-fast-v0").backend == "gymnasium"


def test_one_ego_or_many_learners():
    assert Task(TAG).is_multiagent
    assert Task(TOY).is_multiagent
    assert not Task("highway-fast-v0").is_multiagent


def test_what_the_wrappers_get():
    assert Task(TAG, "constant-velocity").forecaster == "constant-velocity"
    assert Task(TAG, checkpoint="somewhere").forecaster == "somewhere"
    assert Task(TAG).forecaster is None


def test_the_check_gives_the_action_space_of_the_learners():
    assert Task(TAG, "constant-velocity", learners=("adversary",)).check()[1] == gym.spaces.Discrete(5)
    speaker, listener = (Task("simple_speaker_listener_v4", "none", learners=(name,)) for name in ("speaker_0", "all"))
    assert speaker.check()[1] == gym.spaces.Discrete(3)
    with pytest.raises(UserError, match="learners: 'all' is neither an agent nor a role"):
        listener.check()


def test_the_check_finds_drivers_that_cannot_drive():
    assert Task(TOY, "none").check()[1] == gym.spaces.Discrete(2)  # all agents learn
    assert Task(TOY, "none", learners=("ant",), driver="varied").check()[1] == gym.spaces.Discrete(2)
    with pytest.raises(UserError, match="no heuristic drives meadow_v0"):
        Task(TOY, "none", learners=("ant",)).check()
    everybody = tuple(make_multiagent_env(TAG).possible_agents)
    with pytest.raises(UserError, match="driver drives the agents that do not learn, and all of .* do; name fewer"):
        Task(TAG, "none", learners=everybody, driver="random").check()


def test_the_check_needs_a_reader_for_forecasts():
    with pytest.raises(UserError, match="no scene reader knows meadow_v0"):
        Task(TOY, "constant-velocity").check()


def test_arguments_reach_the_environment():
    task = Task("highway-fast-v0", "none", env_kwargs='{"config": {"lanes_count": 2}}')
    env = task.make()
    assert env.unwrapped.config["lanes_count"] == 2
    env.close()


def test_every_arm_can_be_trained_on():
    assert set(get_args(Observe)) == {"none", "constant-velocity", *ARMS}


@pytest.mark.parametrize("env_id", ["highway-fast-v0", TAG])
def test_every_arm_has_the_same_space(env_id: str):
    arms = ("forecast", "zeros", "single", "no-edges", "edges-only", "constant-velocity")
    spaces = []
    for arm in arms:
        env = Task(env_id, arm).wrapped(Task(env_id, arm).make())
        spaces.append(env.observation_space(env.possible_agents[0]) if env_id == TAG else env.observation_space)
        env.close()
    assert all(space == spaces[0] for space in spaces)


@pytest.mark.slow
def test_another_scenes_forecasts_have_the_sizes_of_the_other_arms(tmp_path: Path):
    """The checkpoint forecasts fewer steps than the one that ships, by which the observation is laid out."""
    short = save_tiny(tmp_path / "short", HIGHWAY_SPEC)
    found = {}
    for arm in ("single", "shuffled"):
        env = Task("highway-fast-v0", arm, short).wrapped(Task("highway-fast-v0", arm, short).make())
        observations = [env.reset(seed=seed)[0]["forecast"] for seed in range(6)]
        found[arm] = np.abs(np.stack(observations)).max(axis=(0, 1, 3))
        env.close()
    assert found["single"].shape == found["shuffled"].shape
    assert found["single"].min() > 0 and found["shuffled"].min() > 0


def test_every_arm_has_the_sizes_of_the_checkpoint_that_is_named(tmp_path: Path):
    """Also arms with forecasters of other sizes: fewer edges, fewer steps."""
    spec = replace(HIGHWAY_SPEC, max_agents=4, perception_m=50.0)
    large = save_tiny(tmp_path / "large", spec, num_edge_types=4)
    tasks = [
        Task("highway-fast-v0", "forecast", large),
        Task("highway-fast-v0", "forecast", large, sizes_of=large),
        *(Task("highway-fast-v0", arm, sizes_of=large) for arm in ("zeros", "constant-velocity", "no-edges")),
        Task("highway-fast-v0", "zeros", large, sizes_of=large),
    ]
    spaces = [task._forecasts()[0] for task in tasks]
    assert spaces[0]["edge_probs"].shape == (3, 2 * 3)
    assert all(space == spaces[0] for space in spaces)
    for arm in ("forecast", "single"):
        with pytest.raises(UserError, match="edges of 4 types with .* observation room for 2 with .*sizes_of"):
            Task("highway-fast-v0", arm, large, sizes_of="highway").check()
    Task("highway-fast-v0", "no-edges", large, sizes_of="highway").check()  # shows no edges


def test_the_sizes_of_a_checkpoint_that_was_replaced_are_read_anew(tmp_path: Path):
    name = save_tiny(tmp_path / "sizes", HIGHWAY_SPEC, num_edge_types=4)
    before = Task("highway-fast-v0", "zeros", sizes_of=name)._forecasts()[0]
    save_tiny(tmp_path / "sizes", HIGHWAY_SPEC, num_edge_types=3)
    os.utime(tmp_path / "sizes" / WEIGHTS, ns=(1, 1))  # clocks of file systems are coarse
    after = Task("highway-fast-v0", "zeros", sizes_of=name)._forecasts()[0]
    assert (before["edge_probs"].shape[-1], after["edge_probs"].shape[-1]) == (2 * 3, 2 * 2)


def test_the_note_of_an_arm_gives_its_wrapper_back(tmp_path: Path):
    """A policy that was trained on an arm sees that arm wherever it drives."""
    task = Task("merge-v1", "modes", num_samples=3, what_if=True)
    path = tmp_path / "policy.zip"
    venv = make_venv(task, 1)
    save_model(make_model(TrainingPlan(task, "ppo", steps=1, num_envs=1, seed=0), venv), path, note=task.note)
    venv.close()
    env = env_for_driver(make_env("merge-v1"), str(path))
    assert isinstance(env, ForecastObservation) and env.stream.config.arm.name == "modes"
    env.reset(seed=0)
    seen, *_ = env.step(1)
    assert seen["mode_probs"].shape == (len(seen["valid"]), 3) and seen["mode_probs"][0].all()
    assert "what_if_risk" in seen and not seen["what_if_risk"].any()
    env.close()


def test_a_run_of_an_older_version_has_the_old_options():
    old = {"env_id": "merge-v1", "observe": "forecast", "checkpoint": None}
    assert task_of(old) == Task("merge-v1")
    options = {"num_samples": 6, "what_if": True, "env_kwargs": "{}", "horizon_steps": 4, "perception_m": 30.0}
    assert task_of({**old, "observe": "modes", **options}) == Task("merge-v1", "modes", **options)


@pytest.mark.parametrize("env_id", ["highway-fast-v0", TAG])
@pytest.mark.parametrize("observe", ["forecast", "zeros", "constant-velocity"])
def test_perception_limits_what_is_seen(env_id: str, observe: Any):
    seen = []
    for perception_m in (None, 0.4 if env_id == TAG else 25.0):
        task = Task(env_id, observe, perception_m=perception_m)
        venv = make_venv(task, 1)
        venv.seed(0)
        obs: Any = venv.reset()
        distances_m = np.linalg.norm(obs["agents"][..., :2], axis=-1)[obs["valid"] > 0]
        assert len(distances_m) and (perception_m is None or distances_m.max() <= perception_m)
        seen.append(len(distances_m))
        pin = task.note.forecaster
        assert pin is not None and perception_m in (None, pin.perception_m), "the policy's file tells it"
        venv.close()
    assert seen[0] > seen[1]


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("what_if", "no", "what_if must be true or false, got 'no'"),
        ("num_samples", 1.5, "num_samples must be a whole number, got 1.5"),
        ("num_samples", "3", "num_samples must be a whole number, got '3'"),
        ("env_kwargs", {"config": {}}, "env_kwargs must be a text, got {'config': {}}"),
    ],
)
def test_values_of_other_types_are_refused(field: str, value: Any, message: str):
    with pytest.raises(UserError, match=f"^{message}$"):
        Task("merge-v1", **{field: value})


def test_perception_must_be_positive_and_have_an_effect():
    with pytest.raises(UserError, match="perception_m must be positive, got -1"):
        Task("merge-v1", perception_m=-1.0)
    with pytest.raises(UserError, match="perception_m has no effect with observe=none; leave one out"):
        Task("merge-v1", "none", perception_m=20.0)


# --- A run's config imports nothing -----------------------------------------------------------------------------------

RUN = {"env_id": "merge-v1", "observe": "forecast", "checkpoint": None}


def test_a_config_that_does_not_fit_is_named_with_its_file():
    """Its values were no options of the command that reads it."""
    run = RUN | {"observe": "none", "perception_m": 20.0}
    with pytest.raises(UserError, match="^runs/old/config.json: perception_m has no effect with observe=none"):
        task_of(run, where="runs/old/config.json")


@pytest.mark.parametrize("learners", [("nobody",), ("agent_0", "adversary_0", "adversary_1", "adversary_2")])
def test_what_does_not_fit_leaves_no_environment_open(learners: tuple[str, ...], monkeypatch: pytest.MonkeyPatch):
    task, closed = Task(TAG, "none", learners=learners, driver="random"), []
    env = task.make()
    monkeypatch.setattr(env, "close", lambda: closed.append(True))
    monkeypatch.setattr(Task, "make", lambda *_, **__: env)
    with pytest.raises(UserError, match="nobody|leave driver out"):
        task.check()
    assert closed


@pytest.fixture
def foreign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A module that can be imported and says so."""
    (tmp_path / "foreign_envs.py").write_text("import gymnasium\n\nclass Road(gymnasium.Env):\n    pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield "foreign_envs"
    sys.modules.pop("foreign_envs", None)


@pytest.mark.parametrize("observe", ["none", "forecast"])
def test_a_run_imports_only_what_the_command_line_names(foreign: str, observe: str):
    run = RUN | {"env_id": f"{foreign}:Road", "observe": observe}
    for trusted in (None, "highway-v0", f"{foreign}:Other"):
        with pytest.raises(UserError, match=f"imports code; if you trust it, .* --env-id {foreign}"):
            task_of(run, trusted=trusted)
    assert foreign not in sys.modules
    assert task_of(run | {"observe": "none"}, trusted=f"{foreign}:Road").env_id == f"{foreign}:Road"
    assert foreign in sys.modules


def test_a_run_imports_no_forecaster_that_the_command_line_does_not_name(foreign: str):
    own = f"own:{foreign}:Road"
    run = RUN | {"env_id": "merge-v1", "observe": "forecast", "checkpoint": own}
    for trusted in (None, "highway", f"own:{foreign}:Other"):
        with pytest.raises(UserError, match=f"forecaster '{own}' imports code; .* with --checkpoint {own}"):
            task_of(run, trusted_forecaster=trusted)
    assert foreign not in sys.modules
    assert task_of(run, trusted_forecaster=own).checkpoint == own


@pytest.mark.parametrize("key", ["checkpoint", "sizes_of"])
def test_a_run_fetches_no_checkpoint_that_the_command_line_does_not_name(key: str):
    there = "s3://bucket/checkpoint"
    run = RUN | {"env_id": "merge-v1", "observe": "forecast", "checkpoint": "merge", key: there}
    for trusted in (None, "highway", "s3://bucket/other"):
        with pytest.raises(UserError, match=f"would be fetched from '{there}'; .* with --checkpoint {there}"):
            task_of(run, trusted_forecaster=trusted)
    assert getattr(task_of(run, trusted_forecaster=there), key) == there


def test_arguments_of_a_run_name_no_foreign_class(foreign: str):
    """highway-env imports the class of other_vehicles_type, so a run's config must not choose it freely."""
    kwargs = {"config": {"other_vehicles_type": f"{foreign}.Road"}}
    with pytest.raises(UserError, match=rf"name '{foreign}.Road', which the environment could import"):
        task_of(RUN | {"env_kwargs": json.dumps(kwargs)})
    for near in (f"{foreign}.Road and more", f"{foreign}.Road-", f"{foreign}:Road!", f" {foreign}.Road"):
        with pytest.raises(UserError, match="which the environment could import"):
            task_of(RUN | {"env_kwargs": json.dumps({"config": {"other_vehicles_type": near}})})
    assert foreign not in sys.modules
    own = {"config": {"other_vehicles_type": "highway_env.vehicle.behavior.IDMVehicle", "note": "half of all"}}
    assert task_of(RUN | {"env_kwargs": json.dumps(own)}).make_kwargs == own


def test_unbounded_perception_is_a_task_of_a_policys_note():
    """An environment of one's own may show agents from anywhere; a policy that was trained there says so in its zip."""
    assert (
        Task("CartPole-v1", "forecast", checkpoint="constant-velocity", perception_m=math.inf).perception_m == math.inf
    )
    with pytest.raises(UserError, match="perception_m must be positive, got -1"):
        Task("CartPole-v1", "forecast", checkpoint="constant-velocity", perception_m=-1.0)


def test_sizes_serve_an_arm_that_shows_no_forecast_where_no_checkpoint_ships():
    assert Task("parking-v0", "zeros", sizes_of="highway").forecaster == "highway"
    assert Task("parking-v0", "single", sizes_of="highway").forecaster is None
    assert Task("merge-v1", "zeros", sizes_of="highway").forecaster is None, "the one that ships"


@pytest.mark.parametrize("env_id", ["highway-fast-v0", "simple_tag_v3"])
def test_the_check_finds_own_entries_that_have_the_name_of_added_ones(env_id: str, monkeypatch: pytest.MonkeyPatch):
    task, space = (
        Task(env_id, "none"),
        gym.spaces.Dict({"agents": gym.spaces.Box(0, 1, (2,)), "place": gym.spaces.Box(0, 1, (2,))}),
    )
    env = task.make()
    monkeypatch.setattr(Task, "make", lambda self: env)
    task.check()
    of_agents = (lambda agent: space) if task.is_multiagent else space
    monkeypatch.setattr(env, "observation_space", of_agents)
    with pytest.raises(UserError, match="has an entry 'agents', as forecasts have; if it is wrapped"):
        task.check()


# --- How far agents see -----------------------------------------------------------------------------------------------


def near_sighted(tmp_path: Path) -> str:
    """A copy of `simple-tag` that was trained with a range of 0.5 m."""
    folder = tmp_path / "near"
    shutil.copytree(resolve("simple-tag"), folder)
    config = folder / "config.json"
    config.write_text(config.read_text().replace('"perception_m": 1000.0', '"perception_m": 0.5'))
    return str(folder)


def seen_by(task: Task) -> dict[str, list[float]]:
    with closing(task.wrapped(task.make())) as env:
        return {agent: seen["valid"].tolist() for agent, seen in env.reset(seed=3)[0].items()}


def test_a_pettingzoo_policy_sees_as_far_where_it_drives_as_in_training(tmp_path: Path):
    task = Task("simple_tag_v3", "forecast", checkpoint=near_sighted(tmp_path))
    assert task.note.forecaster is not None and task.note.forecaster.perception_m == 0.5
    model = make_model(TrainingPlan(task, "ppo", 200, 1, 0), make_venv(task, 1), None)
    save_model(model, tmp_path / "policy.zip", note=task.note)
    env = parallel_env_for_driver(make_multiagent_env("simple_tag_v3"), str(tmp_path / "policy.zip"))
    seen = {agent: each["valid"].tolist() for agent, each in env.reset(seed=3)[0].items()}
    assert seen == seen_by(task) and seen != seen_by(Task("simple_tag_v3", "forecast"))


def test_pettingzoo_arms_of_one_size_see_the_same_agents(tmp_path: Path):
    near = near_sighted(tmp_path)
    expected = seen_by(Task("simple_tag_v3", "forecast", checkpoint=near))
    for observe in ("zeros", "constant-velocity"):
        assert seen_by(Task("simple_tag_v3", observe, sizes_of=near)) == expected


class MeadowReader:
    """Both animals, a metre apart; a registered reader does not know of `perception_m`."""

    spec = SceneSpec(dt_s=0.1, has_ego=False, max_agents=len(LIVES))

    def __init__(self, env: Any) -> None:
        pass

    def reset(self) -> None:
        pass

    def read(self, env: Any) -> MultiagentScene:
        states = np.array([[0.0, place, 1.0, 0.0] for place in range(len(LIVES))])
        scene = Scene(states, np.arange(len(LIVES)), np.ones(len(LIVES), dtype=np.bool_))
        present = {name: i for i, name in enumerate(LIVES) if name in env.unwrapped.agents}
        return pad_multiagent_scene(scene, present, np.zeros(len(LIVES)), self.spec)


def test_the_range_of_a_view_is_kept_where_the_reader_has_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(readers, "_REGISTERED", dict(readers._REGISTERED))
    register_reader(Meadow, MeadowReader)
    task = Task(TOY, "constant-velocity", perception_m=0.5, driver="random")
    assert set(map(tuple, seen_by(task).values())) == {(0.0,)}
    save_model(
        make_model(TrainingPlan(task, "ppo", 200, 1, 0), make_venv(task, 1), None), tmp_path / "p.zip", note=task.note
    )
    env = parallel_env_for_driver(Meadow(), str(tmp_path / "p.zip"))
    assert {agent: each["valid"].tolist() for agent, each in env.reset(seed=3)[0].items()} == seen_by(task)
