"""Report of a policy's run: films, curves, the evaluation with its controls, errors in the loop, settings."""

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from agents.forecast_errors import CONSTANT_ERROR, FORECAST_ERROR
from agents.results import NOT_REPORTED, Evaluation, read_evaluation
from agents.runs import CONFIG_FILE, CURVE_FILE, OPTIONS_OF, SUMMARY_FILE, read_config, read_curve
from agents.summaries import EXTREMES, percent_digits
from envs.simulators.envpool import ENV_IDS
from predictor.reports.document import JPEG, Block, Film, Heading, Paragraph, Picture, Table
from predictor.reports.figures import files_of, panels
from predictor.reports.looks import AS_TEXT, COLORS, GREY
from predictor.reports.run_blocks import NOTHING, accuracy, origin, settings
from predictor.support.errors import short
from predictor.support.reading import MIB, check_regular, read_bytes, read_object

WORST = 5
"""Number of episodes in the table of the worst."""
INSIDE_BYTES, INSIDE_TOTAL_BYTES = 4 * MIB, 16 * MIB
"""Largest size of a film that is put into the page, and of all of them together; others are linked."""
MOST_FILM_BYTES, MOST_FILMS = 1024 * MIB, 6
"""Largest size of a film, and largest number of films."""


def policy_blocks(run: Path, accuracies: Sequence[Path]) -> list[Block]:
    """Returns the blocks of the report.

    Args:
        run: run folder of train_policy.py.
        accuracies: folders of measurements of the forecasts that are shown where they have accuracy.json.

    Raises:
        UserError: the folder holds no such run, or a file of it is damaged.
    """
    config, points = read_config(run), read_curve(run / CURVE_FILE)
    summary = next((f for f in (run / SUMMARY_FILE, run / "evaluation" / SUMMARY_FILE) if os.path.lexists(f)), None)
    evaluation = None if summary is None else read_evaluation(summary)
    blocks: list[Block] = [Heading(title_of(config), 1), Paragraph(_summary(evaluation))]
    blocks += films(run)
    if points:
        told = "Mean return on the selection seeds during training. Grey lines: drivers on the seeds of the evaluation."
        svg, png = files_of(*drawn(points, {} if evaluation is None else references(evaluation)))
        blocks += [Heading("Learning curve"), Picture("curves.svg", svg, told, png)]
    if evaluation is not None:
        blocks += [Heading("Evaluation"), *_tables(evaluation), *_worst(evaluation)]
    named = {OPTIONS_OF.get(name, name): value for name, value in config.items()}
    blocks += [*_loop_errors(points), *accuracy(accuracies), *settings(named)]
    starts = read_object(run / CONFIG_FILE).get("provenance", [])
    return [*blocks, *origin(starts, str(run / CONFIG_FILE))]


def title_of(config: Mapping[str, Any]) -> str:
    """Returns the heading of the report."""
    sees = {"none": "no forecasts", "forecast": "forecasts"}.get(str(config.get("observe")), str(config.get("observe")))
    return short(f"{config.get('algorithm', 'policy')} on {config['env_id']}, sees {sees}", 160)


def references(evaluation: Evaluation) -> dict[str, float]:
    """Returns the mean returns of the best driver beside the policy and of the random one, by their names."""
    drivers = {summary.policy: summary.return_mean for summary in evaluation.summaries[1:]}
    best = max(drivers, key=lambda name: drivers[name], default=None)
    return {name: drivers[name] for name in dict.fromkeys((best, "random")) if name is not None and name in drivers}


@rc_context(AS_TEXT)
def drawn(points: Sequence[Mapping[str, Any]], lines: Mapping[str, float]) -> tuple[Figure, list[Axes]]:
    """Draws the return against the steps of training and, where they were measured, the errors of the forecasts.

    Args:
        points: measurements, at least one.
        lines: mean returns of drivers, by name.
    """
    errors = [p for p in points if p.get(FORECAST_ERROR) is not None and p.get(CONSTANT_ERROR) is not None]
    figure, axes = panels(2 if errors else 1)
    axes[0].plot([p["steps"] for p in points], [p["return"] for p in points], marker="o", ms=3.5, color=COLORS[0])
    axes[0].lines[0].set_label(f"policy (mean of {points[-1].get('episodes', 'several')} episodes)")
    for (name, value), dashes in zip(lines.items(), ("--", ":"), strict=False):
        axes[0].axhline(value, color=GREY, ls=dashes, lw=1.2, label=short(name, 40), zorder=0)
    axes[0].set_ylabel("return")
    if errors:
        steps = [p["steps"] for p in errors]
        axes[1].plot(steps, [p[FORECAST_ERROR] for p in errors], marker="o", ms=3.5, color=COLORS[1], label="forecast")
        straight = [p[CONSTANT_ERROR] for p in errors]
        axes[1].plot(steps, straight, marker="o", ms=3.5, color=GREY, ls="--", label="constant velocity")
        axes[1].set_ylabel("mean error in the loop [m]")
        axes[1].set_ylim(bottom=0)
    for ax in axes:
        ax.set_xlabel("environment steps")
        ax.set_xlim(left=0)
    return figure, axes


def films(run: Path) -> list[Block]:
    """Returns the films of a run, each with a still; small ones are inside the page, the others linked.

    Raises:
        UserError: one of them is no regular file.
    """
    folders = (run / "evaluation", run)
    found = [file for folder in folders for file in sorted(folder.glob("*.mp4")) if not file.name.startswith(".")]
    blocks: list[Block] = []
    room = INSIDE_TOTAL_BYTES
    for file in found[:MOST_FILMS]:
        size = check_regular(file, MOST_FILM_BYTES)
        data = read_bytes(file, MOST_FILM_BYTES) if size <= min(INSIDE_BYTES, room) else b""
        room -= len(data)
        blocks.append(Film(file.relative_to(run).as_posix(), _caption(file), _still(file), data))
    if more := len(found) - len(blocks):
        blocks.append(Paragraph(f"{more} more films are in the folder."))
    return [Heading("Films"), *blocks] if blocks else []


def _caption(file: Path) -> str:
    """Returns what a film shows: of an extreme episode its seed and return, if the results beside it have them."""
    if file.stem not in EXTREMES:
        return "An episode of the policy, with the forecasts drawn in."
    summary = file.parent / SUMMARY_FILE
    noted = read_object(summary).get("films") if summary.is_file() else None
    made = noted.get(file.stem) if isinstance(noted, dict) else None
    told = f"The {file.stem} episode of an evaluation"
    if not isinstance(made, dict) or not isinstance(made.get("return"), float):
        return f"{told} whose results are no longer beside it."
    return f"{told}: seed {short(str(made.get('seed')), 20)}, return {made['return']:.2f}."


def _still(file: Path) -> bytes:
    """Returns a still of a film; nothing without the encoder's package, or of a file that is no film."""
    try:
        from envs.video.files import still_of
    except ModuleNotFoundError:
        return b""
    data = still_of(file)
    return data if data.startswith(JPEG) else b""


def _summary(evaluation: Evaluation | None) -> str:
    if evaluation is None:
        return f"Not evaluated yet: there is no {SUMMARY_FILE}. Train it to its end, or run dgvae evaluate-policy."
    first, reference = evaluation.summaries[0], evaluation.reference
    told = f"{first.policy}: mean return {first.return_mean:.2f} over {first.episodes} episodes"
    if first.crash_rate is not None:
        told += f", {100 * first.crash_rate:.{percent_digits(first.crash_rate)}f} % of them with a crash"
    if reference is None or reference == first.policy:
        return f"{told}."
    other = next(summary for summary in evaluation.summaries if summary.policy == reference)
    return f"{told}; {reference}, the strongest driver that always does the same, has {other.return_mean:.2f}."


def _tables(evaluation: Evaluation) -> Iterator[Block]:
    for part in evaluation.parts:
        if part.headings:
            yield Table(part.headings, part.lines)
        if part.told:
            yield Paragraph(part.told)


def _worst(evaluation: Evaluation) -> list[Block]:
    """Returns the table of the policy's episodes with the lowest returns."""
    name, episodes = next(iter(evaluation.results.items()))
    lines = []
    for one in sorted(episodes, key=lambda episode: episode.episode_return)[:WORST]:
        crashed = NOT_REPORTED if one.crashed is None else "yes" if one.crashed else "no"
        speed = NOTHING if np.isnan(one.mean_speed_mps) else f"{one.mean_speed_mps:.1f}"
        lines.append([str(one.seed), f"{one.episode_return:.2f}", str(one.length), crashed, speed])
    headings = ["seed", "return", "length [steps]", "crashed", "speed [m/s]"]
    films = "films are of highway-env, where other episodes have these seeds"
    films = films if evaluation.env_id in ENV_IDS else "dgvae watch RUN --seed SEED films one of them"
    told = f"Episodes of {short(name, 60)} with the lowest returns; {films}."
    return [Heading("Worst episodes"), Table(headings, lines), Paragraph(told)]


def _loop_errors(points: Sequence[Mapping[str, Any]]) -> list[Block]:
    """Returns the table of the errors of the forecasts that the policy acted on while it learned."""
    known = [p for p in points if p.get(FORECAST_ERROR) is not None and p.get(CONSTANT_ERROR) is not None]
    if not known:
        return []
    lines = [[f"{p['steps']:,}", f"{p[FORECAST_ERROR]:.2f}", f"{p[CONSTANT_ERROR]:.2f}"] for p in known]
    told = (
        "Mean error of the forecasts behind the observations since the measurement before, up to the end of each "
        "episode; constant velocity on the same scenes."
    )
    headings = ["environment steps", "forecast [m]", "constant velocity [m]"]
    return [Heading("Forecast errors in the loop"), Table(headings, lines), Paragraph(told)]
