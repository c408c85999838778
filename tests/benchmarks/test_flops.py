from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.flops import STATE, Work
from benchmarks.models import TrainingStep, forecaster, inference, observed, road, scenes, sized

AGENTS, BATCH = 12, 2
# Executed work may exceed what is needed (folding weights, a diagonal that is computed and masked), not by much.
LEAST, MOST = 0.97, 1.15


def _addmm(target: Any, left: Any, right: Any, out_shape: Any = None, **_: Any) -> int:
    return 2 * left[0] * left[1] * right[1]


def _baddbmm(target: Any, left: Any, right: Any, out_shape: Any = None, **_: Any) -> int:
    return 2 * left[0] * left[1] * left[2] * right[2]


def _linear(first: Any, second: Any, third: Any, *_: Any, out_shape: Any = None, **__: Any) -> int:
    weight = third if isinstance(third, Sequence) and len(third) == 2 else second  # with or without something to add to
    return 2 * first[0] * weight[0] * weight[1]


def executed(call: Any) -> float:
    """Returns FLOP as counted by torch, which misses products into one of their own inputs and those of oneDNN."""
    others = {torch.ops.aten.addmm_: _addmm, torch.ops.aten.baddbmm_: _baddbmm}
    if torch.backends.mkldnn.is_available():
        others[torch.ops.mkldnn._linear_pointwise] = _linear
    with FlopCounterMode(display=False, custom_mapping=others) as counter:
        call()
    return float(counter.get_total_flops())


@pytest.mark.parametrize("preset", ["fast", "paper"])
@pytest.mark.parametrize("samples", [1, 4])
def test_forecasts_execute_what_is_counted(preset: str, samples: int):
    model = forecaster(sized(preset), road(AGENTS), 5)
    states, valid = scenes(BATCH, AGENTS)
    memory, belief = observed(model, states, valid)
    work = Work(model.config, AGENTS)
    look = executed(inference(lambda: model.observe(memory, states, valid)))
    assert LEAST < look / work.observe(BATCH) < MOST
    ahead = executed(inference(lambda: model.rollout(belief, 5, samples, torch.Generator())))
    assert LEAST < ahead / work.rollout(5, samples, BATCH) < MOST


@pytest.mark.parametrize("preset", ["fast", "paper"])
def test_a_frozen_graph_executes_what_is_counted(preset: str):
    model = forecaster(replace(sized(preset), rollout_graph="frozen"), road(AGENTS), 10)
    belief = observed(model, *scenes(BATCH, AGENTS))[1]
    ahead = executed(inference(lambda: model.rollout(belief, 10)))
    work = Work(model.config, AGENTS)
    # the features' share may be computed at every step
    most = work.rollout(10, 1, BATCH, frozen=True) + 9 * BATCH * work.features
    assert LEAST * work.rollout(10, 1, BATCH, frozen=True) < ahead < MOST * most


@pytest.mark.parametrize("preset", ["fast", "paper"])
@pytest.mark.parametrize("rollout", [0, 4])
def test_training_executes_what_is_counted(preset: str, rollout: int):
    step = TrainingStep(sized(preset), AGENTS, 10, BATCH, rollout)
    needed = Work(step.model.config, AGENTS, inputs=STATE).training(BATCH, 10, rollout, step.last)
    assert LEAST < executed(step) / needed < MOST


def test_pairs_are_ordered_and_of_two_different_agents():
    config = sized("fast")
    assert Work(config, 5).pairs == 20
    assert Work(config, 100, neighbours=8).pairs == 800
    assert Work(config, 5, neighbours=8).pairs == 20
    assert Work(config, 1).pairs == 0


def test_work_grows_linearly_with_batch_and_neighbours_bound_it():
    work = Work(sized("paper"), 50)
    assert work.observe(6) == 6 * work.observe()
    assert work.rollout(20, 1, 6) == 6 * work.rollout(20)
    twice = Work(sized("paper"), 100, neighbours=8).observe() / Work(sized("paper"), 50, neighbours=8).observe()
    assert twice == pytest.approx(2.0)


def test_the_first_step_of_the_expected_forecast_is_known_from_observing():
    work = Work(sized("fast"), 4)
    assert work.rollout(1) == 0
    assert work.rollout(1, frozen=True) == 0
    assert work.rollout(1, samples=3) == 2 * (work.features + work.move)
    assert 0 < work.rollout(5, frozen=True) < work.rollout(5)
