"""Lines of a study's pictures: one colour per arm in every study, none twice, dashes per algorithm."""

import itertools

from matplotlib import pyplot as plt

from agents.studies.findings import Line
from agents.studies.pictures import plot_score, styles_of
from predictor.evaluation.standard_errors import Estimate
from predictor.reports.looks import BLACK, BLUE, COLORS, GREY


def lines(*arms: str, algorithms: tuple[str, ...] = ("ppo",)) -> list[Line]:
    return [Line(arm, algorithm) for arm, algorithm in itertools.product(arms, algorithms)]


def test_known_arms_have_one_colour_in_every_study():
    few = styles_of(lines("constant-velocity", "forecast"))
    many = styles_of(lines("zeros", "modes", "oracle", "forecast", "constant-velocity", "none"))
    for arm, color in (("forecast", BLUE), ("constant-velocity", GREY), ("oracle", BLACK)):
        assert many[Line(arm, "ppo")]["color"] == color == few.get(Line(arm, "ppo"), {"color": color})["color"]


def test_no_two_arms_look_alike():
    arms = ["zeros", "forecast", *(f"arm-{i}" for i in range(2 * len(COLORS)))]
    looks = [(style["color"], str(style["ls"])) for style in styles_of(lines(*arms)).values()]
    assert len(set(looks)) == len(looks)
    assert len({color for color, _ in looks[: len(COLORS)]}) == len(COLORS), "as many colours as there are come first"


def test_algorithms_differ_by_dashes_alone():
    styles = styles_of(lines("forecast", "mine", algorithms=("ppo", "dqn")))
    for arm in ("forecast", "mine"):
        ppo, dqn = styles[Line(arm, "ppo")], styles[Line(arm, "dqn")]
        assert ppo["color"] == dqn["color"] and ppo["ls"] != dqn["ls"]
    assert styles_of([]) == {}


def test_a_score_is_drawn_with_its_interval_if_it_has_one():
    _, ax = plt.subplots()
    plot_score(ax, 3.0, Estimate(5.0, (4.0, 7.0)), color=BLUE)
    plot_score(ax, 4.0, Estimate(1.0, None), color=GREY)
    plt.close(ax.figure)
    assert [line.get_xydata().tolist() for line in ax.lines] == [[[3.0, 5.0]], [[4.0, 1.0]]]
    (bars,) = ax.collections
    assert [part.tolist() for part in bars.get_segments()] == [[[3.0, 4.0], [3.0, 7.0]]]
