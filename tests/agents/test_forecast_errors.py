from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from agents.task import Observe, Task
from agents.training import TrainingPlan, read_curve, train


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:rich is experimental")
@pytest.mark.parametrize("observe", ["constant-velocity", "forecast", "none"])
def test_the_curve_and_tensorboard_hold_the_errors_of_the_forecasts_that_were_acted_on(
    observe: Observe, tmp_path: Path
):
    plan = TrainingPlan(
        Task("merge-v1", observe),
        "ppo",
        256,
        2,
        0,
        selections=1,
        selection_episodes=1,
        selection_envs=1,
        in_process=True,
    )
    train(plan, tmp_path)
    point = read_curve(tmp_path / "curve.json")[-1]
    events = EventAccumulator(str(tmp_path / "tb" / "run_1"))
    events.Reload()
    if observe == "none":
        assert "forecast_error_m" not in point and not [t for t in events.Tags()["scalars"] if t.startswith("loop/")]
        return
    ours, constant = point["forecast_error_m"], point["constant_velocity_error_m"]
    assert events.Scalars("loop/forecast_error_m")[-1].value == pytest.approx(ours)
    if observe == "forecast":
        assert 0.05 < ours < 0.4 * constant, "the shipped forecaster knows how vehicles merge"
    else:
        assert ours == pytest.approx(constant, rel=1e-4) and ours > 1
