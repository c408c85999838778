from dataclasses import replace

import pytest

from predictor.evaluation.in_env_record import Measurement
from predictor.reports.in_env_tables import card_section, measurement_table, replace_tables, samples_table
from predictor.reports.tables import metres
from predictor.support.errors import UserError

MEASURED = Measurement(
    "toy-v0", "varied", 50, 20, "", "", 5.0, 9.0, 0.5, (0.25, 1.5), 2.5, below_cv=0.9, below_cv_interval=(0.85, 0.95)
)


def test_lengths_have_three_decimals_below_a_metre_and_two_above():
    assert [metres(0.46), metres(1.0), metres(19.137), metres(None)] == ["0.460", "1.00", "19.14", "–"]
    assert metres(0.5, (0.25, 1.5)) == "0.500 (0.250 to 1.50)"


def test_a_line_has_driver_episodes_and_k_and_a_dash_for_what_was_not_measured():
    heading, _, line = measurement_table([MEASURED]).splitlines()
    cells = dict(zip(heading.strip("| ").split(" | "), line.strip("| ").split(" | "), strict=True))
    assert (cells["driver"], cells["episodes"], cells["K"]) == ("varied", "50", "20")
    assert cells["minADE₁ / minFDE₁ [m]"] == "0.500 / 2.50"
    assert cells["nearest neighbours ADE [m]"] == "–"
    assert cells["ADE below constant velocity (95 %)"] == "90 % (85 to 95)"


def test_a_note_stands_once_below_the_table_with_the_envs_it_concerns():
    marked = [Measurement(name, "varied", 1, 20, "", "", note="selected on these seeds") for name in ("a-v0", "b-v0")]
    lines = measurement_table([MEASURED, *marked]).splitlines()
    assert [line.split(" |")[0] for line in lines[2:5]] == ["| toy-v0", "| a-v0*", "| b-v0*"]
    assert lines[5:] == ["", r"\* a-v0, b-v0: selected on these seeds."]


def test_coverage_with_the_spread_of_modes_is_told_where_it_was_measured():
    sampled = replace(MEASURED, energy_m=1.0, coverage=(0.75, 1.0))
    coverages = (None, (0.5, 0.875), (0.986, 0.99))
    plain, spread, narrow = samples_table([replace(sampled, mixture_coverage=c) for c in coverages]).splitlines()[2:]
    assert "| 75 to 100 % |" in plain and "| 75 to 100 %; with spread 50 to 88 % |" in spread
    assert "| 75 to 100 %; with spread 99 % |" in narrow


def test_a_coverage_that_was_measured_later_has_a_commit_of_its_own():
    once, later = replace(MEASURED, commit="abc"), replace(MEASURED, commit="abc", spread_commit="def")
    text = card_section([once, later])
    assert "`, commit abc\n" in text and text.endswith("`, commit abc (coverage with spread: def)")


def test_only_what_stands_between_the_markers_is_replaced():
    page = "before\n<!-- table: one -->\nold\n<!-- end -->\nbetween\n<!-- table: two -->\n<!-- end -->\nafter\n"
    once = replace_tables(page, {"one": "| 1 |", "two": "| 2 |"})
    assert once.split("\n")[:6] == ["before", "<!-- table: one -->", "", "| 1 |", "", "<!-- end -->"]
    assert "old" not in once and "between" in once and once.endswith("<!-- end -->\nafter\n")
    assert replace_tables(once, {"one": "| 1 |", "two": "| 2 |"}) == once


def test_a_marker_of_an_unknown_table_is_refused():
    with pytest.raises(UserError, match="no table is called 'three'; there are one"):
        replace_tables("<!-- table: three -->\n<!-- end -->\n", {"one": ""})
