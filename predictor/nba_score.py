"""NBA "Score", SocialVAE's protocol: `python -m predictor.nba_score --data data/nba_score/test --checkpoint NAME`.

Measures checkpoints and constant velocity, each also with Gaussian noise that is fitted to `--train-data`, on every
window of the test store: 8 observed frames of 0.12 s, 12 predicted ones, best of K = 20 for each player, in feet.
Prints a table beside the published figures; writes JSON and Markdown. `predictor.evaluation.nba_protocol` defines the
protocol, docs/datasets/nba.md has the commands that make the stores and train a model.
"""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.checkpoint import load_checkpoint, names_of
from predictor.data.store import read_store
from predictor.data.windows import Windows
from predictor.evaluation import nba_protocol
from predictor.evaluation.nba_protocol import (
    HORIZON_STEPS,
    NUM_SAMPLES,
    PUBLISHED,
    TEST_FORECASTS,
    PlayerErrors,
    PlayerTally,
    drawn,
    fitted_noise,
    fitted_residual,
    player_outcomes,
    protocol_windows,
)
from predictor.forecaster import Forecaster
from predictor.support import markdown
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import check_out, finite, write_json, write_text
from predictor.support.memory import ITEM_BYTES, check_count
from predictor.support.provenance import provenance
from predictor.support.runtime import resolve_device, tune

HEADINGS = (
    "forecaster",
    "K",
    "minADE [ft]",
    "minFDE [ft]",
    "joint ADE [ft]",
    "joint FDE [ft]",
    "ADE₁ [ft]",
    "FDE₁ [ft]",
    "energy [ft]",
    "cover",
    "time [s]",
)
NOTE = (
    "minADE, minFDE: each player's best sample, in brackets 95 % bootstrap intervals over possessions; joint: best "
    "sample of all ten players together; ADE₁, FDE₁: single forecast; energy: energy score, lower is better; cover: "
    "truths within the central 90 % of the samples"
)


@dataclass(frozen=True)
class NbaScoreConfig:
    """Measures forecasters by the protocol "NBA Score"."""

    data: Path
    """Episode store of the test folder, with whole possessions (python -m predictor.data.nba --episode-steps 0)."""
    checkpoint: tuple[str, ...] = ()
    """Checkpoints to measure: shipped names, folders, run folders."""
    train_data: Path | None = None
    """Episode store to which the noise around constant velocity, and around the single forecast of each checkpoint, is
    fitted; None leaves these rows out."""
    out: Path | None = None
    """Folder for nba_score.json and nba_score.md; none are written if left out."""
    num_samples: int = NUM_SAMPLES
    """Number of samples (K) of every stochastic row; the published figures have 20."""
    max_windows: int = 0
    """Number of windows measured at most (ten forecasts each), drawn evenly; 0 measures all."""
    batch_size: int = 64
    """Number of windows in one forward; limits the memory."""
    seed: int = 0
    """Random seed of the samples and of the drawn windows."""
    device: str = "cpu"
    """Device that runs the models: cpu, cuda or auto (cuda where there is one)."""

    def __post_init__(self) -> None:
        """Checks ranges; `device="auto"` becomes the device that is taken.

        Raises:
            UserError: a value out of range, noise where a single sample has none, or a device that is not there.
        """
        check_at_least(self, 1, "num_samples", "batch_size")
        check_count(self.num_samples, "num_samples", ITEM_BYTES * HORIZON_STEPS)
        check_count(self.batch_size, "batch_size")
        check_at_least(self, 0, "max_windows", "seed")
        if self.train_data is not None and self.num_samples == 1:
            raise UserError(
                "--train-data needs --num-samples of at least 2: sample 0 of a forecast with noise has none; leave "
                "--train-data out"
            )
        object.__setattr__(self, "device", resolve_device(self.device))


def measure(config: NbaScoreConfig) -> list[PlayerErrors]:
    """Returns the errors of constant velocity and of each checkpoint, each also with noise around its single forecast.

    Raises:
        UserError: `out` is a file, a checkpoint is given twice, a store or checkpoint is unreadable, or specs differ.
    """
    if config.out is not None:
        check_out(config.out)
    labels = names_of(config.checkpoint)
    models = [load_checkpoint(name, config.device) for name in config.checkpoint]
    windows = protocol_windows(read_store(config.data), config.data)
    for name, (_, info) in zip(config.checkpoint, models, strict=True):
        info.spec.check_recorded(windows.spec, f"checkpoint '{name}'", f"store {config.data}")
    straight = ConstantVelocity(windows.spec, nba_protocol.HORIZON_STEPS)
    lines = [_measured("constant velocity", straight, windows, config, 1)]
    training = None
    if config.train_data is not None:
        training = protocol_windows(read_store(config.train_data), config.train_data)
        noise = fitted_noise(training, drawn(training, config.max_windows, config.seed))
        lines.append(_measured("constant velocity + noise", noise, windows, config))
    for name, (model, _) in zip(config.checkpoint, models, strict=True):
        label = labels[name]
        if training is not None:
            noisy = fitted_residual(model, training, config.seed, config.device)
            lines.append(_measured(f"{label}, single forecast + Gaussian", noisy, windows, config))
        lines.append(_measured(label, model, windows, config))
    return lines


def _measured(
    name: str, forecaster: Forecaster, windows: Windows, config: NbaScoreConfig, num_samples: int = 0
) -> PlayerErrors:
    device = "cpu" if isinstance(forecaster, ConstantVelocity) else config.device
    indices = drawn(windows, config.max_windows, config.seed)
    tally, began = PlayerTally(len(windows.flat.steps)), time.perf_counter()
    for possession, outcome in player_outcomes(
        forecaster, windows, indices, num_samples or config.num_samples, config.seed, config.batch_size, device, name
    ):
        tally.add(possession, outcome)
    return tally.errors(name, time.perf_counter() - began)


def table_lines(lines: Sequence[PlayerErrors]) -> list[list[str]]:
    """Returns the cells of the table, the published figures last."""
    shown = [
        [
            line.name,
            str(line.num_samples),
            _with_interval(line, "min_ade_ft"),
            _with_interval(line, "min_fde_ft"),
            f"{line.min_joint_ade_ft:.2f}",
            f"{line.min_joint_fde_ft:.2f}",
            f"{line.ade_ft:.2f}",
            f"{line.fde_ft:.2f}",
            f"{line.energy_ft:.2f}",
            "–" if line.coverage is None else f"{line.coverage:.0%}",
            f"{line.seconds:,.0f}",
        ]
        for line in lines
    ]
    missing = ["–"] * (len(HEADINGS) - 4)
    return shown + [
        [p.name, str(NUM_SAMPLES), f"{p.min_ade_ft:.2f}", f"{p.min_fde_ft:.2f}", *missing] for p in PUBLISHED
    ]


def _with_interval(line: PlayerErrors, name: str) -> str:
    found = line.intervals.get(name)
    return f"{getattr(line, name):.3f}" + (f" ({found[0]:.2f}–{found[1]:.2f})" if found else "")


def sentence(lines: Sequence[PlayerErrors]) -> str:
    """Returns what was measured, and whether these are the published windows."""
    forecasts = lines[0].forecasts
    if forecasts == TEST_FORECASTS:
        return f"{forecasts:,} forecasts, all of the published test windows."
    return f"{forecasts:,} forecasts; the published figures are over {TEST_FORECASTS:,}."


def _write(out: Path, config: NbaScoreConfig, lines: Sequence[PlayerErrors]) -> None:
    out.mkdir(parents=True, exist_ok=True)
    made = provenance(("torch", "numpy"))
    published = [p._asdict() for p in PUBLISHED]
    content: dict[str, Any] = {"config": asdict(config), "rows": [asdict(line) for line in lines]}
    write_json(out / "nba_score.json", finite(content | {"published": published, "provenance": made}))
    table = markdown.table(HEADINGS, table_lines(lines), "lr")
    command = f"`{made['command']}`, commit {made['commit']}, {made['machine']}."
    write_text(out / "nba_score.md", "\n\n".join(["# NBA Score", sentence(lines), table, f"{NOTE}.", command]) + "\n")


def main() -> None:
    """Entry point."""
    config = parse(NbaScoreConfig, __doc__)
    tune(config.device)
    lines = measure(config)
    if config.out is not None:
        _write(config.out, config, lines)
    table = Table(*map(escape, HEADINGS), title=f"NBA Score: {sentence(lines)}", caption=NOTE)
    for cells in table_lines(lines):
        table.add_row(*cells)
    Console(width=160).print(table)


if __name__ == "__main__":
    run_entry_point(main)
