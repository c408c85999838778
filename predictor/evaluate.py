"""Measure a checkpoint on recorded data: `python -m predictor.evaluate --checkpoint NAME --data STORE`.

Prints minADE, minFDE, RMSE and NLL by horizon for K = 1 and K samples beside constant velocity; writes JSON,
Markdown and plots. Accuracy in the loop that a policy drives is `python -m envs.evaluate`'s.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import matplotlib
import numpy as np
import torch
import tyro
from matplotlib import pyplot as plt
from rich.console import Console
from rich.progress import track
from rich.table import Table

from predictor.accuracy import Accuracy, Outcome, fitted_std_m, run_window_batch, run_windows, summarise
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.checkpoint import load_checkpoint
from predictor.data.store import read_store
from predictor.data.windows import Windows
from predictor.errors import UserError, run_entry_point
from predictor.forecaster import Forecaster
from predictor.plots import plot_error_by_horizon, plot_scene
from predictor.provenance import provenance, write_json


@dataclass(frozen=True)
class EvaluateConfig:
    """Measure a predictor's accuracy on recorded episodes, beside constant velocity."""

    checkpoint: str
    """Shipped name or folder."""
    data: Path
    """Episode store that was not trained on."""
    out: Path | None = None
    """Folder for accuracy.json, accuracy.md and plots; none are written if left out."""
    samples: int = 20
    """K of the second row; the first is always K = 1, the most likely forecast."""
    history_steps: int = 10
    """Steps streamed before each forecast (fewer where the episode has just begun)."""
    horizon_steps: int | None = None
    """Steps to forecast; None takes the checkpoint's."""
    max_windows: int = 4000
    """Forecasts to make, drawn evenly from the store."""
    seed: int = 0
    """Of the drawn windows and samples."""
    device: str = "cpu"
    """"cpu" or "cuda"."""

    def check(self) -> None:
        """Check ranges.

        Raises:
            UserError: a value that makes no sense. (In `__post_init__`, tyro would turn it into a box of lines.)
        """
        if self.device.startswith("cuda") and not torch.cuda.is_available():
            raise UserError(f"device '{self.device}' asked for but torch sees no CUDA device; use --device cpu")
        for name in ("samples", "history_steps", "max_windows"):
            if getattr(self, name) < 1:
                raise UserError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.horizon_steps is not None and self.horizon_steps < 1:
            raise UserError(f"horizon_steps must be at least 1, got {self.horizon_steps}")


def evaluate(config: EvaluateConfig) -> list[Accuracy]:
    """Rows for the model at K = 1 and K = `samples`, and for constant velocity."""
    model, info = load_checkpoint(config.checkpoint, config.device)
    store = read_store(config.data)
    info.spec.check_compatible(store.info.spec, f"checkpoint '{config.checkpoint}'", f"store {config.data}")
    horizon = config.horizon_steps or info.horizon_steps
    windows = Windows(store.episodes, info.spec, config.history_steps, horizon)
    chosen = np.random.default_rng(config.seed).permutation(len(windows))[: config.max_windows]
    baseline = ConstantVelocity(info.spec, horizon)
    entries: list[tuple[str, Forecaster, int]] = [("dG-VAE", model, k) for k in sorted({1, config.samples})]
    entries.append(("constant velocity", baseline, 1))
    rows = []
    for name, forecaster, samples in track(entries, description="evaluate"):
        device = config.device if forecaster is model else "cpu"
        outcomes = list(run_windows(forecaster, windows, chosen, horizon, samples, config.seed, device=device))
        # Constant velocity has no training data of its own; its spread is fitted on these very errors, in its favour.
        std_m = info.std_m if forecaster is model else fitted_std_m(outcomes)
        rows.append(summarise(name, outcomes, std_m))
    if config.out is not None:
        _write(config, rows, store.info.source, info.spec.dt_s)
        _plot(config, rows, windows, chosen, model, horizon)
    return rows


def accuracy_table(rows: Sequence[Accuracy], dt_s: float, title: str) -> Table:
    """One line per row; the columns by horizon are displacement / RMSE / NLL."""
    table = Table(title=title)
    table.add_column("forecaster")
    for heading in ("K", r"minADE \[m]", r"minFDE \[m]", "forecasts"):
        table.add_column(heading, justify="right")
    for step in range(len(rows[0].by_step_m)):
        table.add_column(f"{dt_s * (step + 1):g} s", justify="right")
    for row in rows:
        cells = [
            "/".join([f"{d:.2f}", f"{r:.2f}", *([f"{row.nll[i]:.2f}"] if row.nll else [])])
            for i, (d, r) in enumerate(zip(row.by_step_m, row.rmse_m, strict=True))
        ]
        head = [f"{row.min_ade_m:.3f}", f"{row.min_fde_m:.3f}", str(row.agents)]
        table.add_row(row.name, str(row.num_samples), *head, *cells)
    table.caption = r"by time ahead: displacement of the best sample \[m] / RMSE of the mean \[m] / NLL \[nats]"
    return table


def markdown_table(rows: Sequence[Accuracy], dt_s: float) -> str:
    """The same as Markdown."""
    steps = [f"{dt_s * (i + 1):g} s" for i in range(len(rows[0].by_step_m))]
    lines = ["| " + " | ".join(["forecaster", "K", "minADE [m]", "minFDE [m]", *steps]) + " |"]
    lines.append("|" + "---|" * (4 + len(steps)))
    for row in rows:
        cells = [row.name, str(row.num_samples), f"{row.min_ade_m:.3f}", f"{row.min_fde_m:.3f}"]
        lines.append("| " + " | ".join([*cells, *(f"{d:.2f}" for d in row.by_step_m)]) + " |")
    return "\n".join(lines) + "\n"


def _write(config: EvaluateConfig, rows: Sequence[Accuracy], source: str, dt_s: float) -> None:
    assert config.out is not None
    config.out.mkdir(parents=True, exist_ok=True)
    made = provenance(("torch", "numpy"))
    content = {"source": source, "dt_s": dt_s, "config": asdict(config), "rows": [asdict(r) for r in rows]}
    write_json(config.out / "accuracy.json", content | {"provenance": made})
    (config.out / "accuracy.md").write_text(markdown_table(rows, dt_s))


def _plot(
    config: EvaluateConfig,
    rows: Sequence[Accuracy],
    windows: Windows,
    chosen: np.ndarray,
    model: Forecaster,
    horizon: int,
) -> None:
    assert config.out is not None
    matplotlib.use("Agg")
    figure, ax = plt.subplots(figsize=(6, 4), layout="constrained")
    plot_error_by_horizon(ax, rows, windows.spec.dt_s)
    figure.savefig(config.out / "error_by_horizon.png", dpi=130)
    plt.close(figure)
    batch = windows.batch(chosen[:200])
    outcome: Outcome = run_window_batch(
        model, batch.to(torch.device(config.device)), horizon, min(config.samples, 10), torch.Generator(config.device)
    )
    busiest = torch.argsort(outcome.valid.cpu().all(-1).sum(-1), descending=True)[:4].tolist()
    figure, axes = plt.subplots(2, 2, figsize=(11, 8), layout="constrained")
    for ax, row in zip(axes.flat, busiest, strict=False):
        past = slice(0, int(batch.last_observed[row]) + 1)
        plot_scene(
            ax,
            batch.states[row, past, :, :2].numpy(),
            batch.valid[row, past].numpy(),
            outcome.forecast[row].cpu().numpy(),
            outcome.future[row].cpu().numpy(),
            outcome.valid[row].cpu().numpy(),
        )
    figure.suptitle("history solid, forecast dashed, truth thin black")
    figure.savefig(config.out / "scenes.png", dpi=110)
    plt.close(figure)


def main() -> None:
    """Entry point."""
    config = tyro.cli(EvaluateConfig, description=__doc__)
    config.check()
    rows = evaluate(config)
    dt_s = load_checkpoint(config.checkpoint)[1].spec.dt_s
    Console(width=160).print(accuracy_table(rows, dt_s, f"{config.checkpoint} on {config.data}"))


if __name__ == "__main__":
    run_entry_point(main)
