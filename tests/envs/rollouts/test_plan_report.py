from dataclasses import asdict, replace
from io import StringIO
from pathlib import Path

import pytest
from matplotlib import pyplot as plt
from rich.console import Console

from envs.rollouts.plan_report import markdown, plot_choices, plot_errors, shown, write_picture
from envs.rollouts.plan_run import Benefit, EnvPlans, PlanScores
from predictor.evaluation.standard_errors import Estimate

HELPS = Benefit(40, 1.25, 1.0, Estimate(0.2, (0.1, 0.3)))
HARMS = Benefit(80, 0.5, 0.55, Estimate(-0.1, (-0.15, 0.05)))
NOTHING = Benefit(0, None, None, None)
SCORES = {
    "constant velocity": PlanScores(
        HARMS, NOTHING, 12, Estimate(0.75, (0.5, 1.0)), Estimate(0.5, None), Estimate(0.1, None)
    ),
    "ours": PlanScores(
        HELPS, HARMS, 12, Estimate(1.0, (1.0, 1.0)), Estimate(0.9, (0.8, 1.0)), Estimate(0.02, (0.01, 0.03))
    ),
}
RESULT = EnvPlans(
    "merge-v1", "varied", 1.0, 5, 50, ("IDLE", "FASTER"), 120, [0.1, 0.35], SCORES, {"far": "steps of 0.2 s"}
)


def test_lines_of_the_page():
    lines = markdown([RESULT]).splitlines()
    assert lines[0] == "### merge-v1, driven varied: 120 moments of 50 episodes, 5 × 1 s"
    straight, ours = ([cell.strip() for cell in line.strip("|").split("|")] for line in lines[4:6])
    assert straight[4:7] == ["–", "–", "–"] and straight[9:] == ["50.0 %", "0.100"]
    assert ours[:4] == ["ours", "1.25", "1.00", "20.0 % (10.0 to 30.0)"]
    assert ours[4:7] == ["0.500", "0.550", "−10.0 % (−15.0 to 5.0)"]
    assert ours[7:] == ["12", "100.0 % (100.0 to 100.0)", "90.0 % (80.0 to 100.0)", "0.020 (0.010 to 0.030)"]
    assert lines[-2:] == ["* collisions by plan: IDLE 10 %, FASTER 35 %", "* left out: far: steps of 0.2 s"]


def test_the_terminal_has_the_same_cells():
    text = StringIO()
    Console(file=text, width=250).print(shown(RESULT))
    assert "20.0 % (10.0 to 30.0)" in text.getvalue() and "others' ADE [m]" in text.getvalue()


def test_the_json_has_the_numbers():
    assert asdict(RESULT)["scores"]["ours"]["own"]["reduction"]["value"] == 0.2


def test_curves_have_the_numbers():
    figure, (left, right) = plt.subplots(1, 2)
    plot_errors(left, RESULT)
    plot_choices(right, RESULT)
    marks = [line.get_ydata() for line in left.get_lines() if line.get_marker() == "o"]
    assert [list(y) for y in marks][0] == [-10.0, 20.0]
    (choice,) = (line.get_ydata() for line in right.get_lines() if line.get_marker() == "o")
    assert list(choice) == [75.0, 100.0]
    plt.close(figure)


def test_whoever_has_choices_alone_stands_under_these_and_long_names_are_broken():
    known = PlanScores(NOTHING, NOTHING, 12, Estimate(0.9, (0.8, 1.0)), None, None)
    figure, (left, right) = plt.subplots(1, 2)
    result = replace(RESULT, scores=SCORES | {"drivers known, perceived vehicles alone": known})
    plot_errors(left, result)
    plot_choices(right, result)
    under = [[label.get_text() for label in ax.get_xticklabels()] for ax in (left, right)]
    assert under[0] == ["constant velocity", "ours"]
    assert under[1] == [*under[0], "drivers known,\nperceived vehicles\nalone"]
    plt.close(figure)


@pytest.mark.parametrize("scores", [SCORES, {"ours": PlanScores(NOTHING, NOTHING, 0, None, None, None)}])
def test_a_figure_is_written(scores: dict[str, PlanScores], tmp_path: Path):
    write_picture(tmp_path, replace(RESULT, scores=scores))
    assert [path.name for path in tmp_path.iterdir()] == ["merge-v1.plans.png"]
    assert plt.imread(tmp_path / "merge-v1.plans.png")[..., :3].std() > 0.03
