"""Report of a predictor's training: what it reached, its curves, accuracy, card and settings."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from predictor.checkpoint import BEST_OF_RUN, CARD, MOST_CARD_BYTES, CheckpointInfo, read_info
from predictor.reports.document import Block, Code, Heading, Paragraph, Picture, Table
from predictor.reports.figures import files_of, panels
from predictor.reports.looks import COLORS, GREY
from predictor.reports.run_blocks import NOTHING, accuracy, origin, settings
from predictor.reports.tables import MODEL_NAMES
from predictor.support.errors import UserError, short
from predictor.support.reading import as_object, read_object, read_text
from predictor.support.typed_values import converted
from predictor.training.curve import CURVE_FILE, Point, read_curve

_REACHED = {
    "val_energy_m": "energy score [m]", "val_ade_m": "ADE₁ [m]", "val_fde_m": "FDE₁ [m]", "val_min_ade_m": "minADE [m]",
    "val_min_fde_m": "minFDE [m]", "val_constant_velocity_ade_m": "constant velocity ADE [m]",
}  # fmt: skip
_NLL = "negative log-likelihood"


def predictor_blocks(run: Path, accuracies: Sequence[Path]) -> list[Block]:
    """Returns the blocks of the report.

    Args:
        run: run folder of `python -m predictor.train`.
        accuracies: folders of measurements that are shown where they have accuracy.json.

    Raises:
        UserError: the folder holds no such run, or a file of it is damaged.
    """
    content = read_object(run / "config.json")
    where = str(run / "config.json")
    config = as_object(content.get("config"), f"{where}: config")
    if not os.path.lexists(run / BEST_OF_RUN):
        raise UserError(f"{run} has no checkpoint yet: its training has not validated; continue it with --resume")
    info = read_info(run / BEST_OF_RUN)
    name = MODEL_NAMES.get(info.model, info.model)
    headline = short(f"{name}, trained on {', '.join(info.sources) or 'unnamed data'}", 200)
    blocks: list[Block] = [Heading(headline, 1), Paragraph(_summary(info, name)), *_reached(info, config)]
    curve = read_curve(run / CURVE_FILE)
    if curve:
        told = f"Measured on held-out episodes during training; the checkpoint is {_chosen(config)}."
        svg, png = files_of(*drawn(curve))
        blocks += [Heading("Learning curves"), Picture("curves.svg", svg, told, png)]
    else:
        blocks.append(Paragraph(f"No {CURVE_FILE}: the run is older than that file; TensorBoard shows its curves."))
    blocks += accuracy(accuracies)
    if os.path.lexists(run / BEST_OF_RUN / CARD):
        card = read_text(run / BEST_OF_RUN / CARD, MOST_CARD_BYTES)
        blocks += [Heading("Card"), Code(card, "markdown")]
    return [*blocks, *settings(config), *origin([content.get("provenance", {})], where)]


def drawn(curve: Sequence[Point]) -> tuple[Figure, list[Axes]]:
    """Draws error and energy score against the steps of training."""
    figure, axes = panels(2)
    steps = np.array([point["step"] for point in curve])
    for ax, names, label in (
        (axes[0], {"energy_m": "energy score"}, "energy score [m]"),
        (axes[1], {"ade_m": "single forecast", "min_ade_m": "best of the samples"}, "mean displacement [m]"),
    ):
        for color, (key, name) in zip(COLORS[3 * (ax is axes[0]) :], names.items(), strict=False):
            ax.plot(steps, [point[key] for point in curve], marker="o", ms=3.5, color=color, label=name)
        ax.set_xlabel("training steps")
        ax.set_ylabel(label)
        ax.set_xlim(left=0)
    straight = [point["constant_velocity_ade_m"] for point in curve]
    axes[1].plot(steps, straight, color=GREY, ls="--", lw=1.2, label="constant velocity")
    for ax in axes:
        ax.set_ylim(bottom=0)
    return figure, axes


def _summary(info: CheckpointInfo, name: str) -> str:
    spec = info.spec
    return (
        f"{name}; forecasts {info.horizon_steps} steps of {spec.dt_s:g} s for at most {spec.max_agents} agents within "
        f"{spec.perception_m:g} m."
    )


def _chosen(config: Mapping[str, Any]) -> str:
    """Returns which of the validated weights the checkpoint has."""
    if config.get("keep") == "last":
        return "the last one"
    return f"the one with the lowest {_NLL if config.get('only_spread') else 'energy score'}"


def _reached(info: CheckpointInfo, config: Mapping[str, Any]) -> list[Block]:
    """Returns the table of the validation of the checkpoint."""
    where, made, columns = "config.json of the checkpoint: provenance", info.provenance, _REACHED
    if config.get("only_spread"):
        made, columns = (
            as_object(made.get("spread", {}), f"{where}.spread"),
            {**_REACHED, "val_mixture_nll": f"{_NLL} [nats]"},
        )
    result = as_object(made.get("result", {}), f"{where}.result")
    if not result:
        return []
    step, samples = (converted(result.get(key), int | None, f"{where}.{key}") for key in ("step", "val_samples"))
    found = [converted(result.get(key), float | None, f"{where}.{key}") for key in columns]
    cells = [NOTHING if value is None else f"{value:.3f}" for value in found]
    told = f"The checkpoint is of step {step}, {_chosen(config)}; held-out episodes, {samples} samples."
    return [Heading("Validation"), Table(["step", *columns.values()], [[str(step), *cells]]), Paragraph(told)]
