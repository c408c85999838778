import json
from dataclasses import replace
from pathlib import Path

import pytest

from predictor.evaluation.in_env_record import (
    FILE_NAME,
    Control,
    Measurement,
    measurements_of,
    read_record,
    updated,
    write_record,
)
from predictor.support.errors import UserError

FIRST = Measurement("toy-v0", "varied", 50, 20, "python -m envs.evaluate", "abc", 5.0, 9.0, 1.25, (1.0, 1.5), 2.5)


def test_a_record_is_read_as_it_was_written(tmp_path: Path):
    write_record(tmp_path, [FIRST])
    assert read_record(tmp_path) == [FIRST]


def test_a_later_measurement_replaces_the_one_of_the_same_env_driver_and_k():
    again = Measurement("toy-v0", "varied", 10, 20, "later", "def", 4.0)
    others = [Measurement("toy-v0", "idle", 50, 20, "", "", 3.0), Measurement("toy-v0", "varied", 6, 1, "", "", 3.0)]
    assert updated([FIRST, *others], [again]) == [again, *others]


def test_a_later_measurement_keeps_the_remark_of_the_one_that_it_replaces():
    again = replace(FIRST, commit="def", min_ade_m=4.0)
    old = replace(FIRST, note="retrained after a first look")
    assert updated([old], [again]) == [replace(again, note="retrained after a first look")]


def test_a_folder_without_a_record_has_no_measurements(tmp_path: Path):
    assert read_record(tmp_path) == []


@pytest.mark.parametrize("content", ["{", "[]", '{"measurements": [{"env": "toy-v0"}]}', '{"measurements": 3}'])
def test_a_file_that_is_no_record_is_refused(tmp_path: Path, content: str):
    (tmp_path / FILE_NAME).write_text(content)
    with pytest.raises(UserError, match=r"in_env\.json is not a record of measurements .* predictor\.card"):
        read_record(tmp_path)


def test_everything_that_accuracy_json_says_of_a_checkpoint_is_taken_over():
    one = {
        "min_ade_m": 1.0,
        "min_fde_m": 2.0,
        "agents": 7,
        "by_step_m": [0.5, 2.0],
        "intervals": {"min_ade_m": [0.5, 1.5]},
    }
    many = {"min_ade_m": 0.75, "min_joint_ade_m": 0.875, "energy_m": 0.5, "overlap": 0.125, "true_overlap": 0.0}
    result = {
        "env_id": "toy-v0", "checkpoint": "toy", "driver": "varied", "dt_s": 0.5, "model": one,
        "model_samples": many, "constant_velocity": {"min_ade_m": 4.0, "min_fde_m": 8.0},
        "histories": {"1": one | {"min_ade_m": 1.75}},
        "reduction": 0.75, "reduction_interval": [0.5, 0.875], "latency_median_ms": 3.0, "latency_p95_ms": 9.0,
    }  # fmt: skip
    content = {
        "config": {"episodes": 6, "num_samples": 20},
        "results": [result, result | {"checkpoint": "other"}],
        "provenance": {"command": "python -m envs.evaluate", "commit": "abc"},
    }
    (found,) = measurements_of(json.loads(json.dumps(content)), "toy")
    assert found == Measurement(
        "toy-v0", "varied", 6, 20, "python -m envs.evaluate", "abc", 4.0, 8.0, 1.0, (0.5, 1.5), 2.0, 0.75,
        joint_best_of_k_m=0.875, energy_m=0.5, overlap=(0.125, 0.0),
        one_step_m=1.75, one_step_interval_m=(0.5, 1.5), below_cv=0.75,
        below_cv_interval=(0.5, 0.875), latency_ms=(3.0, 9.0), forecasts=7, horizon_steps=2, dt_s=0.5,
    )  # fmt: skip


def test_samples_and_controls_are_taken_over():
    one = {"min_ade_m": 1.0, "min_fde_m": 2.0}
    many = {
        "min_ade_m": 0.5, "min_joint_ade_m": 0.75, "energy_m": 0.625, "coverage": [0.75, 1.0, None],
        "mixture_coverage": [0.875, None, 0.5], "overlap": 0.125,
        "true_overlap": 0.0, "intervals": {"min_ade_m": [0.25, 0.75], "energy_m": [0.5, 1.0]},
        "statistics": {"coverage": {"mean": 0.875}},
    }  # fmt: skip
    near = many | {"ade_m": 3.0, "statistics": {}}
    result = {
        "env_id": "toy-v0", "checkpoint": "toy", "driver": "varied", "dt_s": 0.5, "model": one, "model_samples": many,
        "constant_velocity": one, "controls": {"nearest neighbours": near, "constant velocity + noise": many},
        "reduction": None, "reduction_interval": None,
    }  # fmt: skip
    made = {"command": "c", "commit": "abc"}
    (found,) = measurements_of(
        {"config": {"episodes": 6, "num_samples": 20}, "results": [result], "provenance": made}, "toy"
    )
    assert (found.best_of_k_m, found.best_of_k_interval_m) == (0.5, (0.25, 0.75))
    assert (found.joint_best_of_k_m, found.joint_best_of_k_interval_m) == (0.75, None)
    assert (found.energy_m, found.energy_interval_m, found.coverage) == (0.625, (0.5, 1.0), (0.75, 1.0))
    assert found.mixture_coverage == (0.5, 0.875)
    assert found.overlap == (0.125, 0.0) and found.neighbours_m == 3.0
    assert found.controls == {
        "nearest neighbours": Control(0.5, 0.75, 0.625, None),
        "constant velocity + noise": Control(0.5, 0.75, 0.625, 0.875),
    }
