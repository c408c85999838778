"""Rewards for coming closer guide learning; nothing else counts them."""

from typing import Any

import numpy as np
import pytest

from agents.arena import MultiagentArena
from agents.shaping import PER_METRE, Chase, shaped
from agents.task import Task
from agents.training import TrainingPlan, train
from agents.vec_envs import make_venv
from envs.registry import make_multiagent_env
from tests.agents.helpers import policy_for

TAG = "simple_tag_v3"
PREDATORS = ("adversary_0", "adversary_1", "adversary_2")


def played(env: Any, seed: int = 4) -> tuple[dict[str, float], dict[str, float]]:
    """Plays one episode of fixed actions; returns summed rewards and how much closer each predator has come [m]."""
    env.reset(seed=seed)
    rng, world = np.random.default_rng(0), env.unwrapped.world

    def apart_m() -> dict[str, float]:
        prey = next(body for body in world.agents if not body.adversary)
        return {b.name: float(np.linalg.norm(prey.state.p_pos - b.state.p_pos)) for b in world.agents if b.adversary}

    sums, first = dict.fromkeys(env.possible_agents, 0.0), apart_m()
    while env.agents:
        for name, reward in env.step({name: int(rng.integers(5)) for name in env.agents})[1].items():
            sums[name] += reward
    return sums, {name: first[name] - last for name, last in apart_m().items()}


def test_what_is_added_is_the_distance_gained_over_the_episode():
    plain, _ = played(make_multiagent_env(TAG))
    sums, closer_m = played(shaped(make_multiagent_env(TAG)))
    assert set(closer_m) == set(PREDATORS) and min(map(abs, closer_m.values())) > 0.01
    for name in PREDATORS:
        assert sums[name] - plain[name] == pytest.approx(PER_METRE * closer_m[name])
    assert sums["agent_0"] == plain["agent_0"]
    twice = Chase(make_multiagent_env(TAG))
    assert [played(twice)[0] for _ in range(2)] == [sums, sums], "an episode begins anew"


def test_other_rewards_stay_as_they_are():
    env = make_multiagent_env("simple_spread_v3")
    assert shaped(env) is env


@pytest.mark.parametrize("observe", ["none", "constant-velocity"])
def test_learning_is_shaped_and_measuring_is_not(observe: Any):
    task = Task(TAG, observe, learners=("adversary",))
    rewards = {}
    for shaping in (True, False):
        venv = make_venv(task, 1, shaping=shaping)
        venv.seed(3)
        venv.reset()
        venv.step(np.array([1, 2, 3]))  # a push moves an agent at the next step
        rewards[shaping] = venv.step(np.array([1, 2, 3]))[1]
        venv.close()
    assert rewards[True].all() and not rewards[False].any()
    (result,) = MultiagentArena(task).play(policy_for(task), [3])
    assert result.episode_return % 10 == 0, "touches alone"


@pytest.mark.parametrize("shaping", [True, False])
def test_a_plan_says_whether_rewards_are_shaped(shaping: bool, tmp_path: Any, monkeypatch: pytest.MonkeyPatch):
    class Made(Exception):
        """Ends the training where its environments are made."""

    def note(*_: Any, **options: Any) -> None:
        raise Made(options["shaping"])

    monkeypatch.setattr("agents.training.make_venv", note)
    with pytest.raises(Made, match=str(shaping)):
        train(TrainingPlan(Task(TAG, "none"), "ppo", 1, 1, 0, shaping=shaping), tmp_path)


def test_without_prey_nothing_is_added():
    task = Task(TAG, "none", env_kwargs='{"num_good": 0, "num_adversaries": 2}')
    env = Chase(task.make())
    env.reset(seed=0)
    _, rewards, *_ = env.step({agent: 1 for agent in env.agents})
    assert len(rewards) == 2
    env.close()


def test_of_several_prey_the_nearest_one_counts():
    envs: list[Any] = [wrap(make_multiagent_env(TAG, num_good=2)) for wrap in (Chase, lambda env: env)]
    for env in envs:
        env.reset(seed=4)

    def nearest_m() -> dict[str, float]:
        bodies = envs[0].unwrapped.world.agents
        prey = [body.state.p_pos for body in bodies if not body.adversary]
        return {b.name: min(np.linalg.norm(p - b.state.p_pos) for p in prey) for b in bodies if b.adversary}

    rng, first = np.random.default_rng(0), nearest_m()
    gained = dict.fromkeys(PREDATORS, 0.0)
    while envs[0].agents:
        actions = {name: int(rng.integers(5)) for name in envs[0].agents}
        shaped, plain = (env.step(actions)[1] for env in envs)
        for name in PREDATORS:
            gained[name] += shaped[name] - plain[name]
    assert gained == pytest.approx({name: PER_METRE * (first[name] - last) for name, last in nearest_m().items()})
