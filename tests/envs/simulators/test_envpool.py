import subprocess
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env as check_env_for_sb3
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

pytest.importorskip("envpool")

from envs.drivers.ego import idle_action  # noqa: E402
from envs.observation import SCENE_KEYS  # noqa: E402
from envs.sb3.envpool import EnvPoolVecEnv  # noqa: E402
from envs.sb3.forecast import VecForecast  # noqa: E402
from envs.simulators.envpool import (  # noqa: E402
    ENV_IDS,
    HIGHWAY_ENV_OF,
    EnvPoolEnv,
    begins_alike,
    known_tasks,
    make_pool,
    register_envpool_ids,
)
from envs.simulators.envpool import is_terminated as _ends
from envs.wrappers import ForecastObservation, SceneObservation  # noqa: E402
from predictor.support.errors import ProtocolError, UserError  # noqa: E402
from tests.envs.helpers import MAX_AGENTS, PERCEPTION_M, assert_same, play, random_actions  # noqa: E402

ROOT = Path(__file__).parents[3]
SEED = 20
ENVS = 3
STEPS = 12
SMALL = {"vehicles_count": 8, "duration": 5}
"""Short episodes on a road with few vehicles: environments crash or run out of time, at different steps."""
ACTIONS = np.random.default_rng(3).integers(5, size=(STEPS, ENVS))

CHECKER_WARNINGS = (
    r"ignore:.*is different from the unwrapped version:UserWarning",
    r"ignore:.*A Box observation space (minimum|maximum) value is (-?)infinity:UserWarning",
    r"ignore:It seems that your observation .*is an image:UserWarning",
    r"ignore:The minimal resolution for an image:UserWarning",
    r"ignore:Your observation .*has an unconventional shape:UserWarning",
)


OUTDATED = "ignore:.*is out of date"
"""EnvPool has newer versions of some tasks from 1.2.7 on, and gymnasium recommends them."""


def ignore_checker_warnings(test: Any) -> Any:
    for line in CHECKER_WARNINGS:
        test = pytest.mark.filterwarnings(line)(test)
    return test


def small_pool(**kwargs: Any) -> EnvPoolVecEnv:
    usual = {"num_threads": 1, "perception_m": PERCEPTION_M, "max_agents": MAX_AGENTS, **SMALL}
    return EnvPoolVecEnv("HighwayFast-v0", ENVS, seed=SEED, **(usual | kwargs))


def small_env(scenes: bool = True) -> gym.Env:
    register_envpool_ids()
    env = gym.make("envpool/HighwayFast-v0", disable_env_checker=True, **SMALL)
    return SceneObservation(env, PERCEPTION_M, MAX_AGENTS) if scenes else env


def one_of(observations: Any, index: int) -> Any:
    return {key: value[index] for key, value in observations.items()}


# --- One environment --------------------------------------------------------------------------------------------------


@ignore_checker_warnings
@pytest.mark.filterwarnings(OUTDATED)
@pytest.mark.parametrize("env_id", [env_id for env_id, task in ENV_IDS.items() if task in known_tasks()])
def test_gymnasium_accepts(env_id: str):
    register_envpool_ids()
    check_env(gym.make(env_id), skip_render_check=True)


@ignore_checker_warnings
@pytest.mark.filterwarnings(OUTDATED)
@pytest.mark.parametrize("env_id", ["envpool/HighwayFast-v0", "envpool/Intersection-v0", "envpool/Racetrack-v0"])
def test_sb3_accepts(env_id: str):
    register_envpool_ids()
    check_env_for_sb3(SceneObservation(gym.make(env_id)))


def test_every_task_has_one_id():
    assert sorted(ENV_IDS.values()) == sorted(HIGHWAY_ENV_OF)


def test_what_only_a_later_release_has_is_refused_in_one_line(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("envs.simulators.envpool.envpool_release", lambda: (1, 2, 5))
    with pytest.raises(UserError, match=r"EnvPool 1\.2\.\d+ has no Merge-v1; install 1\.2\.7 or later"):
        make_pool("Merge-v1", [0])
    with pytest.raises(UserError, match="no EnvPool task 'Merge-v9' is known here; known: Highway-v0, HighwayFast"):
        make_pool("Merge-v9", [0])
    assert begins_alike("Exit-v0") and not begins_alike("HighwayFast-v0")
    monkeypatch.setattr("envs.simulators.envpool.envpool_release", lambda: (1, 2, 7))
    assert not begins_alike("Exit-v0")


def test_ids_are_declared_without_envpool():
    """Declaring twice is fine, importing nothing; making one says what to install."""
    code = """
import sys
sys.modules["envpool"] = None  # importing it raises ImportError
from envs.simulators.envpool import ENV_IDS, register_envpool_ids
register_envpool_ids()
register_envpool_ids()
import gymnasium as gym
assert "envpool/HighwayFast-v0" in gym.registry
try:
    gym.make("envpool/HighwayFast-v0")
except ValueError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "need the envpool package" in done.stdout and "pip install 'dgvae-rl[envpool]'" in done.stdout


@pytest.mark.filterwarnings(OUTDATED)
@pytest.mark.parametrize("env_id", ["envpool/HighwayFast-v0", "envpool/Merge-v0"])
def test_a_seed_is_an_episode(env_id: str):
    register_envpool_ids()
    env = gym.make(env_id)
    actions = random_actions(env, 4)
    first, again, other = play(env, actions, 7), play(env, actions, 7), play(env, actions, 8)
    for (obs, *rest), (expected, *expected_rest) in zip(again, first, strict=True):
        np.testing.assert_array_equal(obs, expected)
        assert rest == expected_rest
    assert (other[0][0] != first[0][0]).any()


def test_without_a_seed_the_next_episode_follows():
    """Reset by reset, two environments of one seed stay together, and no episode is like the last."""
    first, second = (EnvPoolEnv("HighwayFast-v0") for _ in range(2))
    episodes = [[env.reset(seed=3)[0], env.reset()[0], env.reset()[0]] for env in (first, second)]
    np.testing.assert_array_equal(episodes[0], episodes[1])
    assert (episodes[0][0] != episodes[0][1]).any() and (episodes[0][1] != episodes[0][2]).any()


def test_environments_without_a_seed_differ():
    first, second = (EnvPoolEnv("HighwayFast-v0").reset()[0] for _ in range(2))
    assert (first != second).any()


def test_large_seeds_are_taken():
    env = EnvPoolEnv("HighwayFast-v0")
    assert (env.reset(seed=2**32 - 1)[0] != env.reset(seed=2**31 - 2)[0]).any()


def test_time_ends_an_episode_by_truncation():
    env = EnvPoolEnv("HighwayFast-v0", duration=2, vehicles_count=0)
    env.reset(seed=0)
    assert env.step(1)[2:4] == (False, False)
    assert env.step(1)[2:4] == (False, True)


def test_a_crash_is_a_termination():
    """At full speed behind traffic, every environment hits an agent before the time is over."""
    env = EnvPoolEnv("HighwayFast-v0")
    for seed in range(3):
        env.reset(seed=seed)
        for _ in range(30):
            _, _, terminated, truncated, info = env.step(3)
            assert terminated == info["crashed"]
            if terminated or truncated:
                break
        assert terminated and not truncated and set(info) == {"speed", "crashed"}


def test_a_crash_in_the_last_step_is_both():
    """EnvPool calls it a truncation only; highway-env, whose flags these are, says both."""
    terminated, truncated, crashed = (
        np.array(flags, dtype=np.bool_) for flags in ([1, 0, 0, 0], [0, 1, 1, 0], [1, 1, 0, 0])
    )
    assert _ends(terminated, truncated, crashed).tolist() == [True, True, False, False]


@pytest.mark.parametrize("task_id", ["HighwayFast-v0", "Intersection-v0"])
def test_the_idle_ego_idles(task_id: str):
    """Neither a change of lane (highway's action 0) nor braking (the intersection's)."""
    env = EnvPoolEnv(task_id)
    action = idle_action(env)
    env.reset(seed=0)
    before = env.debug_states()[0].vehicles[0]
    env.step(action)
    after = env.debug_states()[0].vehicles[0]
    assert after.target_lane_index == before.target_lane_index
    assert after.target_speed == before.target_speed


def test_images_are_drawn_on_request():
    env = EnvPoolEnv("HighwayFast-v0", render_mode="rgb_array")
    env.reset(seed=0)
    image = env.render()
    assert image.shape == (150, 600, 3) and image.dtype == np.uint8 and image.std() > 0
    assert EnvPoolEnv("HighwayFast-v0").render() is None


def test_forecasts_wrap_it(highway_checkpoint: str):
    env = ForecastObservation(small_env(), highway_checkpoint)
    steps = play(env, [1, 1, 1], seed=0)
    assert all(obs in env.observation_space for obs, *_ in steps)
    assert (steps[-1][0]["valid"].sum() > 0) and env.scene.ids[0] == 0


# --- Many environments ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scenes", [True, False])
def test_envs_of_a_pool_are_single_environments(scenes: bool):
    """Observations, closing observations, rewards, ends and infos of SB3 over single environments, bit for bit."""
    pool, single = small_pool(scenes=scenes), DummyVecEnv([partial(small_env, scenes)] * ENVS)
    single.seed(SEED)
    assert pool.observation_space == single.observation_space and pool.action_space == single.action_space
    assert_same(pool.reset(), single.reset(), tolerance=0.0)
    ended: list[tuple[int, int]] = []
    for t in range(STEPS):
        obs, rewards, dones, infos = pool.step(ACTIONS[t])
        expected, expected_rewards, expected_dones, expected_infos = single.step(ACTIONS[t])
        assert_same(obs, expected, tolerance=0.0)
        np.testing.assert_array_equal(rewards, expected_rewards)
        assert dones.tolist() == expected_dones.tolist()
        for index in range(ENVS):
            closing, expected_closing = (i[index].pop("terminal_observation", None) for i in (infos, expected_infos))
            assert infos[index] == expected_infos[index]
            assert (closing is None) == (expected_closing is None) == (not dones[index])
            if closing is not None:
                assert_same(closing, expected_closing, tolerance=0.0)
                assert pool.reset_infos[index] == single.reset_infos[index]
                ended.append((t, index))
    assert len(ended) > ENVS and len({t for t, _ in ended}) > 2  # environments end at different steps, more than once


@pytest.mark.parametrize("task_id", known_tasks())
def test_observations_lie_in_the_space(task_id: str):
    pool = EnvPoolVecEnv(task_id, 2, seed=0, num_threads=1)
    pool.action_space.seed(0)
    observations: list[Any] = [pool.reset()]
    for _ in range(12):
        obs, _, _, infos = pool.step(np.array([pool.action_space.sample() for _ in range(2)]))
        observations += [
            obs,
            *({k: v[None] for k, v in i["terminal_observation"].items()} for i in infos if len(i) > 3),
        ]
    assert all(one_of(o, i) in pool.observation_space for o in observations for i in range(len(o["scene_ids"])))


def test_an_ended_env_closes_with_the_old_scene_and_opens_with_a_new_one():
    pool, idle = small_pool(vehicles_count=30, perception_m=1000.0, max_agents=40), np.ones(ENVS, dtype=np.int64)
    obs: Any = pool.reset()
    for _ in range(5):
        last = obs
        obs, _, dones, infos = pool.step(idle)
        if dones.any():
            break
    assert dones.any()
    for index in np.flatnonzero(dones):
        closing, opening = infos[index]["terminal_observation"], one_of(obs, index)
        assert sorted(opening["scene_ids"][opening["scene_valid"] == 1]) == list(range(31))
        moved_m = closing["scene_states"][0, 0] - last["scene_states"][index, 0, 0]
        assert 0 < moved_m < 40  # the ego, one step on
        assert opening["scene_states"][0, 0] < closing["scene_states"][0, 0] - 20  # back at the start of a road
        assert set(closing["scene_ids"]) <= set(range(31)) | {-1}


def play_alone(index: int, checkpoint: str) -> list[tuple[Any, Any]]:
    """What each step leads to, and what closes the episode where it ends."""
    env = ForecastObservation(small_env(), checkpoint)
    steps: list[tuple[Any, Any]] = [(env.reset(seed=SEED + index)[0], None)]
    for t in range(STEPS):
        obs, _, terminated, truncated, _ = env.step(int(ACTIONS[t, index]))
        steps.append((env.reset()[0], obs) if terminated or truncated else (obs, None))
    return steps


def test_forecasts_are_those_of_single_environments(highway_checkpoint: str):
    """Over several episodes: memory follows each environment's own boundaries, and identities are the same."""
    venv = VecForecast(VecMonitor(small_pool()), highway_checkpoint)
    alone = [play_alone(index, highway_checkpoint) for index in range(ENVS)]
    obs: Any = venv.reset()
    infos: list[Any] = []
    closings = 0
    for t in range(STEPS + 1):
        for index in range(ENVS):
            expected, closing = alone[index][t]
            assert_same(one_of(obs, index), expected)
            if closing is not None:
                assert_same(infos[index]["terminal_observation"], closing)
                closings += 1
        if t < STEPS:
            obs, _, _, infos = venv.step(ACTIONS[t])
    assert closings > ENVS


def test_monitored_episodes_add_up():
    venv = VecMonitor(small_pool())
    venv.reset()
    returns, lengths, episodes = np.zeros(ENVS), np.zeros(ENVS), 0
    for t in range(STEPS):
        _, rewards, dones, infos = venv.step(ACTIONS[t])
        returns, lengths = returns + rewards, lengths + 1
        for index in np.flatnonzero(dones):
            assert infos[index]["episode"]["r"] == pytest.approx(returns[index], rel=1e-5)
            assert infos[index]["episode"]["l"] == lengths[index]
            returns[index] = lengths[index] = 0
            episodes += 1
    assert episodes > ENVS


@pytest.mark.parametrize("scenes", [True, False])
def test_ppo_learns_on_it(scenes: bool, highway_checkpoint: str):
    venv: Any = small_pool(scenes=scenes)
    if scenes:
        venv = VecForecast(VecMonitor(venv), highway_checkpoint)
    policy = "MultiInputPolicy" if scenes else "MlpPolicy"
    model = PPO(
        policy, venv, n_steps=8, batch_size=8, n_epochs=1, policy_kwargs={"net_arch": [8]}, device="cpu", seed=0
    )
    before = model.policy.action_net.weight.detach().clone()
    model.learn(24)
    assert model.num_timesteps == 24
    assert (model.policy.action_net.weight != before).any()


def sequence(venv: EnvPoolVecEnv, seed: int | None = None) -> list[Any]:
    if seed is not None:
        venv.seed(seed)
    return [venv.reset(), *(venv.step(actions)[0] for actions in ACTIONS)]


def test_seeding_repeats_the_sequence():
    first, reseeded, other = sequence(small_pool()), sequence(small_pool(), SEED), sequence(small_pool(), SEED + 1)
    venv = small_pool()
    sequence(venv)
    again = sequence(venv, SEED)
    for obs, expected, repeated in zip(first, reseeded, again, strict=True):
        assert_same(obs, expected, tolerance=0.0)
        assert_same(repeated, expected, tolerance=0.0)
    assert (
        other[0]["observation"][:-1] == first[0]["observation"][1:]
    ).all()  # environment i of seed s + 1 is environment i + 1 of s
    assert (other[0]["observation"] != first[0]["observation"]).any()


def test_a_seed_is_used_once():
    """As SB3 has it: the next reset carries on."""
    venv = small_pool()
    venv.seed(SEED)
    first: Any = venv.reset()
    second: Any = venv.reset()
    assert (first["observation"] != second["observation"]).any()


def test_pools_without_a_seed_differ():
    first, second = (EnvPoolVecEnv("HighwayFast-v0", 2, scenes=False).reset() for _ in range(2))
    assert (np.asarray(first) != np.asarray(second)).any()


def test_threads_change_nothing():
    for obs, expected in zip(sequence(small_pool()), sequence(small_pool(num_threads=2)), strict=True):
        assert_same(obs, expected, tolerance=0.0)


def test_returned_observations_are_not_written_to_later():
    venv = small_pool()
    kept: list[Any] = [venv.reset()]
    copies = [{key: value.copy() for key, value in kept[0].items()}]
    for actions in ACTIONS:
        obs, _, _, infos = venv.step(actions)
        for held in (obs, *(i["terminal_observation"] for i in infos if "terminal_observation" in i)):
            kept.append(held)
            copies.append({key: value.copy() for key, value in held.items()})
    for obs, copy in zip(kept, copies, strict=True):
        assert_same(obs, copy, tolerance=0.0)


class Frugal:
    """A pool that hands out the same buffer at each step, as EnvPool may and does not."""

    def __init__(self, pool: Any) -> None:
        self._pool, self._buffer = pool, np.zeros((ENVS, 5, 5), np.float32)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._pool, name)

    def step(self, actions: Any) -> Any:
        observations, *rest = self._pool.step(actions)
        self._buffer[:] = observations
        return self._buffer, *rest


def test_a_buffer_of_the_simulator_is_not_handed_out():
    venv, frugal = small_pool(), small_pool()
    frugal._pool = Frugal(frugal._pool)
    for obs, expected in zip(sequence(frugal), sequence(venv), strict=True):
        assert_same(obs, expected, tolerance=0.0)


def test_all_envs_have_the_attributes():
    venv = small_pool()
    assert venv.get_attr("scene_source") == ["envpool/HighwayFast-v0"] * ENVS
    assert venv.get_attr("scene_spec", [0, 2]) == [venv.scene_spec] * 2
    assert venv.get_attr("render_mode", 1) == [None]
    assert venv.has_attr("action_type") and not venv.has_attr("nothing_of_the_kind")
    assert venv.env_is_wrapped(gym.Wrapper) == [False] * ENVS
    venv.reset()
    assert [len(states[0].vehicles) for states in venv.env_method("debug_states", indices=[1])] == [9]
    with pytest.raises(AttributeError, match="are in C"):
        venv.set_attr("render_mode", None)
    with pytest.raises(AttributeError, match="no method 'fly'"):
        venv.env_method("fly")
    venv.close()


def test_an_id_that_differs_from_its_task_is_its_source():
    assert EnvPoolVecEnv("Intersection-v1", 1).scene_source == "envpool/IntersectionContinuous-v1"


# --- Errors -----------------------------------------------------------------------------------------------------------


def test_unknown_names_are_listed():
    with pytest.raises(UserError, match="no EnvPool task 'Parking-v0' is known here; known: Highway-v0"):
        make_pool("Parking-v0", [0])
    with pytest.raises(
        UserError, match=r"HighwayFast-v0 has no setting \['lanes'\]; it has (?!.*num_threads).*lanes_count"
    ):
        EnvPoolEnv("HighwayFast-v0", lanes=2)
    with pytest.raises(UserError, match=r"no setting \['num_envs', 'seed'\]"):
        EnvPoolEnv("HighwayFast-v0", seed=2, num_envs=3)


def test_an_envpool_that_hides_its_vehicles_is_named(monkeypatch: pytest.MonkeyPatch):
    import envpool

    monkeypatch.setattr(envpool, "make", lambda *args, **kwargs: object())
    with pytest.raises(UserError, match="does not report the vehicles' positions; install 1.2.5"):
        make_pool("Merge-v0", [0])


@pytest.mark.parametrize("action", [-1, 5, 1.5])
def test_actions_that_do_not_exist_are_named(action: float):
    env, venv = EnvPoolEnv("HighwayFast-v0"), small_pool()
    env.reset(seed=0)
    venv.reset()
    with pytest.raises(UserError, match=rf"action must be a whole number in 0…4, got \[{action}\]"):
        env.step(action)
    with pytest.raises(UserError, match=rf"action must be a whole number in 0…4, got .*{action}"):
        venv.step(np.array([1, action, 1]))
    env.step(4)
    env.step(np.array(4))
    venv.step(ACTIONS[0])


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (lambda shape: np.zeros(shape[0]), "a step needs one action for each of 2 envs, of shape"),
        (lambda shape: np.zeros((*shape, 1)), "a step needs one action for each of 2 envs, of shape"),
        (lambda shape: np.full(shape, np.nan), "actions must be finite numbers, got .*nan"),
        (lambda shape: np.full(shape, "left"), "actions must be finite numbers, got .*left"),
    ],
    ids=["too few axes", "too many axes", "nan", "text"],
)
def test_continuous_actions_of_another_kind_are_named(actions: Any, message: str):
    """Some of them end the process where EnvPool gets them."""
    venv = EnvPoolVecEnv("Racetrack-v0", 2, seed=0)
    venv.reset()
    shape = (2, *venv.action_space.shape)
    venv.step(np.zeros(shape))
    with pytest.raises(UserError, match=message):
        venv.step(actions(shape))


def test_rewards_that_are_not_finite_end_in_a_line(monkeypatch: pytest.MonkeyPatch):
    env, venv = EnvPoolEnv("HighwayFast-v0"), small_pool()
    for made, action in ((env, 1), (venv, ACTIONS[0])):
        made.reset()
        inner = made._pool.step
        pool = SimpleNamespace(
            step=lambda actions, inner=inner: [x * np.nan if i == 1 else x for i, x in enumerate(inner(actions))]
        )
        monkeypatch.setattr(made, "_pool", pool)
        with pytest.raises(UserError, match="HighwayFast-v0 gave rewards that are not finite: .*nan"):
            made.step(action)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"duration": "x"}, "does not take the settings {'duration': 'x'}: their types do not fit"),
        ({"policy_frequency": 0}, "does not take the settings {'policy_frequency': 0}: "),
        ({"num_threads": -1}, "num_threads must be at least 0, got -1"),
        ({"observation_vehicles_count": 0}, "observation_vehicles_count must be at least 1, got 0"),
    ],
)
def test_settings_of_another_kind_are_named(settings: dict[str, Any], message: str):
    with pytest.raises(UserError, match=message) as raised:
        EnvPoolVecEnv("HighwayFast-v0", 2, **settings)
    assert "\n" not in str(raised.value)


def test_stepping_past_the_end_is_named():
    """Where EnvPool would begin another episode and call it a step of this one."""
    env = EnvPoolEnv("HighwayFast-v0", duration=1)
    with pytest.raises(ProtocolError, match=r"call reset\(\) first"):
        env.step(1)
    env.reset(seed=0)
    env.step(1)
    with pytest.raises(ProtocolError, match="the episode has not begun or is over"):
        env.step(1)
    env.reset()
    env.step(1)


def test_options_are_refused():
    env, venv = EnvPoolEnv("HighwayFast-v0"), small_pool()
    env.reset(options={})
    with pytest.raises(UserError, match=r"takes no options at reset, got \['config'\]; pass settings to gym.make"):
        env.reset(options={"config": {}})
    venv.set_options({"config": {}})
    with pytest.raises(UserError, match="takes no options at reset; pass settings to EnvPoolVecEnv"):
        venv.reset()


def test_stepping_before_the_first_reset_is_named():
    venv = small_pool()
    with pytest.raises(ProtocolError, match=r"call reset\(\) and step_async"):
        venv.step(ACTIONS[0])
    venv.reset()
    with pytest.raises(ProtocolError, match=r"call reset\(\) and step_async"):
        venv.step_wait()


def test_every_env_needs_an_action():
    venv = small_pool()
    venv.reset()
    with pytest.raises(UserError, match=r"one action for each of 3 envs, of shape \(3,\), got \(2,\)"):
        venv.step(ACTIONS[0, :2])


@pytest.mark.parametrize(
    ("num_envs", "options", "words"),
    [
        (0, {}, "num_envs must be a whole number from 1 on, got 0"),
        (2.5, {}, "num_envs must be a whole number from 1 on, got 2.5"),
        (True, {}, "num_envs must be a whole number from 1 on, got True"),
        (1, {"seed": 1.5}, "seed must be a whole number from 0 on, got 1.5"),
        (1, {"seed": -1}, "seed must be a whole number from 0 on, got -1"),
        (1, {"max_agents": 2.7}, "max_agents must be a whole number from 1 to 65,536, got 2.7"),
        (1, {"perception_m": "x"}, "perception_m must be a positive number, got 'x'"),
    ],
)
def test_a_pool_refuses_numbers_that_are_none_for_it(num_envs: Any, options: dict[str, Any], words: str):
    with pytest.raises(UserError, match=words):
        EnvPoolVecEnv("Merge-v0", num_envs, **options)


def test_a_pool_without_scenes_has_none():
    venv = small_pool(scenes=False)
    assert not set(SCENE_KEYS) & set(getattr(venv.observation_space, "spaces", {}))
    with pytest.raises(UserError, match="VecForecast needs environments that report scenes"):
        VecForecast(venv, "constant-velocity")
