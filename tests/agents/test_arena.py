import json
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
from pettingzoo import ParallelEnv
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv

from agents import vec_envs
from agents.arena import Arena, EgoArena, MultiagentArena, _acting, open_arena, run_episodes
from agents.task import Observe, Task
from agents.vec_envs import SeededEpisodes, make_venv
from envs.drivers.trained import EgoDriver
from envs.registry import make_env
from envs.sb3.forecast import VecForecast
from predictor.support.errors import UserError
from tests.envs.helpers import HIGHWAY_SPEC, short_scene_env, tiny_model


def test_every_task_has_its_arena():
    for task, kind in ((Task("highway-fast-v0", "none"), EgoArena), (Task("simple_tag_v3", "none"), MultiagentArena)):
        arena = open_arena(task, 1)
        assert isinstance(arena, kind)
        assert isinstance(arena, Arena)
        arena.close()


def test_policies_of_envpool_are_measured_on_the_original(monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("envpool")
    asked: list[tuple[Task, int, bool]] = []

    def note(task: Task, num_envs: int, seeded: bool, in_process: bool) -> Any:
        asked.append((task, num_envs, seeded))
        return make_venv(task, num_envs, seeded)

    monkeypatch.setattr("agents.arena.make_venv", note)
    arena = open_arena(Task("highway-fast-v0", "none", backend="envpool"), 1)
    assert asked == [(Task("highway-fast-v0", "none"), 1, True)]
    arena.close()


class GoesOnPaying(ParallelEnv):
    """Pays each agent 1 per step, also those that have ended: "a_0" at step 2, "a_1" at step 10."""

    metadata: ClassVar = {"name": "pays", "render_modes": []}
    render_mode = None
    possible_agents: ClassVar = ["a_0", "a_1"]

    def observation_space(self, agent: str) -> gym.Space:
        return gym.spaces.Box(-1, 1, (3,), np.float32)

    def action_space(self, agent: str) -> gym.Space:
        return gym.spaces.Discrete(2)

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.agents, self.t = list(self.possible_agents), 0
        return {agent: np.zeros(3, np.float32) for agent in self.agents}, {agent: {} for agent in self.agents}

    def step(self, actions: Any) -> Any:
        self.t += 1
        ended = {"a_0": self.t >= 2, "a_1": self.t >= 10}
        each = self.possible_agents
        seen, rewards = {agent: np.zeros(3, np.float32) for agent in each}, dict.fromkeys(each, 1.0)
        return seen, rewards, ended, dict.fromkeys(each, False), {agent: {} for agent in each}


def parallel_env(**kwargs: Any) -> ParallelEnv:
    return GoesOnPaying(**kwargs)


def test_drivers_get_no_reward_of_agents_that_have_ended():
    """As policies, which are played by other code."""
    task = Task(f"{__name__}:GoesOnPaying", "none")
    arena = open_arena(task, 1)
    model = PPO("MlpPolicy", make_venv(task, 1), n_steps=4, batch_size=4)
    for policy in (model, "random", "idle"):
        (result,) = arena.play(policy, [5])
        assert (result.episode_return, result.length) == ((2 + 10) / 2, 10), policy
    arena.close()


class RefusesTheDead(GoesOnPaying):
    """Keeps the agents that live alone, and takes no action of another one."""

    def step(self, actions: Any) -> Any:
        dead = set(actions) - set(self.agents)
        if dead:
            raise KeyError(f"action for dead {sorted(dead)}")
        found = super().step(actions)
        self.agents = [agent for agent in self.agents if not found[2][agent]]
        return found


def test_a_driver_of_ones_own_sees_agents_that_live_alone(monkeypatch: pytest.MonkeyPatch):
    """The last observation of one that has ended is still there in the step after."""
    monkeypatch.setattr("agents.arena.make_driver", lambda *_: lambda seen: dict.fromkeys(seen, 0))
    arena = open_arena(Task(f"{__name__}:RefusesTheDead", "none"), 1)
    (result,) = arena.play("own:module:name", [5])
    assert (result.episode_return, result.length) == ((2 + 10) / 2, 10)
    arena.close()


class ReusesItsInfo(gym.Env[np.ndarray, np.int64]):
    """Pays its action in each of three steps, and returns the same info each time."""

    observation_space = gym.spaces.Box(0, 9, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self) -> None:
        self.info: dict[str, Any] = {}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.time = 0
        return np.zeros(1, np.float32), self.info

    def step(self, action: Any) -> Any:
        self.time += 1
        return np.full(1, self.time, np.float32), float(action), False, self.time == 3, self.info


gym.register("ReusesItsInfo-v0", entry_point=ReusesItsInfo)


@pytest.mark.parametrize("num_envs", [1, 2])
def test_an_environment_that_reuses_its_info_gives_each_policy_its_own_results(num_envs: int):
    """The result of the policy before stood in the environment's own dict, and was taken for that of the next."""
    task = Task(f"{__name__}:ReusesItsInfo-v0", "none")
    arena, seeds = open_arena(task, num_envs, in_process=True), range(4)
    for action, expected in ((1, 3.0), (0, 0.0), (1, 3.0)):
        calls: list[None] = []
        results = arena.play(f"action-{action}", seeds, lambda calls=calls: calls.append(None))
        assert [(r.seed, r.episode_return, r.length) for r in results] == [(seed, expected, 3) for seed in seeds]
        assert len(calls) == 4
    arena.close()


@pytest.mark.parametrize("obeys", [True, False])
def test_a_driver_of_ones_own_sees_all_agents_and_moves_the_learners(obeys: bool, monkeypatch: pytest.MonkeyPatch):
    """Also where it gives an action for each agent that lives, as it is asked to."""
    seen: list[list[str]] = []

    def make(name: str, env: Any, rng: Any) -> Any:
        def act(observations: Any) -> Any:
            seen.append(list(observations))
            return {agent: 0 for agent in observations if obeys or agent != "agent_0"}

        return act

    moved: list[int] = []
    arena = open_arena(Task("simple_tag_v3", "none", learners=("adversary",), driver="heuristic"), 1)
    assert isinstance(arena, MultiagentArena)
    step = arena._env.step

    def spied(actions: Any) -> Any:
        moved.append(actions["agent_0"])
        return step(actions)

    monkeypatch.setattr("agents.arena.make_driver", make)
    monkeypatch.setattr(arena._env, "step", spied)
    arena.play("own:module:name", [5])
    assert seen[0] == ["adversary_0", "adversary_1", "adversary_2", "agent_0"]
    assert set(moved) != {0}  # the heuristic prey's own
    arena.close()


@pytest.mark.slow
def test_an_ego_is_played_as_in_a_plain_loop():
    arena = EgoArena(Task("highway-fast-v0", "none"), 1)
    env = make_env("highway-fast-v0")
    model = PPO("MlpPolicy", DummyVecEnv([lambda: make_env("highway-fast-v0")]), n_steps=4, batch_size=4, seed=1)
    obs, _ = env.reset(seed=11)
    rewards, crashed, ended = [], False, False
    while not ended:
        obs, reward, terminated, truncated, info = env.step(int(model.predict(obs, deterministic=True)[0]))
        rewards.append(reward)
        crashed |= info["crashed"]
        ended = terminated or truncated
    (result,) = arena.play(model, [11])
    assert (result.length, result.crashed) == (len(rewards), crashed)
    assert result.episode_return == pytest.approx(float(np.sum(rewards)))
    assert result.returns_by_role == {}
    arena.close()


@pytest.mark.slow
def test_random_and_idle_stand_beside_an_ego():
    arena = EgoArena(Task("highway-fast-v0", "none"), 1)
    random, idle = (arena.play(name, [2])[0] for name in arena.baselines)
    assert random.episode_return != idle.episode_return
    assert arena.play("random", [2]) == [random]
    arena.close()


def test_drivers_play_beside_every_option_of_forecasts():
    """The arena plays drivers without forecasts, whatever the policy of the task is shown."""
    task = Task("simple_tag_v3", checkpoint="constant-velocity", learners=("adversary",), perception_m=1.0)
    arena = MultiagentArena(task)
    (result,) = arena.play("random", [7])
    assert result.length == 25
    arena.close()


def test_drivers_play_beside_policies_with_sizes_of_another_checkpoint():
    """What has forecasts of other sizes in training is measured beside drivers that are shown none."""
    arena = open_arena(Task("simple_tag_v3", "zeros", sizes_of="simple-tag", learners=("adversary",)), 1)
    assert arena.play("random", [7])[0].length == 25
    arena.close()


@pytest.mark.parametrize("observe", ["none", "constant-velocity"])
def test_a_driver_sees_the_environments_own_observation(observe: Observe, monkeypatch: pytest.MonkeyPatch):
    """Whatever the policy beside it is shown."""
    seen: list[Any] = []

    def driver(name: str, env: gym.Env, rng: np.random.Generator) -> EgoDriver:
        return lambda observation: seen.append(observation) or 1

    monkeypatch.setattr(vec_envs, "make_ego_driver", driver)
    arena = EgoArena(Task("merge-v1", observe), 1)
    arena.play("idle", [2])
    arena.close()
    assert seen and all(isinstance(each, np.ndarray) and each.shape == (5, 5) for each in seen)


@pytest.mark.slow
def test_drawn_samples_depend_on_the_seed_of_the_episode_alone():
    """Neither on the number of environments nor on the episodes before."""

    def seen(seeds: list[int], num_envs: int) -> dict[int, Any]:
        envs = [lambda: SeededEpisodes(short_scene_env(3)) for _ in range(num_envs)]
        venv = VecForecast(DummyVecEnv(envs), tiny_model(HIGHWAY_SPEC), num_samples=3)
        of_env: list[list[Any]] = [[] for _ in range(num_envs)]

        def policy(observations: Any, starts: Any) -> Any:
            for env, (forecast, start) in enumerate(zip(observations["forecast"], starts, strict=True)):
                if start:
                    of_env[env].append([])
                of_env[env][-1].append(forecast)
            return np.ones(num_envs, dtype=np.int64)

        run_episodes(venv, policy, seeds)
        queues = [seeds[env::num_envs] for env in range(num_envs)]
        return {
            seed: np.array(own)
            for queue, episodes in zip(queues, of_env, strict=True)
            for seed, own in zip(queue, episodes, strict=False)
        }

    one, two, alone = seen([3, 4, 5], 1), seen([3, 4, 5], 2), seen([5], 1)
    for seed in one:
        np.testing.assert_allclose(one[seed], two[seed], atol=1e-4)
    np.testing.assert_allclose(one[5], alone[5], atol=1e-4)
    spread = one[5].std(axis=2)
    assert spread.max() > 1e-2, "samples are drawn"


@pytest.mark.parametrize(
    ("observe", "name", "config"),
    [
        ("none", "observation", {"observation": {"type": "Kinematics", "vehicles_count": 7}}),
        ("forecast", "observation 'observation'", {"observation": {"type": "Kinematics", "vehicles_count": 7}}),
        ("none", "action", {"action": {"type": "DiscreteMetaAction", "lateral": False}}),
    ],
)
def test_a_policy_of_other_observations_or_actions_is_refused_in_one_line(
    observe: Observe, name: str, config: dict[str, Any]
):
    trained, changed = (
        Task("highway-fast-v0", observe, env_kwargs=json.dumps({"config": given})) for given in ({}, config)
    )
    venv = make_venv(trained, 1)
    policy = PPO("MlpPolicy" if observe == "none" else "MultiInputPolicy", venv, n_steps=4, batch_size=4)
    venv.close()
    arena = open_arena(changed, 1)
    message = rf"^the policy was trained with the {name} (Box|Discrete)\(.*, got .*\("
    with pytest.raises(UserError, match=message) as error:
        arena.play(policy, [0])
    assert "\n" not in str(error.value)
    arena.close()


def test_the_number_of_values_of_each_action_must_be_that_of_the_training():
    venvs = []
    for counts in ([3, 4], [2, 2], [3, 4]):
        env: Any = gym.Env()
        env.observation_space, env.action_space = gym.spaces.Box(-1, 1, (2,)), gym.spaces.MultiDiscrete(counts)
        venvs.append(DummyVecEnv([lambda env=env: env]))
    policy = PPO("MlpPolicy", venvs[0], n_steps=4, batch_size=4)
    assert _acting(policy, venvs[2])
    with pytest.raises(
        UserError, match=r"trained with the action MultiDiscrete\(\[3 4\]\), got MultiDiscrete\(\[2 2\]"
    ):
        _acting(policy, venvs[1])


class _Film(gym.Env):
    """Shows noise for three steps."""

    observation_space = gym.spaces.Box(0, 255, (36, 40, 3), np.uint8)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._step = 0
        return self._frame(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._step += 1
        return self._frame(), 1.0, self._step == 3, False, {}

    def _frame(self) -> Any:
        return self.np_random.integers(0, 256, self.observation_space.shape, np.uint8)


def test_a_policy_that_sees_images_is_played(monkeypatch: pytest.MonkeyPatch):
    """Stable-Baselines3 moves the axes of an image's space."""
    gym.register("Film-v0", _Film)
    try:
        task = Task("Film-v0", "none")
        venv = make_venv(task, 1)
        policy = PPO("CnnPolicy", venv, n_steps=4, batch_size=4)
        venv.close()
        assert policy.observation_space.shape == (3, 36, 40)
        arena = open_arena(task, 1)
        assert [result.length for result in arena.play(policy, [0])] == [3]
        monkeypatch.setattr(_Film, "observation_space", gym.spaces.Box(0, 255, (40, 36, 3), np.uint8))
        other = open_arena(task, 1)
        with pytest.raises(UserError, match=r"\(3, 36, 40\).*got .*\(3, 40, 36\)"):
            other.play(policy, [0])
        other.close()
        arena.close()
    finally:
        del gym.registry["Film-v0"]


def test_random_stand_ins_of_learners_and_random_others_draw_independently(monkeypatch: pytest.MonkeyPatch):
    """The prey would do what the first predator does if both drew from one stream."""
    arena = open_arena(Task("simple_tag_v3", "none", learners=("adversary",), driver="random"), 1)
    assert isinstance(arena, MultiagentArena)
    moved: list[tuple[int, int]] = []
    step = arena._env.step

    def spied(actions: Any) -> Any:
        moved.append((int(actions["adversary_0"]), int(actions["agent_0"])))
        return step(actions)

    monkeypatch.setattr(arena._env, "step", spied)
    arena.play("random", range(8))
    assert any(learner != other for learner, other in moved[::25])  # the first step of each episode
    arena.close()
