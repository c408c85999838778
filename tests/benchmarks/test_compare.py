import json
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.compare import OTHER_PROCESSOR, better_of, compare, read_baseline
from benchmarks.results import Compared, Line, skipped
from benchmarks.settings import Settings
from predictor.support.errors import UserError
from tests.benchmarks.helpers import HERE, QUICK, baseline, line, write


def held(before: Line, after: Line, machine: str = HERE):
    return compare(baseline(before), [after], ("data",), machine)


@pytest.mark.parametrize(
    ("better", "after", "slower", "faster", "factor"),
    [
        ("lower", 3.0, False, False, 1.5),  # exactly the tolerance
        ("lower", 3.01, True, False, 1.505),
        ("lower", 1.0, False, True, 0.5),
        ("lower", 2.0 / 1.5 + 0.001, False, False, 0.667),
        ("higher", 1.0, True, False, 2.0),
        ("higher", 4.0, False, True, 0.5),
        ("higher", 2.0, False, False, 1.0),
    ],
)
def test_what_counts_as_slower_or_faster(better, after, slower, faster, factor):
    comparison = held(line(2.0, better=better), line(after, better=better))
    assert (bool(comparison.slower), bool(comparison.faster)) == (slower, faster)
    assert comparison.changes[0].slowdown == pytest.approx(factor, abs=1e-3)


def test_a_slower_line_is_named_with_its_factor_and_both_values():
    lines = held(line(2.0, kind="matmul"), line(4.0, kind="matmul")).report()
    assert lines == [
        "SLOWER  2.00× slower (2 → 4 matmul-equivalents, tolerance 1.50×): data | step | agents 5",
        "1 lines compared: 1 slower, 0 faster, 0 missing, 0 new",
    ]


def test_the_worst_comes_first():
    before = [line(1.0, name) for name in "abc"]
    after = [line(value, name) for name, value in zip("abc", (2.0, 9.0, 3.0), strict=True)]
    comparison = compare(baseline(*before), after, ("data",), HERE)
    assert [change.key.split(" | ")[1] for change in comparison.slower] == ["b", "c", "a"]


def test_lines_that_are_gone_or_new_are_named_and_do_not_fail():
    comparison = compare(baseline(line(1.0, "old")), [line(1.0, "fresh")], ("data",), HERE)
    assert comparison.missing == ("data | old | agents 5",)
    assert comparison.new == ("data | fresh | agents 5",)
    assert not comparison.slower
    assert comparison.report()[:2] == ["missing data | old | agents 5", "new     data | fresh | agents 5"]


def test_a_section_that_did_not_run_misses_nothing():
    assert compare(baseline(line(1.0)), [], ("machine",), HERE).missing == ()


def test_a_skipped_line_is_missing():
    before = line(1.0)
    gone = skipped("data", before.name, "needs envpool", before.what)
    assert compare(baseline(before), [gone], ("data",), HERE).missing == (before.key,)


def test_what_costs_more_than_is_promised_fails_whatever_the_baseline_has():
    within, above = (line(value, name, at_most=2.0) for value, name in ((2.0, "within"), (2.01, "above")))
    for before in (baseline(within, above), baseline()):
        comparison = compare(before, [within, above], ("data",), HERE)
        assert comparison.broken == (above,) and comparison.failing == [above.key] and not comparison.slower
        assert comparison.report()[0] == "BROKEN  2.01 of one, promised 2.00: data | above | agents 5"
        assert comparison.report()[-1].endswith(", 1 above a promise")


def test_a_line_that_fails_twice_over_is_measured_again_once():
    both = line(4.0, at_most=2.0)
    assert compare(baseline(line(1.0)), [both], ("data",), HERE).failing == [both.key]


def test_numbers_of_two_kinds_are_not_compared():
    before, now = line(0.5, kind="matmul"), line(1.1, kind="ratio")
    comparison = held(before, now)
    assert not comparison.changes and comparison.missing == comparison.new == (now.key,)


def test_the_tolerance_is_the_baselines():
    assert held(line(1.0, tolerance=1.1), line(1.2, tolerance=9.0)).slower


@pytest.mark.parametrize("kind", ["ratio", "matmul", "interpreter"])
def test_another_processor_widens_tolerances(kind):
    before, limit = line(1.0, kind=kind), 1.5 * OTHER_PROCESSOR[kind]
    within, above = line(limit - 0.01, kind=kind), line(limit + 0.01, kind=kind)
    assert held(before, within).slower and not held(before, within, "another processor").slower
    assert held(before, above, "another processor").slower


def test_within_a_run_processors_differ_least():
    assert 1 < OTHER_PROCESSOR["ratio"] < min(OTHER_PROCESSOR["matmul"], OTHER_PROCESSOR["interpreter"])


def test_absolute_times_are_neither_stored_nor_compared(tmp_path: Path):
    slow = replace(line(1.0), value=1e9)
    assert not held(line(1.0), slow).slower
    path = write(tmp_path / "baseline.json", [slow, Line("data", "absolute", {}, 3.0, "ms")])
    lines = json.loads(path.read_text())["lines"]
    assert lines == {slow.key: {"value": 1.0, "kind": "ratio", "better": "lower", "tolerance": 1.5}}


def test_a_baseline_comes_back_as_it_was_written(tmp_path: Path):
    lines = [line(1.0), line(2.0, "other", "interpreter", "higher", 3.0)]
    read = read_baseline(write(tmp_path / "new" / "baseline.json", lines), QUICK)
    assert read == baseline(*lines)
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["baseline.json"]


def test_a_value_of_zero_does_not_divide():
    assert Compared(0.0, "ratio").slowdown(1.0) == float("inf")
    assert Compared(1.0, "ratio", "higher").slowdown(0.0) == float("inf")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "is not a readable baseline"),
        ("[]", "is not a readable baseline"),
        ('{"format": "other", "version": 1}', "is not a readable baseline .*'other'"),
        ('{"format": "dgvae-rl benchmark baseline", "version": 1}', "is not a readable baseline .*lines"),
    ],
)
def test_an_unreadable_baseline_is_one_clear_line(tmp_path: Path, content: str, message: str):
    path = tmp_path / "baseline.json"
    path.write_text(content)
    with pytest.raises(UserError, match=f"{message}.*--quick --write-baseline") as caught:
        read_baseline(path, QUICK)
    assert "\n" not in str(caught.value)


def test_no_baseline_says_how_to_make_one(tmp_path: Path):
    with pytest.raises(UserError, match="no baseline at .*; make one with python -m benchmarks --write-baseline"):
        read_baseline(tmp_path / "none.json", Settings())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (Settings(threads=1), "was made by a quick run and this one is full"),
        (Settings(quick=True, threads=3), "was made with --threads 1, this run has 3"),
    ],
)
def test_a_baseline_of_other_settings_is_refused(tmp_path: Path, settings: Settings, message: str):
    path = write(tmp_path / "baseline.json", [line(1.0)])
    with pytest.raises(UserError, match=message):
        read_baseline(path, settings)


def test_a_second_measurement_counts_only_where_it_is_better_and_was_asked_for():
    first = [line(3.0, "a"), line(3.0, "b"), line(3.0, "c")]
    again = [line(2.0, "a"), line(4.0, "b"), line(1.0, "c")]
    chosen = better_of(first, again, [first[0].key, first[1].key])
    assert [r.value for r in chosen] == [2.0, 3.0, 3.0]
    assert [r.note for r in chosen] == ["measured twice", "", ""]


def test_of_rates_the_higher_one_is_better():
    first, again = line(3.0, better="higher"), line(5.0, better="higher")
    assert better_of([first], [again], [first.key])[0].value == 5.0
    assert better_of([again], [first], [first.key])[0].value == 5.0
