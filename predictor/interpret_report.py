"""The table of what edges mean (`predictor.interpret`), from what scores.json holds."""

from collections.abc import Sequence
from typing import Any


def scores_markdown(content: dict[str, Any]) -> str:
    """What scores.json holds, as tables and sentences."""
    parts = [
        f"# What the edges of `{content['config']['checkpoint']}` say about {content['source']}",
        f"{content['windows']} windows of {content['episodes']} episodes; features are read at the last of "
        f"{content['config']['history_steps']} observed steps.",
    ]
    relation = content["edges"]
    if content["has_ego"] and relation is not None:
        parts.append("An edge exists where the sender is the receiver's leader.")
    scores = [score for score in [relation, *content["attributes"]] if score is not None]
    if scores:
        parts += ["## In words", "\n".join(f"* {_sentence(score)}" for score in scores)]
        parts += ["## What features know", _factor_table(scores), FACTOR_NOTE]
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
    "linear R²: all dimensions, fitted on half of the episodes, scored on the other half. direct R²: dimension i as it "
    "is against attribute i; only restricted labelling aims at it (negative: worse than the mean)."
)


def _sentence(score: dict[str, Any]) -> str:
    name, r, chance = f"**{score['name']}**", score["correlation"], score["chance"]
    if r is None:
        return f"{name}: nothing to say; {score['rows']} pairs, or all of them are alike."
    if abs(r) <= chance:
        return f"{name}: no feature goes with it beyond chance (best |r| {abs(r):.2f}, chance {chance:.2f})."
    by_hand = abs(score["distance_correlation"]) >= abs(r)
    ruler = f"; the distance alone does no worse (r = {score['distance_correlation']:+.2f})" if by_hand else ""
    return f"{name}: feature {score['dimension']} goes with it, r = {r:+.2f} (chance {chance:.2f}){ruler}."


def _factor_table(scores: Sequence[dict[str, Any]]) -> str:
    rows = [
        [
            s["name"],
            str(s["rows"]),
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
    return _table(header, rows)


def _graph_lines(content: dict[str, Any]) -> str:
    graph, apart = content["graph"], content["separation"]
    lines = [
        f"* accuracy {plain(graph['accuracy'])}, F1 {plain(graph['f1'])} over {graph['pairs']} ordered pairs; "
        f"always saying 'edge' has accuracy {plain(graph['true_connectivity'])}, always 'no edge' "
        f"{plain(None if graph['true_connectivity'] is None else 1 - graph['true_connectivity'])}"
    ]
    if apart is not None:
        lines.append(
            f"* chance that an edge has the larger value than a non-edge (AUC; 0.5 knows nothing, near 0 is as good as "
            f"near 1): feature {apart['dimension']} {plain(apart['auc'])}, the model's own probability "
            f"{plain(apart['edge_prob_auc'])}"
        )
    return "\n".join(lines)


def _disentanglement_lines(content: dict[str, Any]) -> str:
    found = content["disentanglement"]
    lines = [
        f"* MIG {plain(found['mig'])} over {found['rows']} true edges (1: each attribute is held by one dimension "
        "alone, 0: by none, or by two alike)"
    ]
    if found["dci"] is not None:
        dci = found["dci"]
        one = "" if dci["disentanglement"] is not None else " (not defined for one attribute)"
        lines.append(
            f"* DCI: disentanglement {plain(dci['disentanglement'])}{one}, completeness "
            f"{plain(dci['completeness'])}, informativeness {plain(dci['informativeness'])}"
        )
    if found["note"]:
        lines.append(f"* DCI not available: {found['note']}")
    return "\n".join(lines)


def _dimension_table(content: dict[str, Any], scores: Sequence[dict[str, Any]]) -> str:
    scored = [s for s in scores if s["correlations"]]
    whole, late = content["stillness"], content["stillness_late"]
    rows = []
    for d, spread in enumerate(late["spread"]):
        kind = "static" if d < content["static_dim"] else "dynamic"
        row = [str(d), kind, f"{spread:.3g}", plain(whole["within"][d], 2), plain(late["within"][d], 2)]
        rows.append(row + [_signed(s["correlations"][d]) for s in scored])
    header = ["feature", "kind", "spread", "changing", "changing, 2nd half", *(f"r: {s['name']}" for s in scored)]
    return _table(header, rows)


def _stillness_note(content: dict[str, Any]) -> str:
    whole, late = content["stillness"], content["stillness_late"]
    which = "true edges" if content["edges"] is not None else "pairs"
    return (
        f"changing: variance within a pair over time / variance over pairs and time; 0 stands still, 1 is all change. "
        f"Over all {whole['steps']} observed steps ({whole['edges']} {which} that are there throughout), and over the "
        f"second half ({late['edges']}). static: averaged over the past (pair matching), so stiller by construction. "
        f"spread: standard deviation in the second half; a dash beside it is a dimension that never changes at all."
    )


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(cells)} |" for cells in [header, ["---"] * len(header), *rows])


def plain(value: float | None, places: int = 3) -> str:
    """A number to so many places, or a dash."""
    return "–" if value is None else f"{value:.{places}f}"


def _signed(value: float | None) -> str:
    return "–" if value is None else f"{value:+.2f}"
