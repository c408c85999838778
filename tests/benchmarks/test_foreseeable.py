"""How much of the prey's future could be foreseen (`benchmarks.foreseeable`)."""

import functools
import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from agents.policy import load_policy
from benchmarks import foreseeable
from benchmarks.foreseeable import NAMES, generators_of, redrawn, told_of_nearest, with_habits
from envs.drivers.all_agents import Habits
from envs.plans.keeping_on import all_keeping_on
from predictor.scene import Scene


def test_all_random_streams_of_a_driver_are_found():
    common, own, other = (np.random.default_rng(seed) for seed in range(3))
    driver = functools.partial(print, common, {"agent_0": functools.partial(print, own, [], by=other)}, 1)
    assert {*map(id, generators_of(driver))} == {*map(id, (common, own, other))}


def test_copies_draw_anew_and_leave_the_world_as_it_was():
    policy, env = load_policy("simple-tag")
    observations, _ = env.reset(seed=3)
    for _ in range(4):
        actions = policy(observations)
        observations, *_ = env.step(actions)
    told = env.scene.scene, observations, actions, 10
    prey = env.scene.index_of["agent_0"]
    before = all_keeping_on(env.env, env.reader, *told)
    rng = np.random.default_rng(0)
    drawn = [all_keeping_on(copied, reader, *told)[prey] for copied, reader in (redrawn(env, rng) for _ in range(8))]
    assert len({each.tobytes() for each in drawn}) > 1  # the prey's driver draws in most steps
    np.testing.assert_array_equal(all_keeping_on(env.env, env.reader, *told), before)


def habits_in(driver: Any) -> list[Habits]:
    """Returns the habits that a driver holds, each as often as it stands in it."""
    if isinstance(driver, functools.partial):
        return [habits for part in (driver.func, *driver.args, *driver.keywords.values()) for habits in habits_in(part)]
    if isinstance(driver, dict):
        return [habits for part in driver.values() for habits in habits_in(part)]
    return [driver] if isinstance(driver, Habits) else []


def test_habits_are_replaced_wherever_a_driver_holds_them_and_nothing_else_is():
    old, new = (Habits.draw(np.random.default_rng(seed)) for seed in (0, 1))
    last: list[Any] = [3]
    driver = functools.partial(print, old, functools.partial(max, 1, key=old), last, sep="-")
    other = with_habits(driver, new)
    assert habits_in(other) == [new, new] and habits_in(driver) == [old, old]
    assert other.func is print and other.args[2] is last and other.keywords == {"sep": "-"}


def test_copies_with_other_habits_leave_those_of_the_world():
    policy, env = load_policy("simple-tag")
    observations, _ = env.reset(seed=3)
    env.step(policy(observations))
    own = habits_in(env.env._driver)
    drawn = [habits_in(redrawn(env, np.random.default_rng(seed), habits=True)[0]._driver) for seed in (0, 1)]
    assert own and all(len(of) == len(own) and len(set(of)) == 1 for of in (own, *drawn))  # one agent is driven
    assert len({own[0], drawn[0][0], drawn[1][0]}) == 3 and habits_in(env.env._driver) == own
    assert habits_in(redrawn(env, np.random.default_rng(0))[0]._driver) == own


def test_the_path_that_is_told_is_the_predators_and_the_forecast_the_preys():
    """Plans are of agent 0, so the predator, here 2, stands first; the prey, 1, is then the third."""
    scene = Scene(np.zeros((3, 4)), np.arange(3), np.ones(3, dtype=bool))
    asked: list[Any] = []

    def rollout_plans(belief: Any, plan: torch.Tensor) -> Any:
        asked.append(plan[0, 0])
        apart = 10.0 * torch.arange(3)[:, None, None]
        return SimpleNamespace(states=(plan[0, 0] + apart)[None, None, None])

    forecaster: Any = SimpleNamespace(spec=SimpleNamespace(dt_s=0.5), rollout_plans=rollout_plans)
    online: Any = SimpleNamespace(_beliefs=[None])
    path = np.array([[1.0, 2.0], [3.0, 2.0]])
    np.testing.assert_array_equal(told_of_nearest(forecaster, online, scene, 1, path, 2), path + 20.0)
    np.testing.assert_array_equal(asked[0], [[1.0, 2.0, 2.0, 4.0], [3.0, 2.0, 4.0, 0.0]])


@pytest.mark.slow
def test_the_command_prints_an_error_for_each_forecaster(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch
):
    arguments = ["foreseeable", "--episodes", "1", "--draws", "4", "--out", str(tmp_path / "found.json")]
    monkeypatch.setattr(sys, "argv", arguments)
    foreseeable.main()
    found = json.loads((tmp_path / "found.json").read_text())
    assert found["steps"] == 24 and tuple(found["ade_m"]) == NAMES
    assert all(f"| {name} | {found['ade_m'][name]:.3f} |" in capsys.readouterr().out for name in NAMES[:1])
    assert found["ade_m"][NAMES[4]] < found["ade_m"]["constant velocity"]
