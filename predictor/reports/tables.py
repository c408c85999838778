"""Writes tables of edge scores and of accuracies, as Markdown or for the terminal."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from predictor.evaluation.accuracy import Accuracy
from predictor.evaluation.displacement import COVERAGE_SHARE
from predictor.evaluation.standard_errors import Estimate
from predictor.reports.fitted_table import FittedTable
from predictor.support import markdown

SCALARS = (
    "ADE₁ [m]",
    "FDE₁ [m]",
    "minADE [m]",
    "minFDE [m]",
    "joint ADE [m]",
    "joint FDE [m]",
    "energy [m]",
    "RMSE [m]",
    "missed",
    "cover",
    "overlap",
)
"""Headings of both accuracy tables between K and the steps."""

MODEL_NAMES = {"dgvae": "dG-VAE", "dnri": "dNRI", "imma": "IMMA", "lstm": "LSTM", "mlp": "MLP"}
"""Names of models in tables; the others keep their own name."""

MAX_STEPS_SHOWN = 6
"""Largest number of steps in a table, the first and the last among them; accuracy.json has all."""


def scores_markdown(content: dict[str, Any]) -> str:
    """Returns the content of scores.json as tables and sentences in Markdown."""
    parts = [
        f"# Edges of `{content['config']['checkpoint']}` on {content['source']}",
        f"{content['windows']} windows of {content['episodes']} episodes; features are read at the last of "
        f"{content['config']['burn_in_steps']} observed steps.",
    ]
    relation = content["edges"]
    if content["has_ego"] and relation is not None:
        parts.append("An edge exists where the sender is the receiver's leader.")
    scores = [score for score in [relation, *content["attributes"]] if score is not None]
    if scores:
        parts += ["## In words", "\n".join(f"* {_sentence(score)}" for score in scores)]
        parts += ["## Scores of the features", _factor_table(scores), FACTOR_NOTE]
    if content["graph"] is not None:
        parts += ["## Graph", _graph_lines(content)]
    if content["disentanglement"] is not None:
        parts += ["## Disentanglement", _disentanglement_lines(content)]
    parts += ["## Dimension by dimension", _dimension_table(content, scores), _stillness_note(content)]
    made = content["provenance"]
    parts.append(f"Made by `{made['command']}`, commit {made['commit']}, {made['time']}.")
    return "\n\n".join(parts) + "\n"


FACTOR_NOTE = (
    "best: dimension with the largest |r|. chance: the largest |r| among all dimensions that 95 of 100 shuffled "
    "properties stay below. distance: r of the property with the distance between the two agents, for comparison. "
    "linear R²: all dimensions, fitted on half of the episodes, scored on the other half. direct R²: dimension i, "
    "unchanged, against attribute i; only restricted labelling trains for it (negative: worse than the mean)."
)


def _sentence(score: dict[str, Any]) -> str:
    name, r, chance = f"**{score['name']}**", score["correlation"], score["chance"]
    if r is None:
        return f"{name}: not scored; {score['pairs']} pairs are too few, or the property does not vary."
    if abs(r) <= chance:
        return f"{name}: no feature correlates with it beyond chance (best |r| {abs(r):.2f}, chance {chance:.2f})."
    by_distance = abs(score["distance_correlation"]) >= abs(r)
    distance = (
        f"; the distance alone is as informative (r = {score['distance_correlation']:+.2f})" if by_distance else ""
    )
    return f"{name}: feature {score['dimension']} correlates with it, r = {r:+.2f} (chance {chance:.2f}){distance}."


def _factor_table(scores: Sequence[dict[str, Any]]) -> str:
    lines = [
        [
            s["name"],
            str(s["pairs"]),
            "–" if s["dimension"] is None else str(s["dimension"]),
            _signed(s["correlation"]),
            plain(s["r2"]),
            plain(s["chance"]),
            _signed(s["distance_correlation"]),
            plain(s["linear_r2"]),
            plain(s["direct_r2"]),
        ]
        for s in scores
    ]
    header = ["property", "pairs", "best", "r", "r²", "chance", "distance", "linear R²", "direct R²"]
    return markdown.table(header, lines)


def _graph_lines(content: dict[str, Any]) -> str:
    graph, apart = content["graph"], content["separation"]
    lines = [
        f"* accuracy {plain(graph['accuracy'])}, F1 {plain(graph['f1'])} over {graph['pairs']} ordered pairs; "
        f"predicting the commonest type for all pairs has accuracy {plain(graph['commonest'])}; "
        f"{plain(graph['true_connectivity'])} of them have an edge"
    ]
    if apart is not None:
        lines.append(
            f"* chance that an edge has the larger value than a non-edge (AUC; 0.5 is chance, near 0 is as good as "
            f"near 1): feature {apart['dimension']} {plain(apart['auc'])}, the model's own probability "
            f"{plain(apart['edge_prob_auc'])}"
        )
    return "\n".join(lines)


def _disentanglement_lines(content: dict[str, Any]) -> str:
    found = content["disentanglement"]
    lines = [
        f"* MIG {plain(found['mig'])} over {found['edges']} true edges (1: each attribute is held by one dimension "
        "alone, 0: by none, or by two equally)"
    ]
    if found["dci"] is not None:
        dci = found["dci"]
        one = "" if dci["disentanglement"] is not None else " (not defined for one attribute)"
        lines.append(
            f"* DCI: disentanglement {plain(dci['disentanglement'])}{one}, completeness "
            f"{plain(dci['completeness'])}, informativeness {plain(dci['informativeness'])}"
        )
    if found["note"]:
        lines.append(f"* MIG and DCI not available: {found['note']}")
    return "\n".join(lines)


def _dimension_table(content: dict[str, Any], scores: Sequence[dict[str, Any]]) -> str:
    scored = [s for s in scores if s["correlations"]]
    whole, late = content["stillness"], content["stillness_late"]
    lines = []
    for d, spread in enumerate(late["spread"]):
        kind = "static" if d < content["static_dim"] else "dynamic"
        cells = [str(d), kind, f"{spread:.3g}", plain(whole["within"][d], 2), plain(late["within"][d], 2)]
        lines.append(cells + [_signed(s["correlations"][d]) for s in scored])
    header = ["feature", "kind", "spread", "changing", "changing, 2nd half", *(f"r: {s['name']}" for s in scored)]
    return markdown.table(header, lines)


def _stillness_note(content: dict[str, Any]) -> str:
    whole, late = content["stillness"], content["stillness_late"]
    which = "true edges" if content["edges"] is not None else "pairs"
    if whole["steps"] < 2:
        return "changing, static and spread: with one observed step there is no change to measure."
    return (
        f"changing: variance within a pair over time / variance over pairs and time; 0 is static, 1 is all change. "
        f"Over all {whole['steps']} observed steps ({whole['edges']} {which} present at all of them), and over the "
        f"second half ({late['edges']}). static: averaged over the past (pair matching): less change by construction. "
        f"spread: standard deviation in the second half; a dash beside it is a dimension that never changes at all."
    )


def plain(value: float | None, places: int = 3) -> str:
    """Returns a number with `places` decimals, or a dash for None."""
    return "–" if value is None else f"{value:.{places}f}"


def metres(value: float | None, interval: tuple[float, float] | None = None) -> str:
    """Returns a length [m] with two decimals, three below 1 m, and its interval if there is one; a dash for None."""
    if value is None:
        return "–"
    shown = [f"{one:.2f}" if abs(one) >= 1 else f"{one:.3f}" for one in (value, *(interval or ()))]
    return shown[0] if interval is None else "{} ({} to {})".format(*shown)


def with_interval(estimate: Estimate | None) -> str:
    """Returns a number with its interval, ``0.96 (0.84 to 1.05)``, or a dash for None."""
    if estimate is None or estimate.interval is None:
        return plain(None if estimate is None else estimate.value, 2)
    return "{:.2f} ({:.2f} to {:.2f})".format(estimate.value, *estimate.interval)


def percent_range(shares: Sequence[float]) -> str:
    """Returns the smallest and the largest of some shares as text, ``88 to 94 %``, or ``94 %`` where they are equal."""
    low, high = f"{100 * min(shares):.0f}", f"{100 * max(shares):.0f}"
    return f"{low} %" if low == high else f"{low} to {high} %"


def _signed(value: float | None) -> str:
    return "–" if value is None else f"{value:+.2f}"


def accuracy_table(accuracies: Sequence[Accuracy], dt_s: float, title: str) -> FittedTable:
    """Returns a terminal table, one line per accuracy; displacement, RMSE and NLL at `MAX_STEPS_SHOWN` steps."""
    shown = _steps_shown(accuracies)
    headings = ["K", *("\n".join(heading.split()) for heading in (*SCALARS, "forecasts"))]
    headings += [f"{dt_s * (step + 1):g} s" for step in shown]
    lines = []
    for one in accuracies:
        nll = one.mixture_nll or one.nll  # the density that the model predicts, where it predicts one
        stacks = [(one.by_step_m[i], one.rmse_m[i], *([nll[i]] if nll else [])) for i in shown]
        cells = ["\n".join(_rounded_number(value, 2) for value in stack) for stack in stacks]
        scalars = [cell.replace(" ± ", "\n±") for cell in _scalar_cells(one)]
        lines.append([one.name, str(one.num_samples), *scalars, f"{one.agents}", *cells])
    caption = (
        "by time ahead: displacement of the best sample [m] / RMSE of the mean [m] / NLL [nats], top to bottom; "
        f"± standard error over subsets of the episodes; missed: final displacement above "
        f"{accuracies[0].miss_threshold_m:g} m; "
        f"ADE₁, FDE₁: single forecast; energy: energy score, lower is better; "
        f"cover: truths within the central {100 * COVERAGE_SHARE:g} % of the samples; "
        f"overlap: agents nearer than that to another one of the same sample (in truth)"
    )
    return FittedTable(title, ["forecaster", *headings], lines, caption, ruled=True)


def markdown_table(accuracies: Sequence[Accuracy], dt_s: float) -> str:
    """Returns the table of `accuracy_table` as Markdown, with displacement only at the steps."""
    shown = _steps_shown(accuracies)
    steps = [f"{dt_s * (i + 1):g} s" for i in shown]
    lines = [
        [one.name, str(one.num_samples), *_scalar_cells(one), *(_rounded_number(one.by_step_m[i], 2) for i in shown)]
        for one in accuracies
    ]
    return markdown.table(["forecaster", "K", *SCALARS, *steps], lines) + "\n"


def _steps_shown(accuracies: Sequence[Accuracy]) -> list[int]:
    horizon = len(accuracies[0].by_step_m)
    return np.linspace(0, horizon - 1, min(horizon, MAX_STEPS_SHOWN)).round().astype(int).tolist()


def _rounded_number(value: float, places: int) -> str:
    """Returns a number with `places` decimals, or with two digits if it is small (errors of springs: millimetres)."""
    if math.isnan(value):
        return "–"
    return f"{value:.{places}f}" if value == 0 or abs(value) >= 10 ** (1 - places) else f"{value:.2g}"


def _scalar_cells(accuracy: Accuracy) -> list[str]:
    """Returns the cells under `SCALARS`; a dash for what was not measured."""

    def length(name: str) -> str:
        value: float = getattr(accuracy, name)
        error = accuracy.statistics[name].standard_error if name in accuracy.statistics else None
        return _rounded_number(value, 3) + ("" if error is None else f" ± {_rounded_number(error, 3)}")

    lengths = [
        length(name)
        for name in (
            "ade_m", "fde_m", "min_ade_m", "min_fde_m", "min_joint_ade_m", "min_joint_fde_m", "energy_m",
            "overall_rmse_m",
        )
    ]  # fmt: skip
    miss = "–" if math.isnan(accuracy.miss_rate) else f"{100 * accuracy.miss_rate:.1f} %"
    share = accuracy.statistics.get("coverage")
    covered = "–" if share is None else f"{100 * share.mean:.0f} %"
    hit = "–" if math.isnan(accuracy.overlap) else f"{100 * accuracy.overlap:.1f} ({100 * accuracy.true_overlap:.1f}) %"
    return [*lengths, miss, covered, hit]
