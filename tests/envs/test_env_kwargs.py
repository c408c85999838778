import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envs import collect, evaluate
from envs.collect import CollectConfig
from envs.registry import make_env
from envs.rollouts import side_forecasts
from envs.rollouts.kept_world import close_kept_world
from envs.rollouts.workers import EpisodePool
from envs.rollouts.world import World, open_world
from predictor.data.store import read_store
from predictor.evaluation.in_env_record import measurements_of
from predictor.support.errors import UserError
from predictor.support.reading import read_json
from tests.envs.helpers import run_command

ROAD = "highway-fast-v0"
TAG = "simple_tag_v3"
FEW = '{"config": {"vehicles_count": 2}}'
PREY = '{"num_adversaries": 1, "num_good": 1, "num_obstacles": 0}'


def config(**changes: Any) -> CollectConfig:
    return CollectConfig(**{"env_id": ROAD, "out": Path("unused"), "workers": 1, "max_steps": 3, **changes})


@pytest.mark.slow
@pytest.mark.parametrize(("env_id", "env_kwargs", "agents"), [(ROAD, FEW, 3), (TAG, PREY, 2)])
def test_a_store_holds_the_changed_environment_and_says_so(
    env_id: str, env_kwargs: str, agents: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
):
    for workers in ("1", "2"):
        out = tmp_path / workers
        arguments = ["--env-id", env_id, "--env-kwargs", env_kwargs, "--out", str(out), "--episodes", "3"]
        arguments += ["--max-steps", "2", "--workers", workers]
        code, errors, _ = run_command(collect.main, arguments, monkeypatch, capsys)
        assert (code, errors) == (0, [])
        store = read_store(out)
        assert store.info.provenance["env_kwargs"] == env_kwargs
        assert {int(e.valid.sum(axis=1).max()) for e in store.episodes} == {agents}


def test_a_store_without_arguments_says_nothing():
    assert "env_kwargs" not in collect._info(config(driver=("idle",), env_kwargs="{}"), 0).provenance


@pytest.mark.parametrize(
    ("env_kwargs", "sentence"),
    [
        ("size=3", "env_kwargs must be a JSON object, got 'size=3'"),
        ("[3]", r"env_kwargs must be a JSON object, got '\[3\]'"),
        ('{"id": "merge-v1"}', "cannot hold its env_id"),
        ('{"render_mode": "rgb_array"}', "env_kwargs cannot hold render_mode, which each command sets"),
        ('{"disable_env_checker": true}', "env_kwargs cannot hold disable_env_checker"),
        ('{"sizes": 3}', "cannot make env 'highway-fast-v0' with {'sizes': 3}: TypeError: .*unexpected keyword"),
        ('{"config": 3}', "cannot make env 'highway-fast-v0' with {'config': 3}: TypeError"),
    ],
)
def test_bad_arguments_are_one_sentence(env_kwargs: str, sentence: str):
    with pytest.raises(UserError, match=sentence):
        list(collect.collect(config(episodes=1, driver=("idle",), env_kwargs=env_kwargs)))


def test_a_bug_of_an_environment_without_arguments_keeps_its_traceback(monkeypatch: pytest.MonkeyPatch):
    def broken(*_: Any, **__: Any) -> None:
        raise KeyError("engine")

    monkeypatch.setattr("envs.registry.gym.make", broken)
    with pytest.raises(KeyError):
        make_env(ROAD, disable_env_checker=True)


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Accuracy of constant velocity on a road with two other vehicles, with a store of such a road as data."""
    folder = tmp_path_factory.mktemp("measured")
    patch = pytest.MonkeyPatch()
    patch.setattr(EpisodePool, "results", lambda self, tasks: map(self._play, tasks))
    try:
        for name, kwargs in (("few", FEW), ("many", "")):
            patch.setattr("sys.argv", _words(collect_into=folder / name, env_kwargs=kwargs))
            collect.main()
        base = ["evaluate", "--env-ids", ROAD, "--checkpoint", "constant-velocity", "--episodes", "2", "--workers", "1"]
        base += ["--max-steps", "4", "--horizon-steps", "2", "--num-samples", "2", "--env-kwargs", FEW]
        patch.setattr("sys.argv", [*base, "--out", str(folder / "out")])
        evaluate.main()
    finally:
        patch.undo()
    return {"folder": folder, **read_json(folder / "out" / "accuracy.json")}


def _words(collect_into: Path, env_kwargs: str) -> list[str]:
    words = ["collect", "--env-id", ROAD, "--out", str(collect_into), "--episodes", "2", "--max-steps", "4"]
    return [*words, "--workers", "1", *(["--env-kwargs", env_kwargs] if env_kwargs else [])]


def test_an_evaluation_says_so(measured: dict[str, Any]):
    (result,) = measured["results"]
    assert (result["env_id"], result["env_kwargs"], measured["config"]["env_kwargs"]) == (ROAD, FEW, FEW)
    text = (measured["folder"] / "out" / "accuracy.md").read_text()
    assert f"### {ROAD} {FEW}, checkpoint constant-velocity, driven varied" in text
    assert f"| {ROAD} {FEW} | constant-velocity |" in text
    assert [m.env_id for m in measurements_of(measured, "constant-velocity")] == [f"{ROAD} {FEW}"]
    assert result["constant_velocity"]["agents"] <= 2 * 2 * 4  # episodes, vehicles, steps


def test_data_of_another_environment_is_no_data_of_this_one(measured: dict[str, Any]):
    few, many = (measured["folder"] / name for name in ("few", "many"))
    same = json.dumps(json.loads(FEW), indent=1)

    def asked(store: Path, kwargs: str = "") -> evaluate.EvaluateConfig:
        return evaluate.EvaluateConfig((ROAD,), kwargs, data=(store,))

    assert evaluate._stores_of(asked(few, same), ROAD) == (str(few),)
    assert evaluate._stores_of(asked(many), ROAD) == (str(many),)
    for store, kwargs in ((few, ""), (many, FEW)):
        with pytest.raises(UserError, match=f"data: no store of {ROAD}"):
            evaluate._stores_of(asked(store, kwargs), ROAD)
    assert np.isfinite(measured["results"][0]["reduction"])


@pytest.mark.slow
@pytest.mark.parametrize(
    "measured_by",
    [
        ["--graph", "--episodes", "3"],
        ["--plans", "--episodes", "3", "--horizon-steps", "2"],
        ["--reactions", "--perturbations", "1", "--most-episodes", "2", "--horizon-steps", "2"],
    ],
)
def test_causes_are_measured_in_the_changed_environment(
    measured_by: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
):
    crowds: list[int] = []

    def opened(env_id: str, driver: str, *arguments: Any, **options: Any) -> World:
        made = open_world(env_id, driver, *arguments, **options)
        crowds.append(made.env.unwrapped.config["vehicles_count"])  # type: ignore[attr-defined]
        return made

    close_kept_world()
    monkeypatch.setattr(EpisodePool, "results", lambda self, tasks: map(self._play, tasks))
    monkeypatch.setattr(side_forecasts, "open_world", opened)
    base = ["--env-ids", ROAD, "--checkpoint", "constant-velocity", "--workers", "1"]
    base += ["--driver", "slower", "--max-steps", "12"]
    crowded = '{"config": {"vehicles_count": 8, "vehicles_density": 1.5}}'
    arguments = [*base, *measured_by, "--env-kwargs", crowded, "--out", str(tmp_path)]
    code, errors, printed = run_command(evaluate.main, arguments, monkeypatch, capsys)
    assert (code, errors, set(crowds)) == (0, [], {8})
    name = measured_by[0].removeprefix("--")
    [result] = read_json(tmp_path / f"{name}.json")["results"]
    assert result["env_kwargs"] == crowded
    assert f"{ROAD} {crowded}" in (tmp_path / f"{name}.md").read_text() and f"{ROAD} {crowded}" in printed


def test_a_driver_that_sees_forecasts_drives_in_the_changed_environment(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(side_forecasts, "sees_forecasts", lambda driver: True)
    world = side_forecasts.open_for_checkpoints(ROAD, "idle", ("constant-velocity",), FEW)
    assert world.env.unwrapped.config["vehicles_count"] == 2  # type: ignore[attr-defined]


def test_plans_that_the_changed_environment_lacks_are_missed_before_hours_of_work(
    monkeypatch: pytest.MonkeyPatch, capsys: Any
):
    monkeypatch.setattr(evaluate, "measure_graph", lambda run: pytest.fail("measured"))
    steered = '{"config": {"action": {"type": "DiscreteAction"}}}'
    arguments = ["--env-ids", ROAD, "--driver", "random", "--graph", "--plans", "--env-kwargs", steered]
    code, errors, _ = run_command(evaluate.main, arguments, monkeypatch, capsys)
    assert code == 2 and "plan" in errors[0]


@pytest.mark.parametrize("measurement", [[], ["--reactions"]])
def test_controls_are_not_fitted_to_the_episodes_that_are_evaluated(
    measured: dict[str, Any],
    measurement: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    few = measured["folder"] / "few"
    (first, *_) = read_store(few).episodes
    words = ["evaluate", "--env-ids", ROAD, "--env-kwargs", FEW, "--checkpoint", "constant-velocity", *measurement]
    monkeypatch.setattr("sys.argv", [*words, "--data", str(few), "--seed", str(first.seed), "--workers", "1"])
    said = rf"few has episodes of 2 of the seeds that are evaluated \(the first: {first.seed}\)"
    with pytest.raises(UserError, match=said):
        evaluate.main()
