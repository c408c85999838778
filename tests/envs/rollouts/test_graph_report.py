from dataclasses import asdict, replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib import pyplot as plt
from rich.console import Console

from envs.rollouts import graph_report
from envs.rollouts.causal_labels import ON_ROADS
from envs.rollouts.graph_report import markdown, plot_calibration, plot_curve, shown, write_picture
from envs.rollouts.graph_run import DISTANCE, LEADERS, MAJORITY, EnvGraph
from predictor.evaluation.causal_graph import CausalPairs, CausalScores, score_rule

EXISTS = np.tile([True, False, False, False], 20)
PAIRS = CausalPairs(EXISTS * 2.0, EXISTS, np.repeat(np.arange(20), 4), np.tile([1, 1, 2, 2], 20))
PROB = np.tile([0.8, 0.4, 0.2, 0.1], 20) - np.repeat([0.0, 0.05], 40)
MODEL = score_rule(PROB, PAIRS, 0.5, probability=True)
SCORES = {
    "ours": MODEL,
    MAJORITY: score_rule(np.full(80, 0.25), PAIRS, 0.5),
    DISTANCE: score_rule(-np.tile([10.0, 9.0, 30.0, 40.0], 20), PAIRS, None),
}
RESULT = EnvGraph("merge-v1", "varied", 20, ON_ROADS, SCORES, {"far": "steps of 0.2 s"})


def test_lines_of_the_page():
    lines = markdown([RESULT]).splitlines()
    assert lines[0] == "### merge-v1, driven varied: 40 pairs of 10 episodes, 25 % are edges"
    ours, common, near = ([cell.strip() for cell in line.strip("|").split("|")] for line in lines[4:7])
    assert ours[:7] == ["ours", "1.00", "1.00", "1.00", "– / –", "1.00 (1.00 to 1.00)", "1.00"]
    assert ours[9] != "–" and ours[11] != "–"
    assert common[:6] == [MAJORITY, "0.75", "–", "0.00", "– / –", "0.00 (0.00 to 0.00)"]
    assert near[0] == DISTANCE and (near[9], near[11]) == ("–", "–")
    assert near[7] == "0.67 (0.67 to 0.67)"
    assert lines[-1] == "* left out: far: steps of 0.2 s"


def test_recall_of_leaders_and_others_stand_in_one_cell():
    late = np.arange(80) >= 60
    found = score_rule(np.where(late, 0.3, PROB), replace(PAIRS, leads=EXISTS & ~late), 0.5)
    line = markdown([replace(RESULT, scores={"ours": found})]).splitlines()[4]
    assert "| 1.00 / 0.00 |" in line


def test_the_terminal_has_the_same_cells():
    text = StringIO()
    Console(file=text, width=200).print(shown(RESULT))
    assert "0.67 (0.67 to 0.67)" in text.getvalue() and "calibration" in text.getvalue()


def test_edges_to_the_ego_have_a_table_of_their_own():
    result = replace(RESULT, to_ego=SCORES)
    lines = markdown([result]).splitlines()
    begin = lines.index(
        "#### merge-v1, edges to the ego, as a driver in its place would have them: 40 pairs, 25 % are edges"
    )
    assert lines[begin + 4].startswith("| ours | 1.00 |") and "edges to the ego" not in markdown([RESULT])
    text = StringIO()
    Console(file=text, width=200).print(shown(result))
    assert text.getvalue().count("0.67 (0.67 to 0.67)") == 4 and "as a driver in its place" in text.getvalue()


def test_json_has_the_bins():
    found = asdict(RESULT)["scores"]["ours"]
    assert len(found["bins"]) == 10 and sum(one["pairs"] for one in found["bins"]) == 40
    assert found["f1"] == {"value": 1.0, "interval": (1.0, 1.0)}


def test_the_curve_is_marked_at_the_rules_own_bound():
    ax = plot_curve(plt.figure().subplots(), DISTANCE, SCORES[DISTANCE], "black")
    mark, curve = ax.get_lines()
    recall, precision = SCORES[DISTANCE].recall, SCORES[DISTANCE].precision
    assert recall is not None and precision is not None
    np.testing.assert_array_equal(mark.get_xydata(), [(recall.value, precision.value)])
    np.testing.assert_array_equal(curve.get_xydata(), SCORES[DISTANCE].curve)
    yes_or_no = score_rule(EXISTS.astype(np.float64), PAIRS, 0.5)
    assert len(plot_curve(plt.figure().subplots(), "the leader", yes_or_no, "black").get_lines()) == 1
    plt.close("all")


def test_calibration_leaves_out_empty_bins():
    ax = plot_calibration(plt.figure().subplots(), "ours", MODEL, "black")
    (line,) = ax.get_lines()
    filled = [(one.mean_prob, one.share) for one in MODEL.bins if one.pairs]
    np.testing.assert_array_equal(line.get_xydata(), filled)
    assert len(plot_calibration(plt.figure().subplots(), DISTANCE, SCORES[DISTANCE], "black").get_lines()) == 0


def test_no_two_lines_of_a_picture_look_alike(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """With as many checkpoints as have colours of their own, one has the colour of a rule."""
    drawn: list[Any] = []
    monkeypatch.setattr(graph_report, "save_figure", lambda figure, *_: drawn.append(figure))
    scores = {f"run {i}": MODEL for i in range(5)} | {DISTANCE: MODEL, LEADERS: MODEL}
    write_picture(tmp_path, replace(RESULT, scores=scores))
    for ax in drawn[0].axes:
        looks = [(line.get_color(), line.get_linestyle()) for line in ax.get_lines() if line.get_label()[0] != "_"]
        assert len(looks) == len(set(looks)) == len(scores)
    plt.close("all")


NO_EDGES = replace(PAIRS, exists=np.zeros_like(EXISTS))


@pytest.mark.parametrize("scores", [SCORES, {name: score_rule(PROB, NO_EDGES, 0.5) for name in ("ours", MAJORITY)}])
def test_a_figure_is_written(scores: dict[str, CausalScores], tmp_path: Path):
    write_picture(tmp_path, replace(RESULT, scores=scores))
    assert [path.name for path in tmp_path.iterdir()] == ["merge-v1.graph.png"]
    assert plt.imread(tmp_path / "merge-v1.graph.png")[..., :3].std() > 0.03
