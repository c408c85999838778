"""Policies in an environment whose own observation is a Dict: learn, are saved, and drive, with forecasts and without.

`tests.envs.dict_crowd` reports collisions and arrivals under keys of its own.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.algorithms import new_model
from agents.arena import run_episodes
from agents.features import AttentionConfig
from agents.presets import PPOPreset
from agents.runs import save_model
from agents.summaries import summarize
from agents.task import Observe, Task
from agents.vec_envs import EpisodeResult, make_venv
from envs.collect import CollectConfig, collect
from envs.drivers.trained import sees_forecasts
from envs.rollouts.world import EgoWorld, open_world
from predictor.support.errors import UserError

ENV_ID = "tests.envs.dict_crowd:DictCrowd-v0"


@pytest.mark.parametrize("observe", ["constant-velocity", "none"])
def test_a_policy_learns_from_a_dict_and_drives(observe: Observe, tmp_path: Path):
    task = Task(ENV_ID, observe)
    venv = make_venv(task, 2, in_process=True)
    assert {"table", "goal", "mode"} <= set(getattr(venv.observation_space, "spaces", {}))
    model: Any = new_model("ppo", PPOPreset(n_steps=8, n_epochs=1, net_arch=(8,)), AttentionConfig(), venv, seed=0)
    model.learn(16)
    path = tmp_path / "policy.zip"
    save_model(model, path, {}, task.note)
    assert sees_forecasts(str(path)) == (observe != "none")
    world = open_world(ENV_ID, str(path))
    assert isinstance(world, EgoWorld)
    world.reset(5)
    assert not world.step()
    action, _ = model.predict(world._seen(), deterministic=True)
    assert np.all(np.isfinite(action))


def test_the_table_says_what_the_named_keys_say():
    """The environment's own "crashed" means something else, and is always false."""
    named = Task(ENV_ID, "none", crash_key="outcome.collided", success_key="outcome.goal.reached")
    found = []
    for task in (named, Task(ENV_ID, "none")):
        venv = make_venv(task, 1, seeded=True)
        found.append([(e.crashed, e.success) for e in run_episodes(venv, "random", [1, 2])])
    assert found == [[(True, False)] * 2, [(None, None)] * 2]
    with pytest.raises(UserError, match="crash_key is a key of the infos of an environment with one ego"):
        Task("simple_tag_v3", crash_key="crashed")
    with pytest.raises(UserError, match="success_key must be a key of the infos, got ''; leave it out, or name one"):
        Task(ENV_ID, success_key="")


def test_an_episode_without_the_event_counts_where_others_report_it():
    episodes = [EpisodeResult(i, 0.0, 1, crashed, 0.0) for i, crashed in enumerate((True, None, None, None))]
    assert summarize("mine", episodes).crash_rate == 0.25
    assert summarize("mine", episodes[1:]).crash_rate is None


def test_episodes_are_recorded(tmp_path: Path):
    (episode,) = collect(CollectConfig(ENV_ID, tmp_path / "store", episodes=1, workers=1))
    assert episode.states.shape[0] == 10 and episode.valid[0, 0]
