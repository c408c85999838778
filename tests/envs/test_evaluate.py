import json
import multiprocessing
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from envs import evaluate
from envs.egos import idle_action, make_ego
from envs.evaluate import EvaluateConfig, _episode, _futures, _reduction, _Task, _world_forecast, evaluate_env
from envs.observation import ego_entries
from envs.registry import make_env
from envs.wrappers import SceneObservation
from predictor.accuracy import Outcome, summarise
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.checkpoint import CheckpointInfo, save_checkpoint
from predictor.errors import UserError
from predictor.forecaster import Belief
from predictor.scene import PADDING_ID, Scene, SceneSpec
from tests.envs.helpers import (
    HIGHWAY_SPEC,
    HORIZON,
    SIZES,
    cruising_env,
    play,
    random_forecast,
    random_scenes,
    run_command,
    save_forecast_policy,
    tiny_model,
)

OFFSET_M = torch.tensor([3.0, 4.0])
"""A displacement of exactly 5 m."""


class Drifting(ConstantVelocity):
    """Constant velocity, off by `OFFSET_M` in the first sample, twice that in the second, and so on."""

    def rollout(
        self, belief: Belief, horizon_steps: int, num_samples: int = 1, generator: torch.Generator | None = None
    ) -> torch.Tensor:
        future = super().rollout(belief, horizon_steps, num_samples, generator).clone()
        future[..., :2] += torch.arange(1.0, num_samples + 1)[:, None, None, None] * OFFSET_M
        return future


class InProcessPool:
    """Runs a pool's tasks here, so that what a test replaces is replaced in them too."""

    def __init__(self, processes: int, initializer: Any = None, initargs: Any = ()) -> None:
        assert processes >= 1

    def __enter__(self) -> "InProcessPool":
        return self

    def __exit__(self, *exc: object) -> None:
        pass

    def imap(self, function: Callable[[Any], Any], tasks: Iterable[Any], chunksize: int = 1) -> Iterator[Any]:
        return map(function, tasks)


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(multiprocessing, "get_context", lambda method: SimpleNamespace(Pool=InProcessPool))


@pytest.fixture
def drifting(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every env wrapped from here on is forecast by `Drifting`."""

    def open_drifting(checkpoint: str | None, spec: SceneSpec, source: str, device: str = "cpu") -> Drifting:
        return Drifting(spec, HORIZON)

    monkeypatch.setattr("envs.wrappers.open_forecaster", open_drifting)


def task(env_id: str = "highway-fast-v0", **changes: Any) -> _Task:
    made = _Task(env_id, "constant-velocity", "idle", seed=3, samples=2, horizon_steps=HORIZON, max_steps=6)
    return replace(made, **changes)


# --- Truth ------------------------------------------------------------------------------------------------------------


def scene(*agents: tuple[int, float, float], rows: int = 3) -> Scene:
    """Agents as (id, x, y); padded to `rows`."""
    states, ids, valid = np.zeros((rows, 4)), np.full(rows, -1), np.zeros(rows, dtype=np.bool_)
    for row, (number, x, y) in enumerate(agents):
        states[row, :2], ids[row], valid[row] = (x, y), number, True
    return Scene(states, ids, valid)


def truth(*agents: tuple[int, float, float]) -> Scene:
    return scene(*agents, rows=len(agents))


def test_futures_follow_ids_beyond_perception_until_agents_leave_the_road():
    """Agent 5 leaves perception after the first step and the road after the third; agent 6 enters late."""
    scenes = [
        scene((0, 10, 0), (5, 15, 1)),
        scene((0, 20, 0), (6, 21, 2)),
    ]
    truths = [
        truth((0, 10, 0), (5, 15, 1), (6, 500, 2)),
        truth((0, 20, 0), (6, 21, 2), (5, 400, 1)),
        truth((0, 30, 0), (6, 32, 2), (5, 450, 1)),
        truth((0, 40, 0), (6, 43, 2)),
    ]
    future, valid = _futures(scenes, truths, horizon_steps=3)
    assert valid.tolist() == [
        [[False] * 3, [True, True, False], [False] * 3],  # the ego is not counted
        [[False] * 3, [True, True, False], [False] * 3],  # the episode ends before the third step
    ]
    assert future[0, 1].tolist() == [[390, 1], [440, 1], [0, 0]]  # from where the ego is at that step
    assert future[1, 1].tolist() == [[12, 2], [23, 2], [0, 0]]
    assert (future[~valid] == 0).all()


def test_an_episode_has_the_truth_of_its_last_step():
    """The closing scene is no place to forecast from any more, but it is what earlier forecasts are judged by."""
    env = make_env("u-turn-v1")
    steps = play(env, [idle_action(env)] * 50, seed=3)
    count = len(steps) - 1
    assert steps[-1][2] or steps[-1][3]
    model, baseline = _episode(task("u-turn-v1", seed=3, max_steps=200))
    assert model.forecast.shape[0] == count
    assert model.valid[count - 1, 1:].any(0).tolist() == [True, False, False]
    assert model.valid[count - 2, 1:].any(0).tolist() == [True, True, False]
    assert torch.equal(model.future, baseline.future)
    assert torch.equal(model.valid, baseline.valid)


def test_an_episode_that_is_cut_keeps_its_last_scene():
    model, _ = _episode(task(max_steps=4))
    assert model.forecast.shape[0] == 5
    assert model.valid[3, 1:].any(0).tolist() == [True, False, False]
    assert not model.valid[4].any()


def test_out_of_sight_is_not_out_of_truth():
    """Nobody leaves this road, so whoever is seen has a future up to the episode's end, seen again or not."""
    steps, seed = 8, 2
    env = SceneObservation(make_env("highway-fast-v0"))
    ego = make_ego("random", env, np.random.default_rng(seed))
    played = play(env, [ego(None) for _ in range(steps)], seed)
    seen = [set(obs["scene_ids"].tolist()) for obs, *_ in played]
    assert any(before - after - {PADDING_ID} for before, after in pairwise(seen))  # some are lost from sight
    model, _ = _episode(task(seed=seed, ego="random", max_steps=steps))
    assert len(model.valid) == len(seen) == steps + 1
    for t in range(steps):
        known = model.valid[t, :, 0]
        assert int(known.sum()) == len(seen[t] - {0, PADDING_ID})
        assert (model.valid[t, known].sum(-1) == min(HORIZON, steps - t)).all()


# --- Forecasts, read out of the observation ---------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_the_way_back_undoes_the_ego_view(seed: int):
    """For rows in any order, with gaps, and any heading."""
    rng = np.random.default_rng(seed)
    scenes = random_scenes(rng, 1, 6)
    forecast = random_forecast(rng, scenes, 3, HORIZON, 2, 4)
    obs = {key: value[0] for key, value in ego_entries(scenes, forecast).items()}
    back = _world_forecast(obs, Scene(scenes.states[0], scenes.ids[0], scenes.valid[0], float(scenes.heading_rad[0])))
    expected = forecast.xy[0] * forecast.valid[0][None, :, None, None]
    expected[:, 0] = 0  # the ego has no entry
    torch.testing.assert_close(back, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("env_id", ["highway-fast-v0", "intersection-v2", "racetrack-v1"])
def test_forecasts_come_back_into_rows_and_world_axes(env_id: str, drifting: None):
    """Whatever the ego's heading and the order of agents: what returns is what the forecaster said."""
    model, straight = _episode(task(env_id))
    assert model.forecast.shape[1] == 2
    seen = model.valid.any(-1)
    assert seen.any()
    for sample in range(2):
        offset = (model.forecast[:, sample] - straight.forecast[:, 0])[seen]
        expected = ((sample + 1) * OFFSET_M).expand_as(offset)
        torch.testing.assert_close(offset, expected, rtol=0, atol=1e-3)


def test_errors_in_closed_form(drifting: None, monkeypatch: pytest.MonkeyPatch):
    """Among cars that hold their speed, constant velocity is right and the drifting forecaster 5 m and 10 m off."""
    monkeypatch.setattr(evaluate, "make_env", lambda env_id, **kwargs: cruising_env(**kwargs))
    model, straight = _episode(task())
    assert summarise("straight", [straight]).min_ade_m == pytest.approx(0.0, abs=1e-3)
    both = summarise("drifting", [model])
    assert both.agents > 5
    assert both.num_samples == 2
    assert both.min_ade_m == pytest.approx(5.0, abs=1e-3)
    assert both.min_fde_m == pytest.approx(5.0, abs=1e-3)
    assert both.by_step_m == pytest.approx([5.0] * HORIZON, abs=1e-3)
    assert both.rmse_m == pytest.approx([7.5] * HORIZON, abs=1e-3)  # of the samples' mean


def test_one_sample_is_the_most_likely_one(drifting: None):
    model, straight = _episode(task(samples=1))
    assert model.forecast.shape[1] == straight.forecast.shape[1] == 1
    seen = model.valid.any(-1)
    offset = (model.forecast - straight.forecast)[:, 0][seen]
    torch.testing.assert_close(offset, OFFSET_M.expand_as(offset), rtol=0, atol=1e-3)


def outcome(error_m: float, agents: int = 2) -> Outcome:
    forecast = torch.zeros(1, 1, agents, HORIZON, 2)
    forecast[..., 0] = error_m
    return Outcome(forecast, torch.zeros(1, agents, HORIZON, 2), torch.ones(1, agents, HORIZON, dtype=torch.bool))


def test_reduction_closed_form():
    assert _reduction([outcome(1.0)] * 3, [outcome(4.0)] * 3) == (0.75, pytest.approx((0.75, 0.75)))
    assert _reduction([outcome(6.0)] * 3, [outcome(4.0)] * 3)[0] == pytest.approx(-0.5)
    # 2 agents at 1 of 4 m, 6 agents at 3 of 4 m: (2 + 18) / 32 is left
    value, (low, high) = _reduction([outcome(1.0), outcome(3.0, 6)], [outcome(4.0), outcome(4.0, 6)])
    assert value == pytest.approx(0.375)
    assert (low, high) == pytest.approx((0.25, 0.75))


# --- Whole runs -------------------------------------------------------------------------------------------------------


def run_config(**changes: Any) -> EvaluateConfig:
    base = {"env_ids": ("two-way-v0",), "checkpoint": "constant-velocity", "episodes": 2, "samples": 3, "workers": 1}
    return EvaluateConfig(**{**base, "max_steps": 6, "horizon_steps": 2, **changes})


def test_constant_velocity_is_its_own_baseline(in_process: None):
    result = evaluate_env(run_config(), "two-way-v0")
    assert result.reduction == pytest.approx(0.0, abs=1e-4)
    assert result.reduction_interval == pytest.approx((0.0, 0.0), abs=1e-4)
    assert (result.checkpoint, result.dt_s) == ("constant-velocity", 1.0)
    for row in (result.model, result.model_samples):
        assert row.agents == result.constant_velocity.agents > 0
        for name in ("min_ade_m", "min_fde_m", "by_step_m", "rmse_m"):
            assert getattr(row, name) == pytest.approx(getattr(result.constant_velocity, name), rel=1e-4)
    assert (result.model.num_samples, result.model_samples.num_samples) == (1, 3)
    assert result.constant_velocity.min_ade_m > 0.1


def test_a_learned_checkpoint_is_measured(in_process: None, tmp_path: Path):
    path = tmp_path / "learned"
    info = CheckpointInfo(HIGHWAY_SPEC, SIZES, HORIZON, std_m=(1.0, 2.0, 3.0))
    save_checkpoint(path, tiny_model(HIGHWAY_SPEC), info)
    config = run_config(checkpoint=str(path), horizon_steps=None)
    result, again = (evaluate_env(config, "two-way-v0") for _ in range(2))
    assert result == again
    assert result.checkpoint == "learned"
    assert len(result.model.by_step_m) == HORIZON
    assert result.model_samples.min_ade_m < result.model.min_ade_m
    assert result.reduction == pytest.approx(1 - result.model.min_ade_m / result.constant_velocity.min_ade_m, rel=1e-4)
    low, high = result.reduction_interval
    assert low <= result.reduction <= high
    assert all(np.isfinite(row.nll).all() and len(row.nll) == HORIZON for row in (result.model, result.model_samples))


def test_a_policy_trained_on_forecasts_drives(in_process: None, tmp_path: Path, highway_checkpoint: str):
    policy = str(save_forecast_policy(tmp_path, "two-way-v0", highway_checkpoint))
    settings = {"checkpoint": highway_checkpoint, "horizon_steps": None}
    driven = evaluate_env(run_config(**settings, ego=policy), "two-way-v0")
    assert driven.model.agents > 0
    assert driven != evaluate_env(run_config(**settings), "two-way-v0")


@pytest.mark.parametrize(
    "changes", [{"checkpoint": "constant-velocity"}, {"horizon_steps": 2}], ids=["edges", "horizon"]
)
def test_a_policy_trained_on_other_forecasts_is_named(
    changes: dict[str, Any], in_process: None, tmp_path: Path, highway_checkpoint: str
):
    """It gets the forecasts that are measured; these have other edges, or fewer steps, than it was trained on."""
    policy = str(save_forecast_policy(tmp_path, "two-way-v0", highway_checkpoint))
    config = run_config(**{"checkpoint": highway_checkpoint, "horizon_steps": HORIZON, "ego": policy, **changes})
    with pytest.raises(UserError, match="policy .*policy.zip was trained on"):
        evaluate_env(config, "two-way-v0")


def test_the_command_writes_json_and_markdown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    """With a real worker process, as a user runs it."""
    out = tmp_path / "results"
    arguments = ["--env-ids", "two-way-v0", "--checkpoint", "constant-velocity", "--episodes", "2", "--samples", "2"]
    arguments += ["--max-steps", "5", "--horizon-steps", "2", "--workers", "1", "--out", str(out)]
    code, errors, output = run_command(evaluate.main, arguments, monkeypatch, capsys)
    assert (code, errors) == (0, [])
    assert "two-way-v0, checkpoint constant-velocity" in output
    assert sorted(p.name for p in out.iterdir()) == ["accuracy.json", "accuracy.md"]
    content = json.loads((out / "accuracy.json").read_text())
    assert content["config"]["episodes"] == 2
    assert content["config"]["seed"] == 900_000
    assert {"command", "commit", "versions", "time"} <= set(content["provenance"])
    (result,) = content["results"]
    assert result["env_id"] == "two-way-v0"
    assert result["reduction"] == pytest.approx(0.0, abs=1e-4)
    assert result["model"]["min_ade_m"] == pytest.approx(result["constant_velocity"]["min_ade_m"], rel=1e-4)
    lines = (out / "accuracy.md").read_text().splitlines()
    assert lines[0].startswith("| env | checkpoint | dt [s] | steps | minADE₁ [m] |")
    assert lines[2].startswith("| two-way-v0 | constant-velocity | 1 | 2 | ")
    assert "### two-way-v0" in lines


def test_episodes_too_short_are_named(in_process: None):
    assert evaluate_env(run_config(max_steps=2, horizon_steps=2), "two-way-v0").model.agents > 0
    with pytest.raises(UserError, match="two-way-v0: no forecast has 3 steps of truth; lower --horizon-steps"):
        evaluate_env(run_config(max_steps=2, horizon_steps=3), "two-way-v0")


ERRORS = {
    "unknown-id": (["--env-ids", "two-way-v0", "nope-v0"], "cannot make env 'nope-v0'"),
    "unknown-checkpoint": (["--checkpoint", "nowhere"], "no checkpoint 'nowhere'"),
    "zero-episodes": (["--episodes", "0"], "episodes must be at least 1, got 0"),
    "zero-samples": (["--samples", "0"], "samples must be at least 1, got 0"),
    "negative-steps": (["--max-steps", "-5"], "max_steps must be at least 1, got -5"),
    "zero-horizon": (["--horizon-steps", "0"], "horizon_steps must be at least 1, got 0"),
    "negative-seed": (["--seed", "-1"], "seed must not be negative, got -1"),
    "unfit-ego": (["--ego", "keep-lane"], "keep-lane needs continuous steering"),
    "too-short": (["--max-steps", "1", "--episodes", "1"], "two-way-v0: no forecast has 5 steps of truth"),
}


@pytest.mark.parametrize("case", ERRORS)
def test_bad_input_is_one_line_and_leaves_nothing(
    case: str, in_process: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    arguments, message = ERRORS[case]
    base = ["--env-ids", "two-way-v0", "--checkpoint", "constant-velocity", "--workers", "1"]
    base += ["--out", str(tmp_path / "results")]
    code, errors, _ = run_command(evaluate.main, [*base, *arguments], monkeypatch, capsys)
    assert code == 2
    assert len(errors) == 1
    assert errors[0].startswith(f"error: {message}")
    assert list(tmp_path.iterdir()) == []


def test_a_checkpoint_of_another_time_step_is_one_line(
    in_process: None, highway_checkpoint: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    arguments = ["--env-ids", "racetrack-v1", "--checkpoint", highway_checkpoint, "--episodes", "1"]
    code, errors, _ = run_command(evaluate.main, arguments, monkeypatch, capsys)
    assert code == 2
    assert len(errors) == 1
    assert "was trained at dt_s=1 but env 'racetrack-v1' steps at dt_s=0.2" in errors[0]
