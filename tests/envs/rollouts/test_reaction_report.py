from dataclasses import asdict, replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from matplotlib import pyplot as plt
from rich.console import Console

from envs.rollouts.reaction_cells import BYSTANDER_CELL, LEADER_CELL
from envs.rollouts.reaction_report import markdown, plot_cell, remarks, shown, write_picture
from envs.rollouts.reaction_run import CellReactions, EnvReactions
from envs.rollouts.reactions import STRAIGHT, Perturbation
from predictor.evaluation.reactions import Reaction
from predictor.evaluation.standard_errors import Estimate
from predictor.support.files import finite

REACTION = Reaction(
    20,
    6,
    11.1,
    9.0,
    -8.88,
    Estimate(0.8, (0.7, 0.9)),
    Estimate(0.9, (0.6, 1.2)),
    Estimate(0.75, None),
    Estimate(0.85, (0.8, 0.9)),
    (5.0, 11.1),
    (4.0, 8.88),
    (4.5, 9.0),
)
NO_SLOPE = replace(REACTION, slope=None, median_ratio=None)
LEADERS = CellReactions(
    LEADER_CELL.name, 20, {"ours": REACTION, STRAIGHT: NO_SLOPE}, {"ours": replace(REACTION, pairs=12)}, {}, 3
)
BYSTANDERS = CellReactions(BYSTANDER_CELL.name, 20, {"ours": NO_SLOPE}, {}, {"ours": Estimate(0.08, (0.05, 0.12))})
NOTHING = CellReactions("taken out", 0, {}, {}, {})
ONE = Perturbation("taken out", 900_000, 4, 1, 2, np.ones((2, 2)), {"ours": np.zeros((2, 2))})
RESULT = EnvReactions(
    "merge-v1", "varied", 1.0, 2, 20, 40, [LEADERS, BYSTANDERS, NOTHING], {"far": "steps of 0.2 s"}, [ONE]
)


def test_lines_of_the_page():
    lines = markdown([RESULT]).splitlines()
    assert lines[0] == "### merge-v1, driven varied: shift of receivers after 2 steps of 1 s"
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[4:8]]
    assert cells[0] == [
        LEADER_CELL.name, "20 (6)", "ours", "11.10", "-8.88", "0.80 (0.70 to 0.90)",
        "0.90 (0.60 to 1.20)", "0.80 (0.70 to 0.90) (12)", "0.75", "0.85", "–",
    ]  # fmt: skip
    assert cells[1][2:6] == [STRAIGHT, "11.10", "-8.88", "–"]
    assert cells[2][2:] == [
        "ours",
        "11.10",
        "9.00",
        "–",
        "–",
        "–",
        "0.75",
        "0.85",
        "0.08 (0.05 to 0.12)",
    ]  # a length, no sign
    assert cells[3] == ["taken out", "0"] + ["–"] * 9
    assert "* 40 episodes; fewer than 20 perturbations: taken out 0" in lines
    assert f"* not counted, because the receiver crashes in one branch: {LEADER_CELL.name} 3" in lines
    assert "* left out: far: steps of 0.2 s" in lines
    assert remarks(replace(RESULT, cells=[BYSTANDERS], misfits={})) == []


def test_the_terminal_has_the_same_cells():
    text = StringIO()
    Console(file=text, width=240).print(shown(RESULT))
    assert all(word in text.getvalue() for word in ("0.80 (0.70 to 0.90)", "0.08 (0.05 to 0.12)", "predicted [m]"))


def test_a_narrow_terminal_cuts_nothing_off():
    text = StringIO()
    Console(file=text, width=80).print(shown(RESULT))
    assert "…" not in text.getvalue() and text.getvalue().count("0.08") == 1


def test_json_has_every_shift():
    found = finite(asdict(RESULT))
    assert found["perturbations"][0]["true_m"] == [[1.0, 1.0], [1.0, 1.0]]
    assert found["perturbations"][0]["predicted_m"] == {"ours": [[0.0, 0.0], [0.0, 0.0]]}
    assert found["cells"][0]["reactions"]["ours"]["slope"] == {"value": 0.8, "interval": [0.7, 0.9]}


@pytest.mark.parametrize(("cell", "predicted_m"), [(LEADERS, [0.0, 4.0, 8.88]), (BYSTANDERS, [0.0, 4.5, 9.0])])
def test_a_panel_has_the_true_shift_and_a_line_for_each(cell: CellReactions, predicted_m: list[float]):
    ax = plot_cell(plt.figure().subplots(), cell, 0.5)
    lines = {str(line.get_label()): line for line in ax.get_lines() if not str(line.get_label()).startswith("_")}
    assert list(lines) == ["true", *cell.reactions]
    np.testing.assert_array_equal(lines["true"].get_ydata(), [0.0, 5.0, 11.1])
    np.testing.assert_array_equal(lines["ours"].get_ydata(), predicted_m)
    np.testing.assert_array_equal(lines["ours"].get_xdata(), [0.0, 0.5, 1.0])
    plt.close("all")


def test_a_figure_is_written_where_something_was_found(tmp_path: Path):
    write_picture(tmp_path, RESULT)
    assert [path.name for path in tmp_path.iterdir()] == ["merge-v1.reactions.png"]
    assert plt.imread(tmp_path / "merge-v1.reactions.png")[..., :3].std() > 0.05
    write_picture(tmp_path, replace(RESULT, env_id="other", cells=[NOTHING]))
    assert len(list(tmp_path.iterdir())) == 1
