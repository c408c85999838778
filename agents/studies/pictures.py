"""Pictures of a study: learning curves and performance profiles. Functions take arrays and an axis and return the axis.

Files are SVG, and equal from run to run.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.axes import Axes
from scipy import stats

from agents.studies.estimators import CONFIDENCE, performance_profile, profile_band
from agents.studies.findings import Findings, Line, generator_of
from predictor.evaluation.standard_errors import Estimate
from predictor.reports.figures import panels, svg_of
from predictor.reports.looks import AS_TEXT, BLACK, BLUE, BROWN, COLORS, DASHES, GREY, ORANGE

_ARM_COLORS = {"forecast": BLUE, "constant-velocity": GREY, "oracle": BLACK, "zeros": ORANGE, "none": BROWN}
_GREYS = (("#777777", "--"), ("#777777", ":"), ("#aaaaaa", "-."))
_THRESHOLDS = 201


def styles_of(lines: Sequence[Line]) -> dict[Line, dict[str, Any]]:
    """Returns colour and dashes of each line: a colour per arm, dashes per algorithm.

    Known arms have one colour in every study: that of the dG-VAE, constant velocity, the truth in all plots.
    """
    arms, algorithms = (list(dict.fromkeys(names)) for names in zip(*lines, strict=True)) if lines else ([], [])
    spare = [color for color in COLORS if color not in {_ARM_COLORS.get(arm) for arm in arms}]
    unknown = [arm for arm in arms if arm not in _ARM_COLORS]
    styles = {}
    for line in lines:
        turn, place = divmod(unknown.index(line.arm), len(spare)) if line.arm in unknown else (0, 0)
        dashes = DASHES[(algorithms.index(line.algorithm) + turn) % len(DASHES)]
        styles[line] = {"color": _ARM_COLORS.get(line.arm, spare[place]), "ls": dashes}
    return styles


def plot_curve(
    ax: Axes, steps: Float[np.ndarray, " points"], returns: Float[np.ndarray, "runs points"], label: str, **style: Any
) -> Axes:
    """Draws the mean return over runs against the steps of training, with its 95 % Student interval.

    Args:
        ax: axis to draw on.
        steps: number of environment steps at each measurement.
        returns: mean return of each run at each measurement.
        label: name in the legend.
        **style: colour and dashes.
    """
    runs = len(returns)
    centre = returns.mean(axis=0)
    ax.plot(steps, centre, marker="o", ms=3.5, label=label, **style)
    if runs > 1:
        half = stats.t.ppf(0.5 + CONFIDENCE / 2, runs - 1) * returns.std(axis=0, ddof=1) / np.sqrt(runs)
        ax.fill_between(steps, centre - half, centre + half, color=style.get("color"), alpha=0.15, lw=0)
    return ax


def plot_score(ax: Axes, place: float, score: Estimate, **style: Any) -> Axes:
    """Draws a mean return on the test seeds, with its interval if it has one, at a place to the right of the curves."""
    spread = None
    if score.interval is not None:
        low, high = score.interval
        spread = [[score.value - low], [high - score.value]]
    ax.errorbar([place], [score.value], spread, marker="D", ms=4.5, lw=1.2, color=style.get("color"))
    return ax


def plot_references(ax: Axes, references: Mapping[str, float], upright: bool = False) -> Axes:
    """Draws the mean return of drivers as grey lines over the whole axis."""
    draw = ax.axvline if upright else ax.axhline
    for i, (name, value) in enumerate(references.items()):
        color, dashes = _GREYS[i % len(_GREYS)]
        draw(value, color=color, ls=dashes, lw=1.2, label=name, zorder=0)
    return ax


def plot_profile(
    ax: Axes,
    thresholds: Float[np.ndarray, " thresholds"],
    profile: Float[np.ndarray, " thresholds"],
    low: Float[np.ndarray, " thresholds"],
    high: Float[np.ndarray, " thresholds"],
    label: str,
    **style: Any,
) -> Axes:
    """Draws the share of runs above each threshold, with its band."""
    ax.plot(thresholds, profile, label=label, **style)
    ax.fill_between(thresholds, low, high, color=style.get("color"), alpha=0.12, lw=0)
    return ax


@rc_context(AS_TEXT)
def learning_curves(findings: Findings) -> str:
    """Returns the picture of all learning curves, a panel per scenario, as SVG."""
    figure, axes = panels(len(findings.scenarios))
    styles = styles_of(findings.lines(trained=True))
    for ax, scenario in zip(axes, findings.scenarios, strict=True):
        lines = findings.lines(scenario, trained=True)
        for i, line in enumerate(lines):
            steps, returns = curve_of(findings, scenario, line)
            plot_curve(ax, steps, returns, findings.label(line), **styles[line])
            if len(steps):
                plot_score(ax, steps[-1] * (1.04 + 0.02 * i), findings.mean_return(scenario, line), **styles[line])
                ax.plot([], [], "D", ms=4.5, color=BLACK, label="policies that are kept, test seeds")
        plot_references(ax, _references(findings, scenario))
        ax.set_title(_title(scenario, [len(findings.results[scenario, line]) for line in lines]))
        ax.set_xlabel("environment steps")
        ax.xaxis.set_major_formatter("{x:,.0f}")
        ax.set_xlim(left=0)
    axes[0].set_ylabel("return on the selection seeds")
    return svg_of(figure, axes)


@rc_context(AS_TEXT)
def profiles(findings: Findings) -> str:
    """Returns the picture of the performance profiles as SVG: a panel per scenario, one over all if there are several.

    The panel over all has the arms with runs in every scenario, by rescaled scores.
    """
    several = len(findings.scenarios) > 1
    figure, axes = panels(len(findings.scenarios) + several)
    for ax, scenario in zip(axes, findings.scenarios, strict=False):
        lines = findings.lines(scenario, trained=True)
        _profile_panel(ax, findings, {line: findings.raw_runs(line, [scenario]) for line in lines}, scenario)
        plot_references(ax, _references(findings, scenario), upright=True)
        ax.set_xlabel("return τ")
    if several:
        lines = findings.common_lines()
        scaled = {line: findings.even_runs(line) for line in lines}
        _profile_panel(axes[-1], findings, scaled, "all scenarios")
        axes[-1].set_xlabel("rescaled score τ")
    axes[0].set_ylabel("share of runs above τ")
    return svg_of(figure, axes)


def curve_of(
    findings: Findings, scenario: str, line: Line
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, "runs points"]]:
    """Returns the steps at which every run of a line was measured, and the return of each run there."""
    curves = [{point["steps"]: point["return"] for point in r.curve} for r in findings.results[scenario, line]]
    steps = sorted(set.intersection(*(set(curve) for curve in curves)))
    return np.array(steps, dtype=np.float64), np.array([[curve[step] for step in steps] for curve in curves])


def _profile_panel(ax: Axes, findings: Findings, runs: Mapping[Line, Any], title: str) -> None:
    ax.set_title(title)
    ax.set_ylim(-0.02, 1.02)
    if not runs:
        return
    ax.set_title(_title(title, [sum(len(one) for one in found) for found in runs.values()]))
    scores = np.concatenate([np.concatenate(list(found)) for found in runs.values()])
    margin = 0.05 * (np.ptp(scores) or 1.0)
    thresholds = np.linspace(scores.min() - margin, scores.max() + margin, _THRESHOLDS)
    styles = styles_of(findings.lines(trained=True))
    for line, found in runs.items():
        band = profile_band(found, thresholds, generator_of("profile", title, *line), findings.resamples)
        shares = performance_profile(found, thresholds)
        plot_profile(ax, thresholds, shares, *band, findings.label(line), **styles[line])


def _title(name: str, runs: Sequence[int]) -> str:
    """Returns the title of a panel: its name and how many runs a line has, from the fewest to the most."""
    if not runs:
        return name
    return f"{name}, n = {' to '.join(map(str, dict.fromkeys((min(runs), max(runs)))))}"


def _references(findings: Findings, scenario: str) -> dict[str, float]:
    """Returns the mean returns of planner, heuristic and best constant action, by their names in the legend."""
    planner = findings.planner(scenario)
    shown = {
        "planner" if planner is None else planner.arm: planner,
        "best constant action": findings.best_constant(scenario),
        "heuristic": findings.heuristic(scenario),
    }
    return {name: findings.mean_return(scenario, line).value for name, line in shown.items() if line is not None}
