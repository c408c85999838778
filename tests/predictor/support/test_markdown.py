import pytest

from predictor.support.markdown import table


def test_a_line_for_headings_rules_and_cells():
    assert table(["a", "b"], [["1", "2"], ["3", "4"]]) == "| a | b |\n|---|---|\n| 1 | 2 |\n| 3 | 4 |"


def test_the_last_letter_of_align_holds_for_the_columns_that_follow():
    assert table(["a", "b", "c"], [], "-r").splitlines()[1] == "|---|---:|---:|"
    assert table(["a", "b"], [], "lr-").splitlines()[1] == "|:---|---:|"


def test_bars_in_cells_do_not_end_them():
    assert table(["a"], [["|r|"]]).splitlines()[-1] == r"| \|r\| |"


def test_a_line_of_another_length_is_refused():
    with pytest.raises(ValueError, match="needs 2 cells, got 1"):
        table(["a", "b"], [["1"]])
