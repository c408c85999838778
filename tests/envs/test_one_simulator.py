"""Simulators of which a process has one at a time (MetaDrive): collection and evaluation take them one by one."""

from pathlib import Path

import pytest

import train_policy
from envs import collect, evaluate
from envs.rollouts.kept_world import close_kept_world
from predictor.data.store import read_store
from predictor.support.reading import read_json
from tests.envs.helpers import run_command
from tests.envs.own_code import ONE_ONLY, OneOnly


@pytest.fixture(autouse=True)
def free(monkeypatch: pytest.MonkeyPatch):
    """No simulator runs in this process, before and after."""
    close_kept_world()
    monkeypatch.setattr(OneOnly, "running", None)
    yield
    close_kept_world()


def test_a_second_one_is_refused():
    first, second = OneOnly(), OneOnly()
    first.reset(seed=0)
    with pytest.raises(RuntimeError, match="an engine in this process already"):
        second.reset(seed=0)
    first.close()
    second.reset(seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_collection_in_one_process_and_in_several(
    workers: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    arguments = ["--env-id", ONE_ONLY, "--out", str(tmp_path / "store"), "--episodes", "5", "--workers", str(workers)]
    code, errors, _ = run_command(collect.main, arguments, monkeypatch, capsys)
    assert (code, errors) == (0, [])
    labels = [episode.label for episode in read_store(tmp_path / "store").episodes]
    assert labels == ["varied", "random", "idle", "varied", "random"]


@pytest.mark.slow
def test_evaluation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture):
    arguments = ["--env-ids", ONE_ONLY, "--checkpoint", "constant-velocity", "--episodes", "3", "--workers", "2"]
    arguments += ["--horizon-steps", "2", "--num-samples", "2", "--out", str(tmp_path)]
    code, errors, _ = run_command(evaluate.main, arguments, monkeypatch, capsys)
    assert (code, errors) == (0, [])
    (result,) = read_json(tmp_path / "accuracy.json")["results"]
    assert result["model"]["agents"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("num_envs", ["1", "2"])
def test_training_of_a_policy(
    num_envs: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    """It trains, measures for selection while the simulator that trains is there, evaluates and films."""
    arguments = ["--env-id", ONE_ONLY, "--observe", "constant-velocity", "--out", str(tmp_path / "run"), "--no-video"]
    arguments += ["--num-envs", num_envs, "--steps", "40", "--set", "n_steps=24", "batch_size=24"]
    arguments += ["--selections", "1", "--selection-episodes", "1", "--eval-episodes", "1"]
    code, errors, printed = run_command(train_policy.main, arguments, monkeypatch, capsys)
    assert (code, errors) == (0, [])
    assert (tmp_path / "run" / "policy.zip").exists()
    assert "train: 48 of 48" in printed, "whole rollouts"
