from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
from pettingzoo import ParallelEnv

from agents.arena import MultiagentArena
from agents.task import Task
from agents.vec_envs import DrivenEnv, EpisodeResult, MakeCopy, drive, make_multiagent_venv
from envs.drivers.all_agents import make_driver
from envs.registry import make_multiagent_env
from envs.seeding import driver_rng
from envs.supervision import EnvironmentFailedError
from predictor.online import OnlineForecaster
from predictor.support.errors import UserError
from tests.agents.helpers import LIVES, TOY, policy_for

TAG, SPREAD = "simple_tag_v3", "simple_spread_v3"


def facts(results: list[EpisodeResult]) -> list[tuple]:
    """Returns the results without the speed, as NaN is not equal to NaN."""
    return [(r.seed, r.episode_return, r.length, r.crashed, r.returns_by_role) for r in results]


# --- Environments -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("learners", "expected"),
    [
        ((), ["adversary_0", "adversary_1", "adversary_2", "agent_0"]),
        (("adversary",), ["adversary_0", "adversary_1", "adversary_2"]),
        (("agent_0",), ["agent_0"]),
        (("agent", "adversary_1"), ["adversary_1", "agent_0"]),
    ],
    ids=["all", "role", "agent", "both"],
)
def test_every_learner_of_every_copy_is_an_environment(learners: tuple[str, ...], expected: list[str]):
    venv = make_multiagent_venv(Task(TAG, "none", learners=learners), 2)
    assert venv.num_envs == 2 * len(expected)
    assert venv.get_attr("possible_agents")[0] == ["adversary_0", "adversary_1", "adversary_2", "agent_0"]
    assert venv.venv.agents_of_envs == 2 * expected  # type: ignore[attr-defined]
    venv.close()


def test_unknown_learners_are_named():
    with pytest.raises(UserError, match=f"'wolf' is neither an agent nor a role of {TAG}; it has adversary_0, "):
        make_multiagent_venv(Task(TAG, learners=("wolf",), observe="none"), 1)


def test_the_oracle_of_a_task_repeats_the_learners_actions_alone():
    """The prey, which does not learn, is driven in the copy as it is then driven in the environment."""
    venv = make_multiagent_venv(Task(TAG, "oracle", learners=("adversary",)), 1)
    venv.seed(5)
    venv.reset()
    env, pushes = venv.venv.envs[0], np.array([1, 2, 4])  # type: ignore[attr-defined]
    assert list(env.drive_others(env.reset(seed=5)[0])) == ["agent_0"]
    venv.seed(5)
    venv.reset()
    venv.step(pushes)
    true = env.scene.true_xy
    for step in range(true.shape[1]):
        venv.step(pushes)
        np.testing.assert_allclose(env.scene.scene.states[:, :2], true[:, step], atol=1e-9)
    venv.close()


def test_learners_observe_what_the_task_says():
    own = make_multiagent_venv(Task(SPREAD, "none"), 1)
    assert own.observation_space == make_multiagent_env(SPREAD).observation_space("agent_0")
    seeing = make_multiagent_venv(Task(SPREAD, "constant-velocity"), 1)
    assert isinstance(seeing.observation_space, gym.spaces.Dict)
    assert seeing.observation_space["observation"] == own.observation_space
    assert {"agents", "forecast", "valid"} <= set(seeing.observation_space)


def test_a_copy_that_raises_or_returns_nan_is_named(monkeypatch: pytest.MonkeyPatch):
    venv = make_multiagent_venv(Task(TAG, "none"), 2)
    venv.seed(5)
    venv.reset()
    simulator: Any = venv.venv.envs[0].env  # type: ignore[attr-defined]
    step = simulator.step

    def no_number(actions: Any) -> Any:
        observations, rewards, *more = step(actions)
        return observations, dict.fromkeys(rewards, float("nan")), *more

    def broken(actions: Any) -> Any:
        raise ZeroDivisionError("no mass")

    found = []
    for misbehaving in (no_number, broken):
        monkeypatch.setattr(simulator, "step", misbehaving)
        with pytest.raises(EnvironmentFailedError) as caught:
            venv.step(np.zeros(venv.num_envs, dtype=np.int64))
        found.append(str(caught.value))
    assert found[0] == f"{TAG}, seed 5, step 1: the reward must be a finite number, got NaN"
    assert found[1].startswith(f"{TAG}, seed 5, step 2: ZeroDivisionError: no mass (")
    venv.close()


@pytest.mark.parametrize("observe", ["forecast", "zeros", "constant-velocity"])
def test_a_step_of_all_copies_and_learners_is_one_forecast(observe: Any, monkeypatch: pytest.MonkeyPatch):
    batches: list[int] = []
    forecast = OnlineForecaster.forecast

    def note(self: OnlineForecaster, horizon_steps: int, num_samples: int, noise: Any, *more: Any) -> Any:
        batches.append(len(noise))
        return forecast(self, horizon_steps, num_samples, noise, *more)

    monkeypatch.setattr(OnlineForecaster, "forecast", note)
    venv = make_multiagent_venv(Task(TAG, observe, learners=("adversary",)), 3)
    venv.reset()
    for _ in range(26):  # episodes have 25 steps: the last and the first scenes of three copies are one batch, too
        venv.step(np.zeros(venv.num_envs, dtype=np.int64))
    assert batches == [3] * 25 + [6, 3]
    venv.close()


# --- Partners ---------------------------------------------------------------------------------------------------------


def prey_actions(env: Any, observations: Any) -> list[int]:
    """Returns the actions of the driver for the prey until the end of the episode."""
    actions = []
    while env.agents:
        found = drive(env, {"agent_0": observations["agent_0"]}, np.random.default_rng())
        assert set(found) == {"agent_0"}
        actions.append(found["agent_0"])
        observations, *_ = env.step(found | dict.fromkeys(["adversary_0", "adversary_1", "adversary_2"], 0))
    return actions


@pytest.mark.parametrize("observe", ["none", "constant-velocity"])
@pytest.mark.parametrize("driver", ["varied", "heuristic"])
def test_the_prey_is_driven_anew_in_each_episode_by_seed(driver: str, observe: Any):
    env = MakeCopy(Task(TAG, observe, learners=("adversary",), driver=driver))()
    played = [prey_actions(env, env.reset(seed=seed)[0]) for seed in (7, None, 7, None, 8)]
    assert played[:2] == played[2:4]
    assert played[0] != played[1]
    assert played[4] not in played[:2]
    assert {len(actions) for actions in played} == {25}  # mpe2's max_cycles


def test_a_driver_serves_one_episode(monkeypatch: pytest.MonkeyPatch):
    made: list[str] = []

    def note(name: str, env: Any, rng: np.random.Generator) -> Any:
        made.append(name)
        return make_driver(name, env, rng)

    monkeypatch.setattr("agents.vec_envs.make_driver", note)
    env = DrivenEnv(make_multiagent_env(TAG), "random", ["adversary_0"])
    for episode in range(2):
        seen, _ = env.reset(seed=episode)
        assert [set(env.drive_others(seen)) for _ in range(2)] == [{"adversary_1", "adversary_2", "agent_0"}] * 2
    assert made == ["random"] * 2 and env.episodes == 2


def test_drivers_by_name_see_no_forecasts(monkeypatch: pytest.MonkeyPatch):
    seen: list[Any] = []
    monkeypatch.setattr("agents.vec_envs.make_driver", lambda *_: lambda others: seen.append(others) or {})
    env = DrivenEnv(make_multiagent_env(TAG), "random", ["cat"])
    env.reset(seed=0)
    drive(env, {"ant": {"observation": 1, "forecast": 2}, "bee": 3, "cat": 4}, np.random.default_rng())
    assert seen == [{"ant": 1, "bee": 3}]


def test_where_all_learn_the_driver_need_not_be_able_to_drive():
    venv = make_multiagent_venv(Task(TOY, "none", driver="heuristic"), 1)
    venv.reset()
    assert venv.step(np.array([1, 0]))[1].tolist() == [1.0, 0.0]
    venv = make_multiagent_venv(Task(TOY, "none", learners=("ant",), driver="heuristic"), 1)
    venv.reset()
    with pytest.raises(UserError, match="no heuristic drives meadow_v0"):
        venv.step(np.array([1]))


# --- Arena ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("observe", ["none", "constant-velocity"])
def test_results_depend_on_the_seed_alone(observe: Any):
    task = Task(TAG, observe, learners=("adversary",), driver="varied")
    model, arena = policy_for(task), MultiagentArena(task)
    for policy in (model, *arena.baselines):
        results = arena.play(policy, [3, 4])
        assert facts(arena.play(policy, [4, 3])) == facts(results)[::-1]
        assert [r.seed for r in results] == [3, 4]
        assert facts(results)[0][1:] != facts(results)[1][1:] or policy is model
    assert facts(MultiagentArena(task).play(model, [4])) == facts(arena.play(model, [4]))


@pytest.mark.slow
@pytest.mark.parametrize("observe", ["none", "constant-velocity"])
def test_copies_side_by_side_play_as_one_after_the_other(observe: Any):
    """With fewer seeds than copies in the last turn, and in an arena that has played before."""
    task = Task(TAG, observe, learners=("adversary",), driver="varied")
    model, together, calls = policy_for(task), MultiagentArena(task, most_copies=3), list[None]()
    together.play(model, [9])
    results = together.play(model, range(3, 8), lambda: calls.append(None))
    assert facts(results) == facts(MultiagentArena(task, most_copies=1).play(model, range(3, 8)))
    assert len({r.episode_return for r in results}) > 1 and len(calls) == 5
    together.close()


class Lengths(ParallelEnv):
    """Pays 1 per step, for as many steps as the seed says."""

    metadata: ClassVar = {"name": "lengths", "render_modes": []}
    render_mode = None
    possible_agents: ClassVar = ["a_0", "a_1"]

    def observation_space(self, agent: str) -> gym.Space:
        return gym.spaces.Box(-1, 1, (2,), np.float32)

    def action_space(self, agent: str) -> gym.Space:
        return gym.spaces.Discrete(2)

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.agents, self.left = list(self.possible_agents), int(np.random.default_rng(seed).integers(2, 7))
        return {agent: np.zeros(2, np.float32) for agent in self.agents}, {agent: {} for agent in self.agents}

    def step(self, actions: Any) -> Any:
        self.left -= 1
        each, ended = list(self.agents), self.left == 0
        self.agents = [] if ended else each
        seen, rewards = {agent: np.zeros(2, np.float32) for agent in each}, dict.fromkeys(each, 1.0)
        return seen, rewards, dict.fromkeys(each, ended), dict.fromkeys(each, False), {agent: {} for agent in each}


def test_a_copy_that_is_done_earns_nothing_of_its_next_episode():
    task = Task(f"{__name__}:Lengths", "none")
    model = policy_for(task)
    together, alone = (MultiagentArena(task, most_copies=copies).play(model, range(5)) for copies in (3, 1))
    assert facts(together) == facts(alone) and len({r.length for r in alone}) > 1
    assert all(r.episode_return == r.length for r in together)


def test_a_policy_is_played_as_in_a_plain_loop():
    task = Task(SPREAD, "none")
    model = policy_for(task)
    env = make_multiagent_env(SPREAD)
    expected, acted = [], set()
    for seed in (1, 2):
        observations, _ = env.reset(seed=seed)
        total = 0.0
        while env.agents:
            actions = {a: int(model.predict(seen, deterministic=True)[0]) for a, seen in observations.items()}
            acted |= set(actions.values())
            observations, rewards, *_ = env.step(actions)
            total += sum(rewards.values()) / 3
        expected.append(total)
    results = MultiagentArena(task).play(model, [1, 2])
    assert len(acted) > 1
    assert [r.episode_return for r in results] == pytest.approx(expected, rel=1e-5)
    assert [(r.length, r.crashed) for r in results] == [(25, None)] * 2


@pytest.mark.parametrize("name", ["random", "heuristic"])
def test_a_driver_is_played_as_in_a_plain_loop(name: str):
    env = make_multiagent_env(SPREAD)
    observations, _ = env.reset(seed=6)
    driver = make_driver(name, env, driver_rng(6, group=1))
    total = 0.0
    while env.agents:
        observations, rewards, *_ = env.step(driver(observations))
        total += sum(rewards.values()) / 3
    (result,) = MultiagentArena(Task(SPREAD, "constant-velocity")).play(name, [6])
    assert result.episode_return == pytest.approx(total)


def test_returns_by_role_where_there_are_several():
    arena = MultiagentArena(Task(TAG, "none"))
    (result,) = arena.play("heuristic", [0])
    roles = result.returns_by_role
    assert set(roles) == {"adversary", "agent"}
    assert roles["adversary"] > roles["agent"]  # a catch pays the one and costs the other
    assert result.episode_return == pytest.approx((3 * roles["adversary"] + roles["agent"]) / 4)
    (alone,) = MultiagentArena(Task(TAG, "none", learners=("adversary",))).play("random", [0])
    assert alone.returns_by_role == {}


def test_baselines_can_drive():
    assert MultiagentArena(Task(SPREAD, "none")).baselines == ("random", "heuristic")
    arena = MultiagentArena(Task(TOY, "none"))
    assert arena.baselines == ("random", "idle")
    (result,) = arena.play("idle", [0])
    assert (result.episode_return, result.length) == (0.0, LIVES["bee_0"])


@pytest.mark.parametrize("learner", list(LIVES))
def test_an_episode_ends_with_the_last_learner_whoever_drives(learner: str):
    task = Task(TOY, "none", learners=(learner,), driver="random")
    arena = MultiagentArena(task)
    for policy in (policy_for(task), "random"):
        assert [r.length for r in arena.play(policy, [0, 1])] == [LIVES[learner]] * 2


def test_progress_is_reported_per_episode():
    calls: list[None] = []
    MultiagentArena(Task(TOY, "none")).play("random", range(4), lambda: calls.append(None))
    assert len(calls) == 4
