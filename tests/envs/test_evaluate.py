import json
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from matplotlib import pyplot as plt
from rich.console import Console

from envs import evaluate
from envs.collect import CollectConfig, collect
from envs.evaluate import EvaluateConfig, evaluate_env
from envs.readers.highway import HighwayReader
from envs.registry import make_env
from envs.rollouts import report
from envs.rollouts.episode import EDGES, MODEL, STRAIGHT, Episode
from envs.rollouts.report import EnvAccuracy
from envs.rollouts.summary import CONTROLS, _graph, _reduction, summarise_episodes
from envs.supervision import EnvironmentFailedError
from predictor.checkpoint import CheckpointInfo, save_checkpoint
from predictor.data.store import StoreInfo, write_store
from predictor.evaluation.outcomes import Outcome
from predictor.evaluation.standard_errors import Estimate
from predictor.scene import SceneSpec
from predictor.support.errors import UserError
from tests.envs.evaluation import TAG, forget, no_processes, read_json, save_tag, tag_spec
from tests.envs.helpers import (
    HIGHWAY_SPEC,
    HORIZON,
    PLURAL,
    SIZES,
    run_command,
    save_forecast_policy,
    save_tiny,
    tiny_model,
)

ROAD = "two-way-v0"
STILL = "constant-velocity"


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    no_processes(monkeypatch)
    forget()
    yield
    forget()


# --- Numbers of given episodes ----------------------------------------------------------------------------------------


def outcome(error_m: float, agents: int = 2) -> Outcome:
    forecast = torch.zeros(1, 1, agents, HORIZON, 2)
    forecast[..., 0] = error_m
    return Outcome(forecast, torch.zeros(1, agents, HORIZON, 2), torch.ones(1, agents, HORIZON, dtype=torch.bool))


def reduced(model: list[Outcome], baseline: list[Outcome]) -> Estimate:
    found = _reduction(model, baseline)
    assert found is not None
    return found


def test_reduction_closed_form():
    assert _reduction([outcome(1.0)] * 3, [outcome(4.0)] * 3) == Estimate(0.75, (0.75, 0.75))
    assert reduced([outcome(6.0)] * 3, [outcome(4.0)] * 3).value == pytest.approx(-0.5)
    # 2 agents at 1 of 4 m, 6 agents at 3 of 4 m: (2 + 18) / 32 is left
    found = reduced([outcome(1.0), outcome(3.0, 6)], [outcome(4.0), outcome(4.0, 6)])
    assert found.value == pytest.approx(0.375)
    assert found.interval == pytest.approx((0.25, 0.75))


def test_forecasts_that_break_off_are_in_no_reduction():
    """They are in none of the errors beside it: shorter ones are smaller."""
    known = torch.ones(1, 2, HORIZON, dtype=torch.bool)
    known[0, 1, -1] = False
    model, straight = outcome(1.0), outcome(4.0)
    model.forecast[:, :, 1, :, 0] = 9.0
    assert reduced([replace(model, valid=known)] * 2, [replace(straight, valid=known)] * 2).value == pytest.approx(0.75)


def test_one_episode_has_no_interval_and_no_error_no_reduction():
    assert _reduction([outcome(1.0)], [outcome(4.0)]) == Estimate(0.75, None)
    assert _reduction([outcome(1.0)] * 2, [outcome(0.0)] * 2) is None


@pytest.mark.parametrize(("errors_m", "shown"), [([1.0], "50 %, –"), ([1.0, 3.0], "50 %, 50 to 50 %"), ([0.0], "–, –")])
def test_the_table_says_what_is_not_defined(errors_m: list[float], shown: str):
    result = summary(HIGHWAY_SPEC, errors_m, [[0.1]] * len(errors_m))
    cells = report._cells(result)
    assert ", ".join(cells[-4:-2]) == shown and len(cells) == len(report.HEADS)
    ((cell,),) = (line.values() for line in report._matrix([result], {}).values())
    assert cell.endswith(f"({shown.split(',')[0]})")


def summary(spec: SceneSpec, errors_m: list[float], latencies_s: list[list[float]], **changes: Any) -> EnvAccuracy:
    episodes = [
        Episode({MODEL: outcome(error), STRAIGHT: outcome(2 * error)}, latencies)
        for error, latencies in zip(errors_m, latencies_s, strict=True)
    ]
    return summarise_episodes("here", STILL, "idle", spec, episodes, **changes)


@pytest.mark.slow
def test_edges_are_measured_averaged_and_cut(tmp_path: Path):
    checkpoint = save_tag(tmp_path / "tag")
    plain, result = (measure(TAG, checkpoint, horizon_steps=None, edge_ablations=on) for on in (False, True))
    assert plain.edges == {} and list(result.edges) == list(EDGES)
    assert result.model.min_ade_m == plain.model.min_ade_m
    errors_m = {result.model.min_ade_m, *(line.min_ade_m for line in result.edges.values())}
    assert len(errors_m) == 3 and all(line.agents == result.model.agents for line in result.edges.values())
    assert f"… with {list(EDGES)[1]} {result.edges['edges cut'].min_ade_m:.3f} m" in report.remarks(result)


@pytest.mark.slow
def test_a_forecaster_without_edges_has_none_to_change():
    with pytest.raises(UserError, match="edge ablations need the edges of a dG-VAE, and constant-velocity is Constant"):
        measure(TAG, STILL, edge_ablations=True)


def test_lines_and_intervals_closed_form():
    """Two episodes of equally many forecasts: a quarter of the draws is one of them twice."""
    found = summary(HIGHWAY_SPEC, [1.0, 3.0], [[0.1], [0.1]])
    assert (found.model.min_ade_m, found.constant_velocity.min_ade_m) == pytest.approx((2.0, 4.0))
    assert found.model.intervals["min_ade_m"] == pytest.approx((1.0, 3.0))
    assert found.model.step_intervals["by_step_m"] == [pytest.approx((1.0, 3.0))] * HORIZON
    assert found.reduction == pytest.approx(0.5)
    assert found.reduction_interval == pytest.approx((0.5, 0.5))
    assert [line.name for line in found.lines] == ["constant velocity (deployed)", "constant velocity"]


def test_standard_errors_are_over_episodes():
    """Two episodes of ten equal steps, errors of 1 and 3 m: a standard deviation of √2, a standard error of 1 m."""
    episodes = [steps_of([error] * 10, [HORIZON] * 10, False) for error in (1.0, 3.0)]
    found = summarise_episodes("here", STILL, "idle", HIGHWAY_SPEC, episodes).model.statistics["ade_m"]
    assert found.subsets == 2 and found.standard_error == pytest.approx(1.0)


def steps_of(errors_m: list[float], known: list[int], crashed: bool) -> Episode:
    """An episode of one agent: the error at each step, and how many of the future steps were reached."""
    forecast = torch.zeros(len(errors_m), 1, 1, HORIZON, 2)
    forecast[..., 0] = torch.tensor(errors_m)[:, None, None, None]
    valid = torch.arange(HORIZON) < torch.tensor(known)[:, None, None]
    found = Outcome(forecast, torch.zeros(len(errors_m), 1, HORIZON, 2), valid)
    return Episode({MODEL: found, STRAIGHT: found}, [0.1], crashed=crashed)


def test_forecasts_that_pass_the_end_count_up_to_it_and_the_last_before_a_crash_alone():
    """HORIZON whole forecasts of 1 m, then one with a single step left, 4 m off; none of the scene of the crash."""
    errors, known = [1.0] * HORIZON + [4.0], [HORIZON] * HORIZON + [1]
    episodes = [steps_of(errors, known, crashed) for crashed in (True, False)]
    found = summarise_episodes("here", STILL, "idle", replace(HIGHWAY_SPEC, dt_s=2.5), episodes)  # 5 s: two steps
    assert found.model.min_ade_m == 1.0 and found.model.agents == 2 * HORIZON
    assert found.to_the_end[0].agents == 2 * (HORIZON + 1)
    assert found.to_the_end[0].min_ade_m == pytest.approx((HORIZON + 4.0) / (HORIZON + 1))
    assert found.before_crash[0].agents == 2 and found.before_crash[1].min_ade_m == (1.0 + 4.0) / 2
    assert "the same in the last 5 s before a crash: minADE 2.500 m" in report.remarks(found)
    quiet = summarise_episodes("here", STILL, "idle", HIGHWAY_SPEC, [episodes[1]])
    assert quiet.before_crash is None and quiet.to_the_end is not None


def test_an_episodes_first_scene_warms_up_and_is_not_timed():
    found = summary(HIGHWAY_SPEC, [1.0] * 3, [[9.0, 0.001, 0.003], [9.0, 0.002], [0.002]])
    assert found.latency_median_ms == pytest.approx(2.0)
    assert found.latency_p95_ms == pytest.approx(2.85)  # of 1, 2, 2 and 3 ms


@pytest.mark.parametrize(
    ("layout", "miss_m", "rate"),
    [("road", None, 0.5), ("road", 0.3, 1.0), ("arena", None, 1.0), ("arena", 2.0, 0.5), ("arena", 4.0, 0.0)],
)
def test_what_a_miss_is_depends_on_the_scale_of_the_place(layout: str, miss_m: float | None, rate: float):
    """Of errors of 0.5 m and 3 m, a road's 2 m let one pass, and an arena's 0.1 m none."""
    spec = HIGHWAY_SPEC if layout == "road" else tag_spec()
    assert summary(spec, [0.5, 3.0], [[0.1]] * 2, miss_m=miss_m).model.miss_rate == rate


def test_graph_accuracy_closed_form():
    """Of five pairs whose truth is known, over two episodes, three are believed rightly."""
    edge, none = (0.1, 0.9), (0.8, 0.2)
    probs = np.array([[none, edge, edge], [none, none, none], [edge, edge, none]])
    first = np.array([[-1, 1, 0], [0, -1, -1], [-1, -1, -1]])  # right, wrong, right
    second = np.array([[-1, -1, -1], [-1, -1, 1], [1, -1, -1]])  # wrong, right
    episodes = [Episode({}, [], [probs], [types]) for types in (first, second)]
    found = _graph(episodes)
    assert found is not None
    assert (found.pairs, found.accuracy) == (5, pytest.approx(3 / 5))
    assert found.true_connectivity == pytest.approx(3 / 5)
    assert found.f1 == pytest.approx(2 * 2 / (2 * 2 + 1 + 1))
    assert _graph([Episode({}, [0.1])]) is None
    assert _graph([Episode({}, [0.1], [np.ones((3, 3, 1))], [first])]) is None  # a model with one type


# --- One environment --------------------------------------------------------------------------------------------------


def run_config(**changes: Any) -> EvaluateConfig:
    base = {"episodes": 2, "num_samples": 3, "workers": 1, "max_steps": 6, "horizon_steps": 2}
    return EvaluateConfig(**{**base, **changes})


def measure(env_id: str, checkpoint: str, **changes: Any) -> EnvAccuracy:
    return evaluate_env(run_config(**changes), env_id, checkpoint)[0]


def timeless(result: EnvAccuracy) -> EnvAccuracy:
    return replace(result, latency_median_ms=0.0, latency_p95_ms=0.0)


@pytest.mark.parametrize("env_id", [ROAD, TAG])
def test_constant_velocity_is_its_own_baseline(env_id: str, in_process: None):
    result = measure(env_id, STILL)
    assert result.reduction == pytest.approx(0.0, abs=1e-4)
    assert result.reduction_interval == pytest.approx((0.0, 0.0), abs=1e-4)
    assert (result.checkpoint, result.dt_s) == (STILL, {ROAD: 1.0, TAG: 0.1}[env_id])
    assert result.driver == {ROAD: "varied", TAG: "heuristic"}[env_id]
    for line in (result.model, result.model_samples):
        assert line.agents == result.constant_velocity.agents > 0
        for name in ("min_ade_m", "min_fde_m", "by_step_m", "rmse_m"):
            expected = getattr(result.constant_velocity, name)
            assert getattr(line, name) == pytest.approx(expected, rel=1e-4, abs=1e-6)
    assert (result.model.num_samples, result.model_samples.num_samples) == (1, 3)
    assert result.constant_velocity.min_ade_m > 0.01
    assert result.nearest_neighbours is None and result.graph is None and result.histories == {}
    assert len(result.lines) == 2


def test_all_agents_count_in_an_arena_but_its_obstacles_do_not(in_process: None):
    """Four agents, at each of the five scenes that have two steps of truth, in two episodes."""
    assert measure(TAG, STILL).model.agents == 2 * 5 * 4


@pytest.mark.slow
def test_a_learned_checkpoint_is_measured(in_process: None, tmp_path: Path):
    path = tmp_path / "learned"
    info = CheckpointInfo(HIGHWAY_SPEC, SIZES, HORIZON, std_m=(1.0, 2.0, 3.0))
    save_checkpoint(path, tiny_model(HIGHWAY_SPEC), info)
    settings = {"horizon_steps": None, "memory_steps": (1, 9)}
    result, again = (measure(ROAD, str(path), **settings) for _ in range(2))
    assert timeless(result) == timeless(again)
    assert result.checkpoint == "learned"
    assert len(result.model.by_step_m) == HORIZON
    assert result.model_samples.min_ade_m < result.model.min_ade_m
    assert result.reduction == pytest.approx(1 - result.model.min_ade_m / result.constant_velocity.min_ade_m, rel=1e-4)
    low, high = result.reduction_interval
    assert low <= result.reduction <= high
    assert all(
        np.isfinite(line.nll).all() and len(line.nll) == HORIZON for line in (result.model, result.model_samples)
    )
    assert [line.name for line in result.lines] == ["dG-VAE", "constant velocity"]
    assert result.histories[9].by_step_m == pytest.approx(result.model.by_step_m, rel=1e-4)  # all of the episode
    assert result.histories[1].by_step_m != pytest.approx(result.model.by_step_m, rel=1e-4)
    assert result.graph is not None and result.graph.accuracy is not None and result.graph.pairs > 0
    assert 0 < result.latency_median_ms <= result.latency_p95_ms
    # each episode alone: the ends of the interval over both
    alone = [measure(ROAD, str(path), horizon_steps=None, episodes=1, seed=900_000 + i).model for i in range(2)]
    assert all(line.intervals == {} for line in alone)
    assert result.model.intervals["min_ade_m"] == pytest.approx(sorted(line.min_ade_m for line in alone), rel=1e-5)


def test_a_learned_checkpoint_is_measured_among_many_learners(in_process: None, tmp_path: Path):
    result = measure(TAG, save_tag(tmp_path / "tag"), horizon_steps=None, memory_steps=(1,))
    assert (result.checkpoint, result.driver, result.graph) == ("tag", "heuristic", None)
    assert len(result.model.by_step_m) == HORIZON
    assert result.model.agents == result.histories[1].agents == 2 * 4 * 4
    assert result.model.min_ade_m != pytest.approx(result.constant_velocity.min_ade_m, rel=1e-3)
    assert result.model_samples.min_ade_m < result.model.min_ade_m
    assert 0 < result.latency_median_ms <= result.latency_p95_ms


def test_neighbours_have_a_line_where_there_is_data(in_process: None, tmp_path: Path):
    """A folder of stores, of which one is named by the env; it holds the very episode, six times."""
    settings: dict[str, Any] = {"driver": "idle", "seed": 5, "episodes": 1}
    (recorded,) = collect(CollectConfig(ROAD, tmp_path, 1, ("idle",), 5, 6, False, 1))
    write_store(tmp_path / ROAD, StoreInfo(HighwayReader(make_env(ROAD)).spec, ROAD), [recorded] * 6)
    for root in (tmp_path, tmp_path / ROAD):
        found = measure(ROAD, STILL, data=(root,), **settings)
        assert found.nearest_neighbours is not None
        assert found.nearest_neighbours.name == "nearest neighbours"
        assert found.nearest_neighbours.ade_m == pytest.approx(0.0, abs=1e-3)
        assert found.constant_velocity.min_ade_m > 0.1
        assert [line.name for line in found.lines[1:]] == list(CONTROLS)
        assert {line.num_samples for line in found.lines} == {3}


@pytest.mark.slow
def test_a_policy_trained_on_forecasts_drives(in_process: None, tmp_path: Path, highway_checkpoint: str):
    policy = str(save_forecast_policy(tmp_path, ROAD, highway_checkpoint))
    driven = measure(ROAD, highway_checkpoint, horizon_steps=None, driver=policy)
    assert driven.model.agents > 0
    assert driven.driver == policy
    assert driven.model != measure(ROAD, highway_checkpoint, horizon_steps=None).model


@pytest.mark.slow
def test_a_policy_drives_the_same_episodes_whatever_is_measured(
    in_process: None, tmp_path: Path, highway_checkpoint: str
):
    policy = str(save_forecast_policy(tmp_path, ROAD, highway_checkpoint))
    another = save_tiny(tmp_path / "another", HIGHWAY_SPEC, **PLURAL)
    own, other = (measure(ROAD, checkpoint, driver=policy) for checkpoint in (highway_checkpoint, another))
    assert other.constant_velocity == own.constant_velocity and other.model.min_ade_m != own.model.min_ade_m


def test_a_policy_without_a_note_sees_what_is_measured(in_process: None, tmp_path: Path, highway_checkpoint: str):
    policy = save_forecast_policy(tmp_path, ROAD, highway_checkpoint, noted=False)
    with pytest.warns(UserWarning, match="has no note on its forecaster"):
        assert measure(ROAD, highway_checkpoint, horizon_steps=None, driver=str(policy)).model.agents > 0
    with pytest.warns(UserWarning, match="has no note"), pytest.raises(UserError, match="policy.zip was trained on"):
        measure(ROAD, STILL, horizon_steps=HORIZON, driver=str(policy))


def test_worst_cases_are_of_different_episodes_worst_first(in_process: None):
    _, cases = evaluate_env(run_config(episodes=8), TAG, STILL)
    assert len(cases) == 6
    errors = [case.error_m for case in cases]
    assert errors == sorted(errors, reverse=True)
    assert len({case.seed for case in cases}) == 6


def test_episodes_too_short_are_named(in_process: None):
    assert measure(TAG, STILL, max_steps=2, horizon_steps=2).model.agents > 0
    with pytest.raises(UserError, match=f"{TAG}: no forecast has 3 steps of truth, as --max-steps 2 ends them before"):
        measure(TAG, STILL, max_steps=2, horizon_steps=3)


@pytest.mark.parametrize("fails", [UserError, EnvironmentFailedError])
def test_of_several_environments_one_that_fails_costs_no_other(
    fails: type[Exception], in_process: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
):
    """One that cannot be measured, and one that breaks, after which the command ends."""
    words = ["--env-ids", TAG, ROAD, "--checkpoint", STILL, "--episodes", "1", "--max-steps", "6", "--num-samples", "2"]
    words += ["--workers", "1", "--out", str(tmp_path)]
    played = evaluate.evaluate_env

    def fail_on_the_road(config: Any, env_id: str, checkpoint: str) -> Any:
        if env_id == ROAD:
            raise fails(f"{ROAD}: no forecast")
        return played(config, env_id, checkpoint)

    monkeypatch.setattr(evaluate, "evaluate_env", fail_on_the_road)
    code, errors, _ = run_command(evaluate.main, words, monkeypatch, capsys)
    written = json.loads((tmp_path / "accuracy.json").read_text())
    assert [result["env_id"] for result in written["results"]] == [TAG]
    assert TAG in (tmp_path / "accuracy.md").read_text()
    if fails is UserError:
        assert (code, errors) == (2, [f"error: not measured: {ROAD}: no forecast; all else is in {tmp_path}"])
        assert written["misfits"] == [{"env_id": ROAD, "checkpoint": STILL, "why": f"{ROAD}: no forecast"}]
    else:
        assert code != 0 and "no forecast" in errors[-1] and written["misfits"] == []


def test_all_stores_are_looked_for_before_anything_is_played(
    in_process: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (recorded,) = collect(CollectConfig(ROAD, tmp_path, 1, ("idle",), 5, 6, False, 1))
    write_store(tmp_path / ROAD, StoreInfo(HighwayReader(make_env(ROAD)).spec, ROAD), [recorded])
    monkeypatch.setattr(evaluate, "evaluate_env", lambda *_: pytest.fail("was played"))
    config = EvaluateConfig(env_ids=(ROAD, TAG), checkpoint=(STILL,), data=(tmp_path,))
    with pytest.raises(UserError, match=f"data: no store of {TAG}"):
        evaluate.evaluate(config, Console())


# --- Whole runs -------------------------------------------------------------------------------------------------------


class Run(NamedTuple):
    out: Path
    text: str


@pytest.fixture(scope="module")
def transfer_run(tmp_path_factory: pytest.TempPathFactory, highway_checkpoint: str) -> Run:
    """Two checkpoints in two environments; the one that learned at steps of 1 s does not fit racetrack-v1."""
    out, text = tmp_path_factory.mktemp("transfer") / "results", StringIO()
    arguments = ["--env-ids", ROAD, "racetrack-v1", "--checkpoint", STILL, highway_checkpoint, "--episodes", "2"]
    arguments += ["--num-samples", "2", "--max-steps", "5", "--horizon-steps", "2", "--memory-steps", "1"]
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(text):
        no_processes(patch)
        forget()
        patch.setattr("sys.argv", ["evaluate", *arguments, "--workers", "1", "--out", str(out)])
        evaluate.main()
        forget()
    return Run(out, text.getvalue())


def test_a_transfer_matrix_says_what_does_not_fit_and_why(transfer_run: Run):
    text = (transfer_run.out / "accuracy.md").read_text()
    matrix = text[text.index("### Transfer") :].splitlines()
    assert matrix[2] == "| env | constant-velocity | tiny-highway |"
    two_way, racetrack = ([cell.strip() for cell in line.strip("|").split("|")] for line in matrix[4:6])
    assert (two_way[0], racetrack[0], racetrack[2]) == (ROAD, "racetrack-v1", "–")
    assert "–" not in (two_way[1], two_way[2], racetrack[1])
    assert matrix[7].startswith("* racetrack-v1 with tiny-highway: ")
    assert "was trained at dt_s=1 but env 'racetrack-v1' steps at dt_s=0.2" in matrix[7]
    assert "transfer: minADE₁ [m]" in transfer_run.text


def test_a_transfer_matrix_is_in_the_json(transfer_run: Run):
    content = read_json(transfer_run.out / "accuracy.json")
    assert content["config"]["episodes"] == 2
    assert content["config"]["seed"] == 900_000
    assert {"command", "commit", "versions", "time"} <= set(content["provenance"])
    (misfit,) = content["misfits"]
    assert (misfit["env_id"], misfit["checkpoint"]) == ("racetrack-v1", "tiny-highway")
    assert "dt_s" in misfit["why"]
    measured = [(r["env_id"], r["checkpoint"]) for r in content["results"]]
    assert measured == [(ROAD, STILL), (ROAD, "tiny-highway"), ("racetrack-v1", STILL)]
    straight, learned, _ = content["results"]
    assert straight["reduction"] == pytest.approx(0.0, abs=1e-4)
    assert straight["model"]["min_ade_m"] == pytest.approx(straight["constant_velocity"]["min_ade_m"], rel=1e-4)
    assert learned["model"]["min_ade_m"] != pytest.approx(learned["constant_velocity"]["min_ade_m"], rel=1e-4)
    assert set(learned["histories"]) == {"1"}
    low, high = learned["model"]["intervals"]["min_ade_m"]
    assert low <= learned["model"]["min_ade_m"] <= high
    assert learned["graph"]["pairs"] > 0


def test_each_pair_has_pictures(transfer_run: Run):
    pairs = [f"{ROAD}.{STILL}", f"{ROAD}.tiny-highway", f"racetrack-v1.{STILL}"]
    pictures = {f"{pair}.{kind}.png" for pair in pairs for kind in ("by_horizon", "worst")}
    assert {p.name for p in transfer_run.out.iterdir()} == {*pictures, "accuracy.json", "accuracy.md"}
    for name in pictures:
        pixels = plt.imread(transfer_run.out / name)
        assert min(pixels.shape[:2]) > 300
        assert pixels[..., :3].std() > 0.05  # something is drawn


@pytest.mark.slow
def test_the_command_writes_json_and_markdown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    """With a real worker process, as a user runs it."""
    out = tmp_path / "results"
    arguments = ["--env-ids", TAG, "--checkpoint", STILL, "--episodes", "2", "--num-samples", "2"]
    arguments += ["--max-steps", "5", "--horizon-steps", "2", "--workers", "1", "--out", str(out)]
    code, errors, output = run_command(evaluate.main, arguments, monkeypatch, capsys)
    assert (code, errors) == (0, [])
    assert f"{TAG}, checkpoint {STILL}, driven heuristic" in output
    (result,) = read_json(out / "accuracy.json")["results"]
    assert result["env_id"] == TAG
    lines = (out / "accuracy.md").read_text().splitlines()
    assert lines[0].startswith("| env | checkpoint | dt [s] | steps | ADE₁ [m] |")
    assert lines[2].startswith(f"| {TAG} | {STILL} | 0.1 | 2 | ")
    assert f"### {TAG}, checkpoint {STILL}, driven heuristic" in lines
    assert not any("Transfer" in line for line in lines)


def test_a_driver_is_named_where_no_heuristic_knows_the_env(in_process: None):
    """Neither the default nor the early look at every id asks for a heuristic that does not exist."""
    crossing = "intersection-multi-agent-v2"
    assert measure(crossing, STILL, max_steps=2, horizon_steps=1, episodes=1).driver == "varied"


ERRORS = {
    "unknown-id": (["--env-ids", ROAD, "nope-v0"], "cannot make env 'nope-v0'"),
    "unknown-checkpoint": (["--checkpoint", "nowhere"], "no checkpoint 'nowhere'"),
    "same-id-twice": (["--env-ids", ROAD, ROAD], f"each of --env-ids is given once, got {ROAD}, {ROAD}; leave one out"),
    "same-twice": (["--checkpoint", "a/best", "a/best"], "each checkpoint is given once, got a/best, a/best"),
    "arguments-of-two": (
        ["--env-ids", ROAD, TAG, "--env-kwargs", '{"a": 1}'],
        "env_kwargs are of one environment; give one of --env-ids, got 2",
    ),
    "arguments-of-two-graphs": (
        ["--graph", "--env-ids", ROAD, TAG, "--env-kwargs", '{"a": 1}'],
        "env_kwargs are of one environment; give one of --env-ids, got 2",
    ),
    "no-json": (["--env-kwargs", "size=3"], "env_kwargs must be a JSON object, got 'size=3'"),
    "unknown-argument": (
        ["--env-kwargs", '{"sizes": 3}'],
        f"cannot make env '{ROAD}' with {{'sizes': 3}}: TypeError: ",
    ),
    "no-driver": (["--driver", "own:tests.envs.own_code:absent"], "module 'tests.envs.own_code' has no function or c"),
    "half-a-driver": (["--driver", "own:absent"], "a driver of your own is own:module:function, got 'own:absent'"),
    "zero-episodes": (["--episodes", "0"], "episodes must be at least 1, got 0"),
    "zero-samples": (["--num-samples", "0"], "num_samples must be at least 1, got 0"),
    "zero-workers": (["--workers", "0"], "workers must be at least 1, got 0"),
    "negative-steps": (["--max-steps", "-5"], "max_steps must be at least 1, got -5"),
    "zero-horizon": (["--horizon-steps", "0"], "horizon_steps must be at least 1, got 0"),
    "zero-memory": (["--memory-steps", "3", "0"], "memory_steps must be at least 1, got (3, 0)"),
    "negative-seed": (["--seed", "-1"], "seed must not be negative, got -1"),
    "zero-miss": (["--miss-m", "0"], "miss_m must be positive, got 0"),
    "unfit-ego": (["--driver", "keep-lane"], "keep-lane needs continuous steering"),
    "unknown-ego": (["--driver", "reckless"], "driver must be one of random"),
    "unfit-driver": (["--env-ids", TAG, "--driver", "keep-lane"], "driver must be one of random"),
    "no-neighbours": (["--data", "nowhere"], "no episode store at nowhere; make one"),
    "no-store": (["--data", "."], ". is not an episode store (it has no zarr.json)"),
    "too-short": (
        ["--max-steps", "1", "--episodes", "1"],
        f"{ROAD}: no forecast has 5 steps of truth, as --max-steps 1",
    ),
    "no-env": (["--env-ids"], "give at least one of --env-ids"),
}


@pytest.mark.parametrize("case", ERRORS)
def test_bad_input_is_one_line_and_leaves_nothing(
    case: str, in_process: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    arguments, message = ERRORS[case]
    base = {"--env-ids": ROAD, "--checkpoint": STILL, "--workers": "1", "--out": str(tmp_path / "results")}
    words = [word for option in base.items() if option[0] not in arguments for word in option]
    monkeypatch.chdir(tmp_path)
    code, errors, _ = run_command(evaluate.main, [*words, *arguments], monkeypatch, capsys)
    assert code == 2
    assert len(errors) == 1
    assert errors[0].startswith(f"error: {message}")
    assert list(tmp_path.iterdir()) == []


def test_a_single_checkpoint_that_does_not_fit_is_one_line(
    in_process: None, highway_checkpoint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
):  # fmt: skip
    """Before the first environment is measured, whose results would be lost."""
    arguments = ["--env-ids", ROAD, "racetrack-v1", "--checkpoint", highway_checkpoint, "--out", str(tmp_path / "out")]
    monkeypatch.setattr(evaluate, "evaluate_env", lambda *_: pytest.fail("measured before all was compared"))
    code, errors, _ = run_command(evaluate.main, arguments, monkeypatch, capsys)
    assert code == 2
    assert len(errors) == 1 and not (tmp_path / "out").exists()
    assert "was trained at dt_s=1 but env 'racetrack-v1' steps at dt_s=0.2" in errors[0]


def test_two_checkpoints_of_which_none_fits_are_one_line(
    in_process: None, highway_checkpoint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
):  # fmt: skip
    arguments = ["--env-ids", "racetrack-v1", "--checkpoint", highway_checkpoint, save_tag(tmp_path / "tag")]
    code, errors, _ = run_command(evaluate.main, arguments, monkeypatch, capsys)
    assert code == 2
    assert len(errors) == 1
    assert errors[0].startswith("error: nothing was measured: ")


def test_missing_neighbours_are_no_misfit_of_a_checkpoint(
    in_process: None, highway_checkpoint: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    arguments = ["--env-ids", ROAD, "--checkpoint", STILL, highway_checkpoint, "--data", "nowhere"]
    code, errors, _ = run_command(evaluate.main, arguments, monkeypatch, capsys)
    assert (code, len(errors)) == (2, 1)
    assert errors[0].startswith("error: no episode store at nowhere; make one")


def test_an_environment_that_fails_is_no_misfit(monkeypatch: pytest.MonkeyPatch):
    def fail(*_: Any) -> Any:
        raise EnvironmentFailedError("merge-v1, seed 3, step 2: RuntimeError: engine")

    monkeypatch.setattr(evaluate, "evaluate_env", fail)
    config = EvaluateConfig(env_ids=("merge-v1",), checkpoint=("merge", "exit"))
    with pytest.raises(EnvironmentFailedError, match="engine"):
        evaluate.evaluate(config, Console())
