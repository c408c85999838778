import pytest

from predictor.evaluation.training_seeds import joined, limits


def run(seed: int, error: float | None, name: str = "model") -> dict[str, object]:
    accuracy = {"min_ade_m": error, "by_step_m": [error, 2.0], "num_samples": 20, "statistics": {}}
    return {
        "name": name, "seed": seed, "train_seconds": 10.0, "measure_seconds": 1.0, "tests": {"test": accuracy},
        "graph": None,
    }  # fmt: skip


def test_numbers_are_means_times_are_sums_and_the_runs_stay():
    row = joined([run(3, 1.0), run(4, 2.0), run(5, 6.0)])
    assert row["tests"]["test"]["min_ade_m"] == pytest.approx(3.0)
    assert row["tests"]["test"]["by_step_m"] == [pytest.approx(3.0), 2.0]
    assert row["tests"]["test"]["num_samples"] == 20 and isinstance(row["tests"]["test"]["num_samples"], int)
    assert (row["name"], row["graph"], row["seeds"]) == ("model", None, [3, 4, 5])
    assert (row["train_seconds"], row["measure_seconds"]) == (30.0, 3.0)
    assert [r["seed"] for r in row["runs"]] == [3, 4, 5]


def test_limits_are_the_smallest_and_the_largest_run():
    row = joined([run(0, 2.0), run(1, 1.0), run(2, 6.0)])
    assert limits(row, "tests", "test", "min_ade_m") == (1.0, 6.0)
    assert limits(row, "tests", "test", "statistics", "coverage", "mean") is None
    assert limits(row, "graph", "accuracy") is None


def test_a_number_that_one_run_lacks_has_neither_mean_nor_limits():
    row = joined([run(0, 2.0), run(1, None)])
    assert row["tests"]["test"]["min_ade_m"] is None
    assert limits(row, "tests", "test", "min_ade_m") is None


def test_what_is_no_number_is_not_averaged():
    def matched(seed: int, order: list[int]) -> dict[str, object]:
        return run(seed, 1.0) | {"graph": {"permutation": order, "accuracy": 0.9 + 0.02 * seed}}

    row = joined([matched(0, [0, 1]), matched(1, [1, 0])])
    assert row["graph"] == {"permutation": [0, 1], "accuracy": pytest.approx(0.91)}
    assert joined([matched(0, [0, 1]), run(1, 1.0)])["graph"] is None  # nor what one run lacks


def test_one_run_is_itself_and_has_no_limits():
    row = joined([run(7, 2.5)])
    assert row["tests"] == run(7, 2.5)["tests"] and row["seeds"] == [7]
    assert limits(row, "tests", "test", "min_ade_m") is None
