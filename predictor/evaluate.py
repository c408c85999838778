"""Measures a checkpoint on recorded data: `python -m predictor.evaluate --checkpoint NAME --data STORE`.

Prints minADE and minFDE (per agent and joint, with standard errors over subsets of the episodes), miss rate, coverage,
and RMSE and NLL by horizon, of K samples (ADE and FDE of the single forecast as well), beside constant velocity, which
has noise if K is above 1; writes JSON, Markdown and plots. For accuracy in live environments, run
`python -m envs.evaluate`.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import matplotlib
import numpy as np
import torch
from matplotlib import pyplot as plt
from rich.console import Console

from predictor.baselines.constant_velocity import ConstantVelocity, NoisyConstantVelocity
from predictor.checkpoint import CONSTANT_VELOCITY, load_checkpoint, name_of_folder
from predictor.data.store import EpisodeStore, content_id, read_store
from predictor.data.windows import Windows
from predictor.evaluation.accuracy import Accuracy, fitted_std_m, summarise
from predictor.evaluation.displacement import miss_distance_m
from predictor.evaluation.outcomes import run_windows, windows_per_forward
from predictor.forecaster import Forecaster
from predictor.own_forecasters import WatchedForecaster, is_own, make_own
from predictor.reports.looks import STYLE
from predictor.reports.plots import plot_error_by_horizon, plot_scene, save_figure
from predictor.reports.tables import MODEL_NAMES, accuracy_table, markdown_table
from predictor.scene import SceneSpec
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least, check_positive
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import check_out, finite, write_json, write_text
from predictor.support.memory import check_count
from predictor.support.progress import track
from predictor.support.provenance import provenance
from predictor.support.runtime import resolve_device, tune


@dataclass(frozen=True)
class EvaluateConfig:
    """Measures a predictor's accuracy on recorded episodes, beside constant velocity."""

    checkpoint: str
    """Checkpoint to measure: shipped name, folder, run folder, "constant-velocity", or own:module:function."""
    data: Path
    """Episode store that was not trained on."""
    out: Path | None = None
    """Folder for accuracy.json, accuracy.md and plots; none are written if left out."""
    num_samples: int = 20
    """Number of forecasts (K) of the model, and of constant velocity, which has noise if K is above 1."""
    history_steps: int = 10
    """Number of observed steps that the model gets before each forecast (fewer where the episode has just begun)."""
    horizon_steps: int | None = None
    """Number of steps to forecast; None takes the checkpoint's (5 for constant velocity)."""
    miss_m: float | None = None
    """Final displacement above which a forecast misses, and distance below which agents overlap [m]; None takes 2 m, a
    tenth of the scale where that is below 50 m."""
    max_windows: int = 4000
    """Number of windows measured at most, drawn evenly from the store."""
    seed: int = 0
    """Random seed for window sampling and forecasts."""
    device: str = "cpu"
    """Device that runs the model: cpu, cuda or auto (cuda where there is one)."""

    def __post_init__(self) -> None:
        """Checks ranges; `device="auto"` becomes the device that is taken.

        Raises:
            UserError: a value out of range, or a device that is not there.
        """
        check_at_least(self, 1, "num_samples", "history_steps", "horizon_steps", "max_windows")
        check_at_least(self, 0, "seed")
        check_positive(self, "miss_m")
        check_count(self.num_samples, "num_samples")
        check_count(self.num_samples * (self.horizon_steps or 1), "horizon_steps times num_samples", 8)
        object.__setattr__(self, "device", resolve_device(self.device))


@dataclass(frozen=True)
class _Subject:
    store: EpisodeStore
    spec: SceneSpec
    horizon: int
    model: Forecaster | None = None  # None: constant velocity alone
    std_m: tuple[float, ...] = ()
    name: str = ""
    note: str = ""


def evaluate(config: EvaluateConfig) -> list[Accuracy]:
    """Returns the accuracy of the model and of constant velocity, with `num_samples` samples (noise, if several).

    Raises:
        UserError: `out` is a file, checkpoint or store is unreadable, their specs differ, or no episode is as long as
            the horizon.
    """
    return _evaluate(config, _load(config))


def _load(config: EvaluateConfig) -> _Subject:
    if config.out is not None:
        check_out(config.out)
    if config.checkpoint == CONSTANT_VELOCITY:
        store = read_store(config.data)
        spec = store.info.spec
        return _Subject(store, spec, config.horizon_steps or ConstantVelocity(spec).horizon_steps)
    if is_own(config.checkpoint):
        return _load_own(config)
    model, info = load_checkpoint(config.checkpoint, config.device)
    store = read_store(config.data)
    info.spec.check_recorded(store.info.spec, f"checkpoint '{config.checkpoint}'", f"store {config.data}")
    name, horizon = MODEL_NAMES.get(info.model, info.model), config.horizon_steps or info.horizon_steps
    trained_on = info.provenance.get("stores")
    known = isinstance(trained_on, dict) and content_id(config.data) in trained_on.values()
    note = f"{config.data} is a store that '{config.checkpoint}' was trained with: its errors elsewhere may be larger"
    return _Subject(store, info.spec, horizon, model, info.std_m, name, note if known else "")


def _load_own(config: EvaluateConfig) -> _Subject:
    if config.device != "cpu":
        raise UserError(f"a forecaster of your own runs on the CPU, got --device {config.device}; leave it out")
    store, source = read_store(config.data), f"store {config.data}"
    model = WatchedForecaster(make_own(config.checkpoint, store.info.spec, source), config.checkpoint)
    model.spec.check_recorded(store.info.spec, f"forecaster '{config.checkpoint}'", source)
    horizon = config.horizon_steps or model.horizon_steps
    return _Subject(store, model.spec, horizon, model, name=name_of_folder(config.checkpoint))


def _evaluate(config: EvaluateConfig, subject: _Subject) -> list[Accuracy]:
    horizon, baseline = subject.horizon, ConstantVelocity(subject.spec, subject.horizon)
    longest = max(len(e.states) for e in subject.store.episodes)
    if 1 < longest <= horizon:
        raise UserError(
            f"store {config.data}: episodes have at most {longest} steps, a horizon of {horizon} needs {horizon + 1}; "
            "lower --horizon-steps or record longer episodes"
        )
    windows = Windows(subject.store.episodes, subject.spec, config.history_steps, horizon)
    chosen = np.random.default_rng(config.seed).permutation(len(windows))[: config.max_windows]
    # Without training data, the spread of both baselines is fitted to the test errors, in their favour.
    size = windows_per_forward(windows, chosen, config.num_samples)
    std_m = fitted_std_m(run_windows(baseline, windows, chosen, horizon, batch_size=size))
    miss_m = config.miss_m or miss_distance_m(subject.spec.feature_scales[0])
    made = run_windows(baseline, windows, chosen, horizon, batch_size=size)
    straight = summarise("constant velocity", made, std_m, miss_m)
    if not straight.agents:
        raise UserError(
            f"store {config.data}: in {len(chosen)} windows no agent{' but the ego' * subject.spec.has_ego} is there "
            f"for all {horizon} steps of the horizon; lower --horizon-steps, raise --max-windows or record longer "
            "episodes"
        )
    accuracies = []
    if subject.model is not None:
        made = run_windows(
            subject.model, windows, chosen, horizon, config.num_samples, config.seed, size, config.device
        )
        batches = track(made, "evaluate", total=-(-len(chosen) // size))
        accuracies.append(summarise(subject.name, batches, subject.std_m, miss_m))
    if config.num_samples == 1:
        accuracies.append(straight)
    else:
        noisy = NoisyConstantVelocity.fit(subject.spec, std_m)
        made = run_windows(noisy, windows, chosen, horizon, config.num_samples, config.seed, size)
        # draws hold the spread already: the density is one Gaussian around the single forecast
        drawn = summarise("constant velocity + noise", made, std_m, miss_m)
        error = straight.step_errors["nll"]
        accuracies.append(replace(drawn, nll=straight.nll, step_errors=drawn.step_errors | {"nll": error}))
    if config.out is not None:
        _write(config, accuracies, subject.store.info.source, subject.spec.dt_s)
        _plot(config, accuracies, windows, chosen, subject.model or baseline, horizon)
    return accuracies


def _write(config: EvaluateConfig, accuracies: Sequence[Accuracy], source: str, dt_s: float) -> None:
    assert config.out is not None
    config.out.mkdir(parents=True, exist_ok=True)
    made = provenance(("torch", "numpy"))
    content = {"source": source, "dt_s": dt_s, "config": asdict(config), "rows": [asdict(a) for a in accuracies]}
    write_json(config.out / "accuracy.json", finite(content | {"provenance": made}))
    write_text(config.out / "accuracy.md", markdown_table(accuracies, dt_s))


@matplotlib.rc_context(STYLE)
def _plot(
    config: EvaluateConfig,
    accuracies: Sequence[Accuracy],
    windows: Windows,
    chosen: np.ndarray,
    model: Forecaster,
    horizon: int,
) -> None:
    assert config.out is not None
    matplotlib.use("Agg")
    figure, ax = plt.subplots(figsize=(6, 4), layout="constrained")
    plot_error_by_horizon(ax, accuracies, windows.spec.dt_s)
    save_figure(figure, config.out / "error_by_horizon.png", 130)
    device = "cpu" if isinstance(model, ConstantVelocity) else config.device
    shown = chosen[:200]
    (seen,) = run_windows(ConstantVelocity(windows.spec), windows, shown, horizon, batch_size=len(shown))
    busiest = shown[torch.argsort(seen.valid.all(-1).sum(-1), descending=True, stable=True)[:4].numpy()]
    samples, batch = min(config.num_samples, 10), windows.batch(busiest)
    (outcome,) = run_windows(model, windows, busiest, horizon, samples, config.seed, len(busiest), device)
    figure, axes = plt.subplots(2, 2, figsize=(11, 8), layout="constrained")
    for window, ax in enumerate(axes.flat[: len(busiest)]):
        past = slice(0, int(batch.last_observed[window]) + 1)
        plot_scene(
            ax,
            batch.states[window, past, :, :2].numpy(),
            batch.valid[window, past].numpy(),
            outcome.forecast[window, ..., :2].cpu().numpy(),
            outcome.future[window, ..., :2].cpu().numpy(),
            outcome.valid[window].cpu().numpy(),
        )
    figure.suptitle("history solid, forecast dashed, truth thin black")
    save_figure(figure, config.out / "scenes.png", 110)


def main() -> None:
    """Entry point."""
    config = parse(EvaluateConfig, __doc__)
    tune(config.device)
    subject = _load(config)
    accuracies = _evaluate(config, subject)
    title = f"{config.checkpoint} on {config.data}"
    console = Console()
    console.print(accuracy_table(accuracies, subject.spec.dt_s, title))
    if subject.note:
        console.print(subject.note, markup=False, soft_wrap=True)


if __name__ == "__main__":
    run_entry_point(main)
