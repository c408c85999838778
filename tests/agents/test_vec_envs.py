from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor

from agents import vec_envs
from agents.arena import MultiagentArena, run_episodes
from agents.task import Task
from agents.vec_envs import EPISODE_INFO, EpisodeResult, SeededEpisodes, make_venv
from envs import readers
from envs.drivers.ego import make_ego_driver
from envs.readers.function import FunctionReader
from envs.registry import make_env
from envs.rollouts.driving_measures import recorder_for
from envs.sb3 import envpool as envpool_module
from envs.seeding import driver_rng
from envs.supervision import EnvironmentFailedError
from envs.wrappers import SceneObservation
from predictor.scene import Scene, SceneSpec
from predictor.support.errors import UserError


class Dice(gym.Env[np.ndarray, np.int64]):
    """Length, speed and crash are functions of the seed; the reward is the action."""

    observation_space = gym.spaces.Box(0, 1, (1,), np.float32)
    action_space = gym.spaces.Discrete(3)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._left = int(self.np_random.integers(1, 8))
        self._crashes = bool(self.np_random.random() < 0.5)
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._left -= 1
        ended = self._left == 0
        info = {"speed": 10.0 + self._left, "crashed": ended and self._crashes}
        return np.zeros(1, np.float32), float(action), ended and self._crashes, ended and not self._crashes, info


class Silent(Dice):
    """Never reports whether the ego crashed."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, reward, terminated, truncated, {"speed": info["speed"]}


class Vectors(Dice):
    """Reports a speed that is no number of metres per second."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, reward, terminated, truncated, info | {"speed": None if self._left % 2 else np.ones(2)}


def test_what_is_no_speed_is_not_reported():
    env = SeededEpisodes(Vectors(), "crashed")
    env.queue([3])
    env.reset()
    info: dict[str, Any] = {}
    while EPISODE_INFO not in info:
        *_, info = env.step(1)
    assert np.isnan(info[EPISODE_INFO].mean_speed_mps)


def test_actions_that_are_no_driver_s_are_counted_by_their_number():
    env = SeededEpisodes(Dice(), "crashed")
    env.queue([3])
    env.reset()
    info: dict[str, Any] = {}
    while EPISODE_INFO not in info:
        *_, info = env.step(9)
    assert set(info[EPISODE_INFO].action_counts) == {"action-9"}


def test_an_episode_without_end_is_said(monkeypatch: pytest.MonkeyPatch):
    class Endless(Dice):
        def reset(self, **named: Any) -> tuple[Any, dict[str, Any]]:
            found = super().reset(**named)
            self._left = 0
            return found

    monkeypatch.setattr(vec_envs, "MOST_STEPS", 9)
    dice, endless = (DummyVecEnv([lambda made=made: SeededEpisodes(made(), "crashed")]) for made in (Dice, Endless))
    assert len(run_episodes(dice, "random", range(9))) == 9
    with pytest.raises(UserError, match="^env 'Endless': an episode has not ended after 9 steps; give the environment"):
        run_episodes(endless, "random", range(9))
    arena, tag = (
        MultiagentArena(Task("simple_tag_v3", "none", learners=("adversary",))),
        "simple_tag_v3: an episode has",
    )
    policy = PPO("MlpPolicy", arena._copies(1), n_steps=2, batch_size=2)
    monkeypatch.setattr(vec_envs, "MOST_STEPS", 25)
    for drives in ("idle", policy):
        assert arena.play(drives, [0])[0].length == 25
    monkeypatch.setattr(vec_envs, "MOST_STEPS", 24)
    for drives in ("idle", policy):
        with pytest.raises(UserError, match=f"^{tag} not ended after 24 steps; give the environment a limit, in gymn"):
            arena.play(drives, [0])
    arena.close()


def dice_venv(num_envs: int) -> VecEnv:
    return VecMonitor(DummyVecEnv([lambda: SeededEpisodes(Dice(), "crashed")] * num_envs))


def always_two(obs: np.ndarray, starts: np.ndarray) -> np.ndarray:
    return np.full(len(obs), 2)


def expected(seed: int) -> EpisodeResult:
    env = Dice()
    env.reset(seed=seed)
    length, crashes = env._left, env._crashes
    speeds = [10.0 + left for left in range(length)]
    return EpisodeResult(seed, 2.0 * length, length, crashes, float(np.mean(speeds)), {}, {"action-2": length})


@pytest.mark.parametrize("num_envs", [1, 2, 5, 9])
def test_every_seed_is_played_once_for_any_number_of_environments(num_envs: int):
    seeds = range(100, 107)
    assert run_episodes(dice_venv(num_envs), always_two, seeds) == [expected(seed) for seed in seeds]


@pytest.mark.parametrize("num_envs", [1, 2])
def test_no_episode_is_played_without_a_seed(num_envs: int):
    class Seeded(Dice):
        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            assert seed is not None
            return super().reset(seed=seed, options=options)

    venv = VecMonitor(DummyVecEnv([lambda: SeededEpisodes(Seeded(), "crashed")] * num_envs))
    seeds = range(100, 107)
    assert run_episodes(venv, always_two, seeds) == [expected(seed) for seed in seeds]


def test_no_plans_are_made_for_a_driver_by_name(monkeypatch: pytest.MonkeyPatch):
    made = []
    original = SceneObservation.make_plans
    monkeypatch.setattr(SceneObservation, "make_plans", lambda *a: made.append(1) or original(*a))
    task = Task("highway-fast-v0", what_if=True, env_kwargs='{"config": {"duration": 2}}')
    venv = make_venv(task, 1, seeded=True, in_process=True)
    run_episodes(venv, "slower", [1])
    assert not made
    run_episodes(venv, lambda obs, starts: np.ones(len(obs["valid"]), dtype=np.int64), [1])
    assert len(made) == 3 + 1, "the opening one, two steps, and the opening one of the repeated episode"
    venv.close()


def test_a_crash_flag_that_is_never_reported_is_unknown():
    venv = VecMonitor(DummyVecEnv([lambda: SeededEpisodes(Silent(), "crashed")]))
    assert [e.crashed for e in run_episodes(venv, always_two, range(4))] == [None] * 4
    assert {e.crashed for e in run_episodes(dice_venv(1), always_two, range(8))} == {False, True}


class Reporting(Dice):
    """Reports success in every step, although half of its episodes crash."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, reward, terminated, truncated, info | {"is_success": self._left == 0}


def test_success_is_that_of_the_last_step_and_not_with_a_crash():
    venv = VecMonitor(DummyVecEnv([lambda: SeededEpisodes(Reporting(), "crashed")]))
    found = run_episodes(venv, always_two, range(8))
    assert {(e.success, e.crashed) for e in found} == {(True, False), (False, True)}
    assert {e.success for e in run_episodes(dice_venv(1), always_two, range(8))} == {None}


def test_crashes_of_an_environment_that_names_no_key_are_not_guessed():
    """It may report collisions elsewhere, and "crashed" may be something else."""
    venv = VecMonitor(DummyVecEnv([lambda: SeededEpisodes(Dice())]))
    assert {e.crashed for e in run_episodes(venv, always_two, range(8))} == {None}


@pytest.mark.slow
def test_driving_is_measured_in_the_episode_that_is_played():
    """The result has the measures of a plain loop over the same episode."""
    env = make_env("highway-fast-v0")
    recorder = recorder_for(env)
    assert recorder is not None
    env.reset(seed=3)
    recorder.begin()
    ended = False
    while not ended:
        _, _, terminated, truncated, _ = env.step(3)
        recorder.note()
        ended = terminated or truncated
    venv = make_venv(Task("highway-fast-v0", "none"), 1, seeded=True)
    (again, other) = run_episodes(venv, "faster", [4, 3])
    assert other.driving == recorder.measures() != again.driving
    assert other.length == other.driving.time_s
    venv.close()


def test_second_evaluation_starts_afresh():
    venv = dice_venv(2)
    first = run_episodes(venv, always_two, range(5))
    assert run_episodes(venv, "random", range(3)) != first[:3]
    assert run_episodes(venv, always_two, range(5)) == first


@pytest.mark.parametrize("num_envs", [1, 3])
def test_random_ego_depends_on_the_seed_alone(num_envs: int):
    assert run_episodes(dice_venv(num_envs), "random", range(6)) == run_episodes(dice_venv(2), "random", range(6))


def test_idle_ego_ignores_the_actions_that_arrive():
    assert all(e.episode_return == 0 for e in run_episodes(dice_venv(2), "idle", range(4)))


def test_what_a_driver_raises_is_told_with_its_place(monkeypatch: pytest.MonkeyPatch):
    """As by environments in processes of their own."""
    monkeypatch.setattr("agents.vec_envs.make_ego_driver", lambda *_: lambda seen: {}["lane"])
    with pytest.raises(EnvironmentFailedError, match="Dice, seed 5, step 1: KeyError: 'lane'"):
        run_episodes(VecMonitor(DummyVecEnv([lambda: SeededEpisodes(Dice())])), "idle", [5])


def test_one_action_in_every_step_is_a_driver_and_every_step_is_counted():
    assert run_episodes(dice_venv(2), "action-2", range(4)) == [expected(seed) for seed in range(4)]
    for episode in run_episodes(dice_venv(2), "random", range(20)):  # each reward is the number of the action
        counts = {int(name.removeprefix("action-")): count for name, count in episode.action_counts.items()}
        assert sum(counts.values()) == episode.length
        assert sum(number * count for number, count in counts.items()) == episode.episode_return


def test_continuous_actions_are_not_counted():
    class Plain(Dice):
        action_space = gym.spaces.Box(-1, 1, (), np.float32)

    venv = VecMonitor(DummyVecEnv([lambda: SeededEpisodes(Plain())]))
    assert [e.action_counts for e in run_episodes(venv, "idle", range(2))] == [{}, {}]


def test_progress_is_reported_per_episode():
    calls: list[None] = []
    run_episodes(dice_venv(2), always_two, range(5), lambda: calls.append(None))
    assert len(calls) == 5


def test_unknown_env_is_one_clear_line():
    with pytest.raises(UserError, match="cannot make env 'highway-fats-v0'"):
        Task("highway-fats-v0", "none").check()


def test_missing_checkpoint_is_one_clear_line():
    with pytest.raises(UserError, match="no checkpoint 'nowhere'"):
        Task("highway-fast-v0", "forecast", "nowhere").check()


def test_checkpoint_without_forecast_is_refused():
    with pytest.raises(UserError, match="has no effect with observe=none"):
        Task("highway-fast-v0", "none", "highway")


def test_environments_observe_what_the_task_says():
    own = make_venv(Task("highway-fast-v0", "none"), 1)
    assert isinstance(own.observation_space, gym.spaces.Box)
    own.close()
    forecast = make_venv(Task("highway-fast-v0", "constant-velocity"), 1)
    assert isinstance(forecast.observation_space, gym.spaces.Dict)
    assert {"observation", "agents", "forecast", "valid"} <= set(forecast.observation_space)
    forecast.close()


@pytest.mark.parametrize(("in_process", "threads"), [(True, 1), (None, 0)])
def test_where_a_process_is_to_have_one_thread_envpool_takes_one(
    monkeypatch: pytest.MonkeyPatch, in_process: bool | None, threads: int
):
    """Else every cell of a study had as many as the machine has cores."""
    pytest.importorskip("envpool")
    asked, made = list[int](), envpool_module.make_pool
    monkeypatch.setattr(envpool_module, "make_pool", lambda *a, **k: asked.append(a[2]) or made(*a, **k))
    make_venv(Task("highway-fast-v0", "none", backend="envpool"), 3, in_process=in_process).close()
    assert asked == [threads]


def test_envpool_environments_observe_what_gymnasium_environments_do():
    pytest.importorskip("envpool")
    for observe in ("none", "constant-velocity"):
        envpool = make_venv(Task("highway-fast-v0", observe, backend="envpool"), 3)
        plain = make_venv(Task("highway-fast-v0", observe), 1)
        assert envpool.num_envs == 3
        assert envpool.get_attr("task_id") == ["HighwayFast-v0"] * 3
        assert envpool.observation_space == plain.observation_space
        assert envpool.action_space == plain.action_space
        envpool.close()
        plain.close()


def test_learners_of_a_multiagent_env_are_environments():
    venv = make_venv(Task("simple_tag_v3", "none", learners=("adversary",)), 2)
    assert venv.num_envs == 6
    venv.close()


class CountingAlone(gym.Env[np.ndarray, np.int64]):
    """One ego that sees the number of the step, in an array that every step and reset writes into."""

    observation_space = gym.spaces.Box(-9, 9, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self) -> None:
        self._array = np.zeros(1, np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self._array[:] = 0
        return self._array, {}

    def step(self, action: Any) -> Any:
        self._array += 1
        return self._array, 1.0, False, bool(self._array[0] == 3), {}


gym.register("CountingAlone-v0", entry_point=CountingAlone)


@pytest.mark.parametrize("copies", [1, 2])
@pytest.mark.parametrize("observe", ["none", "constant-velocity"])
def test_a_reset_does_not_change_the_last_observation(observe: Any, copies: int, monkeypatch: pytest.MonkeyPatch):
    """From it the value of a truncated episode is bootstrapped."""
    scene = Scene(np.zeros((1, 4)), np.zeros(1, int), np.ones(1, bool))
    reader = FunctionReader(lambda env: scene, SceneSpec(dt_s=1.0, max_agents=2))
    monkeypatch.setitem(readers._REGISTERED, CountingAlone, reader)
    venv = make_venv(Task(f"{__name__}:CountingAlone-v0", observe), copies, in_process=True)
    venv.reset()
    for _ in range(3):
        _, _, dones, infos = venv.step(np.zeros(copies, int))
    assert dones.all()
    for info in infos:
        closing = info["terminal_observation"]
        assert (closing["observation"] if isinstance(closing, dict) else closing).tolist() == [3.0]
    venv.close()


def test_the_random_driver_draws_from_the_seed_of_its_episode():
    """With one seed for all, fifty episodes would be one."""
    returns = []
    for seed in range(3, 9):
        env = Dice()
        env.reset(seed=seed)
        driver = make_ego_driver("random", env, driver_rng(seed))
        returns.append(float(sum(int(driver(None)) for _ in range(env._left))))
        assert run_episodes(dice_venv(1), "random", [seed])[0].episode_return == returns[-1]
    assert len(set(returns)) > 2
