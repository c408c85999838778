import io
import json
import math
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console

from predictor import evaluate as evaluation
from predictor.baselines.mlp import MLP, MLPConfig
from predictor.checkpoint import CheckpointInfo, load_checkpoint, save_checkpoint
from predictor.data.store import Episode, StoreInfo, content_id, read_store, write_store
from predictor.data.windows import Windows
from predictor.dgvae import DGVAE
from predictor.evaluate import EvaluateConfig, evaluate
from predictor.evaluation.accuracy import Accuracy
from predictor.evaluation.displacement import miss_distance_m
from predictor.evaluation.outcomes import Outcome
from predictor.evaluation.standard_errors import Statistic
from predictor.reports.tables import accuracy_table, markdown_table
from predictor.scene import KINEMATIC_FEATURES_3D, SceneSpec
from predictor.support.errors import UserError, run_entry_point
from tests.predictor.helpers import FAST_LIKE, spec, write_circles
from tests.predictor.test_own_forecasters import NAME

HEADING = (
    "| forecaster | K | ADE₁ [m] | FDE₁ [m] | minADE [m] | minFDE [m] | joint ADE [m] | joint FDE [m] | energy [m] "
    "| RMSE [m] | missed | cover | overlap |"
)


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return write_circles(tmp_path / "data", episodes=3, steps=6)


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    """A model whose change of state is always zero, so that its forecasts are known: constant velocity."""
    torch.manual_seed(0)
    forecaster = DGVAE(spec(), FAST_LIKE, horizon_steps=2)
    torch.nn.init.zeros_(forecaster.decoder.readout.weight)
    torch.nn.init.zeros_(forecaster.decoder.readout.bias)
    save_checkpoint(tmp_path / "toy", forecaster, CheckpointInfo(spec(), FAST_LIKE, 2, std_m=(1.0, 2.0)))
    return tmp_path / "toy"


def run(monkeypatch: pytest.MonkeyPatch, *words: object) -> None:
    monkeypatch.setattr(sys, "argv", ["evaluate", *map(str, words)])
    run_entry_point(evaluation.main)


def refuse(constant: str) -> None:
    raise AssertionError(f"{constant} is not JSON")


@pytest.mark.slow
def test_smoke(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], data: Path, checkpoint: Path, tmp_path: Path
):
    out = tmp_path / "out"
    run(monkeypatch, "--checkpoint", checkpoint, "--data", data, "--num-samples", 3, "--out", out)
    printed = capsys.readouterr().out
    assert "minADE" in printed and "constant velocity" in printed
    assert "displacement of the best sample [m] / RMSE of the mean [m] / NLL [nats]" in " ".join(printed.split())
    assert max(map(len, printed.splitlines())) <= 160 and "…" not in printed
    assert sorted(p.name for p in out.iterdir()) == [
        "accuracy.json",
        "accuracy.md",
        "error_by_horizon.png",
        "scenes.png",
    ]
    for name in ("error_by_horizon.png", "scenes.png"):
        picture = (out / name).read_bytes()
        assert picture.startswith(b"\x89PNG") and len(picture) > 5000
    content = json.loads((out / "accuracy.json").read_text(), parse_constant=refuse)
    assert (content["source"], content["dt_s"]) == ("circles", 1.0)
    assert [(r["name"], r["num_samples"]) for r in content["rows"]] == [
        ("dG-VAE", 3),
        ("constant velocity + noise", 3),
    ]
    assert all(len(r["by_step_m"]) == len(r["rmse_m"]) == len(r["nll"]) == 2 for r in content["rows"])
    lines = (out / "accuracy.md").read_text().splitlines()
    assert lines[0] == f"{HEADING} 1 s | 2 s |"
    names = [line.split("|")[1].strip() for line in lines[2:]]
    assert names == ["dG-VAE", "constant velocity + noise"]


def test_known_model_scores_what_it_must(data: Path, checkpoint: Path):
    one, straight = evaluate(EvaluateConfig(str(checkpoint), data, num_samples=1))
    many, noisy = evaluate(EvaluateConfig(str(checkpoint), data, num_samples=4))
    assert (noisy.ade_m, noisy.fde_m) == (straight.min_ade_m, straight.min_fde_m)
    for found in (one, many):
        assert found.min_ade_m == pytest.approx(straight.min_ade_m, rel=1e-5)
        assert found.min_fde_m == pytest.approx(straight.min_fde_m, rel=1e-5)
        assert found.by_step_m == pytest.approx(straight.by_step_m, rel=1e-5)
        assert found.rmse_m == pytest.approx(straight.rmse_m, rel=1e-5)
        # one point: d²/(2σ²) + 2 log σ + log 2π on average, with the checkpoint's spread
        expected = [
            r**2 / (2 * s**2) + 2 * math.log(s) + math.log(2 * math.pi)
            for r, s in zip(found.rmse_m, (1.0, 2.0), strict=True)
        ]
        assert found.nll == pytest.approx(expected, rel=1e-4)
    assert straight.min_ade_m > 0.5
    assert one.agents == 3 * 4  # of 6 steps, 4 have two steps after them; one other agent per episode


def test_horizon_and_number_of_windows_can_be_chosen(data: Path, checkpoint: Path):
    accuracies = evaluate(EvaluateConfig(str(checkpoint), data, horizon_steps=4, max_windows=5))
    assert all(len(r.by_step_m) == 4 and r.agents <= 5 for r in accuracies)
    assert [r.num_samples for r in accuracies] == [20, 20]


def test_one_sample_gives_one_line(data: Path, checkpoint: Path):
    assert [r.name for r in evaluate(EvaluateConfig(str(checkpoint), data, num_samples=1))] == [
        "dG-VAE",
        "constant velocity",
    ]


def test_the_likelihood_of_the_control_is_that_of_its_own_gaussian(data: Path, checkpoint: Path):
    """Its samples hold the spread already, which must not count twice."""
    _, one = evaluate(EvaluateConfig(str(checkpoint), data, num_samples=1))
    _, many = evaluate(EvaluateConfig(str(checkpoint), data, num_samples=20))
    assert many.nll == one.nll and len(one.nll) == 2


def test_rows_bear_the_name_of_the_model(data: Path, tmp_path: Path):
    torch.manual_seed(0)
    save_checkpoint(tmp_path / "mlp", MLP(spec(), MLPConfig(), 2), CheckpointInfo(spec(), MLPConfig(), 2, model="mlp"))
    accuracies = evaluate(EvaluateConfig(str(tmp_path / "mlp"), data, num_samples=2))
    assert [r.name for r in accuracies] == ["MLP", "constant velocity + noise"]


def test_equal_seeds_give_equal_accuracies(data: Path, checkpoint: Path):
    settings = EvaluateConfig(str(checkpoint), data, num_samples=3, max_windows=6)
    assert evaluate(settings) == evaluate(settings)


def test_markdown_closed_form():
    bare = Accuracy("dG-VAE", 1, 0.1234, 0.5, [0.1, 0.25], [0.2, 0.3], [], 7)
    full = replace(
        bare,
        num_samples=20,
        min_joint_ade_m=0.2,
        min_joint_fde_m=0.7,
        miss_rate=0.125,
        overall_rmse_m=0.25,
        ade_m=0.3,
        fde_m=0.6,
        energy_m=0.22,
        overlap=0.015,
        true_overlap=0.005,
        statistics={"min_ade_m": Statistic(0.12, 0.004, 20), "coverage": Statistic(0.87, 0.01, 20)},
    )
    assert markdown_table([bare, full], 0.2) == (
        f"{HEADING} 0.2 s | 0.4 s |\n"
        f"|{15 * '---|'}\n"
        "| dG-VAE | 1 | – | – | 0.123 | 0.500 | – | – | – | – | – | – | – | 0.10 | 0.25 |\n"
        "| dG-VAE | 20 | 0.300 | 0.600 | 0.123 ± 0.004 | 0.500 | 0.200 | 0.700 | 0.220 | 0.250 | 12.5 % | 87 % "
        "| 1.5 (0.5) % | 0.10 | 0.25 |\n"
    )


def test_small_errors_keep_two_digits():
    errors = [0.00123, 0.0]
    found = Accuracy("dG-VAE", 1, 0.01, 0.00987, errors, errors, [], 7)
    found = replace(found, statistics={"min_fde_m": Statistic(0.00987, 0.0000123, 20)})
    cells = [c.strip() for c in markdown_table([found], 1.0).splitlines()[-1].split("|")[1:-1]]
    assert cells[4:6] == ["0.010", "0.0099 ± 1.2e-05"] and cells[-2:] == ["0.0012", "0.00"]


def test_long_horizons_show_some_steps_and_the_last():
    errors = [float(i) for i in range(50)]
    accuracies = [Accuracy("constant velocity", 1, 1.0, 1.0, errors, errors, errors, 7)]
    assert markdown_table(accuracies, 0.1).splitlines()[0] == f"{HEADING} 0.1 s | 1.1 s | 2.1 s | 3 s | 4 s | 5 s |"
    console = Console(width=160, record=True, file=io.StringIO())
    console.print(accuracy_table(accuracies, 0.1, "title"))
    assert "49.00" in console.export_text() and "48.00" not in console.export_text()


def test_constant_velocity_is_a_checkpoint_of_every_store(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], data: Path, checkpoint: Path, tmp_path: Path
):
    settings = EvaluateConfig("constant-velocity", data, horizon_steps=2)
    (noisy,), (found,) = evaluate(settings), evaluate(replace(settings, num_samples=1))
    assert (noisy.num_samples, noisy.agents) == (20, found.agents) and noisy.min_ade_m < found.min_ade_m
    assert found == evaluate(EvaluateConfig(str(checkpoint), data, num_samples=1))[-1]
    assert len(evaluate(EvaluateConfig("constant-velocity", data))[0].by_step_m) == 5
    out = tmp_path / "out"
    run(monkeypatch, "--checkpoint", "constant-velocity", "--data", data, "--horizon-steps", 2, "--out", out)
    assert "constant velocity" in capsys.readouterr().out
    content = json.loads((out / "accuracy.json").read_text(), parse_constant=refuse)
    assert [r["name"] for r in content["rows"]] == ["constant velocity + noise"]
    assert (out / "scenes.png").exists()


def test_the_store_of_a_training_is_named(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    model, info = load_checkpoint(save(tmp_path / "trained", data))
    assert info.provenance["stores"]
    run(monkeypatch, "--checkpoint", tmp_path / "trained", "--data", data, "--num-samples", 1)
    said = f"{data} is a store that '{tmp_path / 'trained'}' was trained with: its errors elsewhere may be larger"
    assert said in " ".join(capsys.readouterr().out.split())


def save(path: Path, store: Path) -> Path:
    model = MLP(spec(), MLPConfig(hidden_dim=4), 2)
    stores = {"data/circles": content_id(store)}
    save_checkpoint(path, model, CheckpointInfo(spec(), model.config, 2, model="mlp", provenance={"stores": stores}))
    return path


def test_the_distance_of_misses_can_be_chosen_and_fits_the_scale(data: Path):
    settings = EvaluateConfig("constant-velocity", data, num_samples=1, horizon_steps=2)
    (found,) = evaluate(settings)
    assert found.miss_threshold_m == miss_distance_m(spec().feature_scales[0])
    (far,) = evaluate(replace(settings, miss_m=1e6))
    assert far.miss_threshold_m == 1e6 and far.miss_rate == 0.0 < found.miss_rate
    assert [miss_distance_m(scale) for scale in (100.0, 50.0, 6.0)] == pytest.approx([2.0, 2.0, 0.6])


def test_a_forecaster_of_ones_own_is_measured_by_its_name(data: Path, tmp_path: Path):
    settings = EvaluateConfig(f"{NAME}Mine", data, num_samples=1, horizon_steps=2, out=tmp_path / "out")
    mine, straight = evaluate(settings)
    assert mine.name == "tests.predictor.test_own_forecasters:Mine"
    assert replace(mine, name=straight.name, nll=straight.nll, step_errors=straight.step_errors) == straight
    assert mine.nll == [] and (tmp_path / "out" / "scenes.png").exists()
    with pytest.raises(UserError, match="a forecaster of your own runs on the CPU, got --device cuda; leave it out"):
        evaluate(on_a_gpu(settings))


def on_a_gpu(settings: EvaluateConfig) -> EvaluateConfig:
    object.__setattr__(settings, "device", "cuda")
    return settings


def test_the_first_agent_of_a_recording_without_an_ego_is_not_taken_for_it(
    data: Path, checkpoint: Path, tmp_path: Path
):
    write_store(
        tmp_path / "equals", replace(read_store(data).info, spec=spec(has_ego=False)), read_store(data).episodes
    )
    with pytest.raises(UserError, match="needs episodes with an ego but store .*equals has none .* record a store"):
        evaluate(EvaluateConfig(str(checkpoint), tmp_path / "equals"))


def test_likelihood_and_standard_error_of_constant_velocity_with_noise_are_of_one_forecaster(
    data: Path, checkpoint: Path
):
    one = evaluate(EvaluateConfig(str(checkpoint), data, num_samples=1))[-1]
    drawn = evaluate(EvaluateConfig(str(checkpoint), data, num_samples=3))[-1]
    assert drawn.name == "constant velocity + noise" and drawn.nll == one.nll
    assert drawn.step_errors["nll"] == one.step_errors["nll"]


def test_forecasts_that_are_not_finite_are_no_result(data: Path, checkpoint: Path, tmp_path: Path, monkeypatch: Any):
    measured = evaluation.run_windows

    def diverged(forecaster: Any, *arguments: Any, **named: Any) -> Iterator[Outcome]:
        for outcome in measured(forecaster, *arguments, **named):
            if isinstance(forecaster, DGVAE):
                forecast = outcome.forecast.clone()
                forecast[0, 1] = math.nan  # one sample of one window: the mean of the others would look well
                outcome = replace(outcome, forecast=forecast)
            yield outcome

    monkeypatch.setattr(evaluation, "run_windows", diverged)
    with pytest.raises(UserError, match="forecasts numbers that are not finite; its weights are damaged or diverged"):
        evaluate(EvaluateConfig(str(checkpoint), data, out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_three_axes(tmp_path: Path):
    layout = SceneSpec(
        1.0, ("world",) * 3, feature_names=KINEMATIC_FEATURES_3D, feature_scales=(1.0,) * 6, has_ego=False, max_agents=9
    )
    states = np.zeros((8, 2, 6), dtype=np.float32)
    states[:, :, 2] = np.arange(8.0)[:, None] ** 2  # climbs ever faster
    states[:, :, 5] = 2 * np.arange(8.0)[:, None]
    episode = Episode(states, np.ones((8, 2), dtype=np.bool_), np.arange(2))
    write_store(tmp_path / "solid", StoreInfo(layout, "solid"), [episode])
    (found,) = evaluate(
        EvaluateConfig("constant-velocity", tmp_path / "solid", num_samples=1, horizon_steps=2, out=tmp_path / "out")
    )
    assert found.axes == 3
    assert found.by_step_m == pytest.approx([1.0, 4.0])  # what v·t leaves out of (t + h)²
    assert (tmp_path / "out" / "scenes.png").exists()


def refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *words: object) -> str:
    with pytest.raises(SystemExit) as stop:
        run(monkeypatch, *words)
    assert stop.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    return captured.err


def another_time_step(data: Path, checkpoint: Path) -> list[Any]:
    other = data.with_name("other")
    write_store(other, StoreInfo(spec(dt_s=0.2), "quick"), read_store(data).episodes)
    return ["--checkpoint", checkpoint, "--data", other]


def other_features(data: Path, checkpoint: Path) -> list[Any]:
    other, (first, *_) = data.with_name("other"), read_store(data).episodes
    layout = SceneSpec(1.0, feature_names=(*spec().feature_names, "heading_rad"), feature_scales=(1.0,) * 5)
    states = first.states[..., [0, 1, 2, 3, 3]]
    write_store(other, StoreInfo(layout, "turning"), [replace(first, states=states)])
    return ["--checkpoint", checkpoint, "--data", other]


def no_such_store(data: Path, checkpoint: Path) -> list[Any]:
    return ["--checkpoint", checkpoint, "--data", data.with_name("nowhere")]


def no_such_checkpoint(data: Path, checkpoint: Path) -> list[Any]:
    return ["--checkpoint", "highwy", "--data", data]


def truncated_checkpoint(data: Path, checkpoint: Path) -> list[Any]:
    weights = checkpoint / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-10])
    return ["--checkpoint", checkpoint, "--data", data]


def negative_samples(data: Path, checkpoint: Path) -> list[Any]:
    return ["--checkpoint", checkpoint, "--data", data, "--num-samples", -1]


def no_horizon(data: Path, checkpoint: Path) -> list[Any]:
    return ["--checkpoint", checkpoint, "--data", data, "--horizon-steps", 0]


def horizon_beyond_every_episode(data: Path, checkpoint: Path) -> list[Any]:
    return ["--checkpoint", checkpoint, "--data", data, "--horizon-steps", 6]


def no_agent_stays(data: Path, checkpoint: Path) -> list[Any]:
    other, episodes = data.with_name("other"), read_store(data).episodes
    for episode in episodes:
        episode.valid[1::2, 1] = False
        episode.states[1::2, 1] = 0
    write_store(other, StoreInfo(spec(), "restless"), episodes)
    return ["--checkpoint", checkpoint, "--data", other]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (another_time_step, "toy' was trained at dt_s=1 but store "),
        (another_time_step, "steps at dt_s=0.2; retrain on its data"),
        (other_features, "'heading_rad')"),
        (no_such_store, "no episode store at "),
        (no_such_checkpoint, "no checkpoint 'highwy': neither a folder nor a shipped name"),
        (truncated_checkpoint, "model.safetensors is no safetensors file"),
        (negative_samples, "samples must be at least 1, got -1"),
        (no_horizon, "horizon_steps must be at least 1, got 0"),
        (horizon_beyond_every_episode, "episodes have at most 6 steps, a horizon of 6 needs 7; lower --horizon-steps"),
        (no_agent_stays, "in 15 windows no agent but the ego is there for all 2 steps of the horizon; lower --horizon"),
    ],
)
def test_bad_input_is_one_line(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    data: Path,
    checkpoint: Path,
    tmp_path: Path,
    words: Any,
    message: str,
):
    given = refused(monkeypatch, capsys, *words(data, checkpoint), "--out", tmp_path / "out")
    assert given.startswith("error: ") and message in given
    assert not (tmp_path / "out").exists()


def test_windows_without_a_future_are_refused(data: Path, checkpoint: Path, tmp_path: Path):
    short = [replace(e, states=e.states[:1], valid=e.valid[:1]) for e in read_store(data).episodes]
    write_store(tmp_path / "short", StoreInfo(spec(), "short"), short)
    with pytest.raises(UserError, match="no window fits: episodes have at most 1 steps"):
        evaluate(EvaluateConfig(str(checkpoint), tmp_path / "short"))


def test_longest_horizon_that_fits_is_measured(data: Path, checkpoint: Path):
    accuracies = evaluate(EvaluateConfig(str(checkpoint), data, horizon_steps=5, num_samples=2))
    assert all(len(r.by_step_m) == 5 and r.agents == 3 and math.isfinite(r.min_ade_m) for r in accuracies)


def test_windows_go_through_in_parts_and_change_nothing(data: Path, checkpoint: Path, monkeypatch: pytest.MonkeyPatch):
    whole = evaluate(EvaluateConfig(str(checkpoint), data, num_samples=3))
    sizes: list[int] = []
    batch = Windows.batch
    monkeypatch.setattr("predictor.evaluation.outcomes.MOST_PAIRS", 1)
    monkeypatch.setattr(Windows, "batch", lambda self, chosen: sizes.append(len(chosen)) or batch(self, chosen))
    parts = evaluate(EvaluateConfig(str(checkpoint), data, num_samples=3))
    assert set(sizes) == {1}
    for one, other in zip(whole, parts, strict=True):
        assert other.min_ade_m == pytest.approx(one.min_ade_m, rel=1e-5)
