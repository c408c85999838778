import numpy as np
import pytest

from benchmarks.results import Line
from benchmarks.timing import (
    Meter,
    Timing,
    Yardstick,
    alternate,
    interpreter,
    products,
    quartiles,
    rate_line,
    ratio_line,
    timed_line,
)

STICK = Yardstick("matmul", lambda: None, flop=100.0)
TIMING = Timing(np.array([2.0, 4.0, 6.0]), np.array([1.0, 1.0, 2.0]), STICK)


def test_blocks_take_turns_and_every_other_round_is_reversed():
    order: list[str] = []

    def block(name: str):
        def run() -> float:
            order.append(name)
            return float(len(order))

        return run

    taken = alternate({name: block(name) for name in "abc"}, rounds=3)
    assert "".join(order) == "abc" + "cba" + "abc"
    assert taken["a"].tolist() == [1, 6, 7]


def test_a_spent_budget_still_leaves_three_rounds():
    assert len(alternate({"a": lambda: 0.0}, rounds=10, budget_s=-1.0)["a"]) == 3


def test_a_call_is_repeated_until_its_block_is_long_enough():
    calls = []
    meter = Meter(rounds=3, block_s=0.0)
    timings = meter.measure({"a": lambda: calls.append(1)}, Yardstick("matmul", lambda: None))
    assert len(calls) == 2 + 3  # two to warm up
    assert timings["a"].seconds.shape == timings["a"].yard.shape == (3,)


def test_medians_are_of_each_round_against_its_own_yardstick():
    assert TIMING.median == 4.0
    assert TIMING.equivalents == 3.0
    # 200 FLOP in 2, 4, 6 s against 100 FLOP in 1, 1, 2 s: 1, 0.5, 2/3
    assert TIMING.matmul_share(200.0) == pytest.approx(2 / 3)
    assert TIMING.plus(TIMING).equivalents == 6.0


def test_a_yardstick_without_flop_gives_no_share():
    assert Timing(TIMING.seconds, TIMING.yard, Yardstick("interpreter", lambda: None)).matmul_share(1.0) is None


def test_a_timed_line_has_milliseconds_a_ratio_and_equivalents():
    base = Timing(np.array([1.0, 4.0, 12.0]), TIMING.yard, STICK)
    line = timed_line("data", "step", {}, TIMING, flop=200.0, base=base, ratio_to="other", tolerance=2.0)
    assert (line.value, line.unit, line.quartiles) == (4000.0, "ms", (3000.0, 5000.0))
    assert (line.ratio, line.ratio_to) == (1.0, "other")
    assert (line.flop, line.flops_per_s, line.matmul_share) == (200.0, 50.0, pytest.approx(2 / 3))
    assert line.compared is not None
    assert (line.compared.value, line.compared.kind, line.compared.better) == (3.0, "matmul", "lower")
    assert line.compared.tolerance == 2.0


def test_a_rate_is_compared_by_its_time():
    line = rate_line("data", "cut", {}, TIMING, 8, "windows/s")
    assert (line.value, line.unit) == (2.0, "windows/s")
    assert line.compared is not None and (line.compared.value, line.compared.better) == (3.0, "lower")


def test_a_ratio_is_compared_as_it_is():
    line = ratio_line("ppo", "ratio", {}, np.array([2.0, 3.0, 4.0]), "plain", better="higher")
    assert isinstance(line, Line) and line.compared is not None
    assert (line.value, line.quartiles) == (3.0, (2.5, 3.5))
    assert (line.compared.value, line.compared.kind, line.compared.better) == (3.0, "ratio", "higher")


def test_quartiles():
    assert quartiles(np.arange(5.0)) == (1.0, 3.0)


def test_the_yardsticks_run_and_know_their_work():
    small = products(((2, 3, 4), (5, 6, 7)))
    small.call()
    assert (small.kind, small.flop) == ("matmul", 2 * (24 + 210))
    assert interpreter().kind == "interpreter" and np.isfinite(interpreter().call())
