import zipfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DQN, PPO

from envs.drivers.ego import EGO_DRIVER_NAMES, constant_actions, idle_action, make_ego_driver, named_drivers
from envs.drivers.trained import env_for_driver, sees_forecasts
from envs.registry import CHECKPOINTS, make_env
from envs.sb3.policy_file import NOTE_ENTRY
from envs.wrappers import ForecastObservation
from predictor.support.errors import UserError
from tests.envs.helpers import assert_same, save_forecast_policy

TRACK_STEPS = 40


def actions_of(name: str, env: gym.Env, seed: int, count: int = 200) -> list[Any]:
    ego = make_ego_driver(name, env, np.random.default_rng(seed))
    return [ego(None) for _ in range(count)]


@pytest.fixture(scope="module")
def discrete() -> gym.Env:
    return make_env("two-way-v0")


@pytest.fixture(scope="module")
def continuous() -> gym.Env:
    return make_env("racetrack-v1")


@pytest.fixture(scope="module")
def policies(tmp_path_factory: pytest.TempPathFactory, discrete: gym.Env) -> Path:
    folder = tmp_path_factory.mktemp("policies")
    tiny: dict[str, Any] = {"policy_kwargs": {"net_arch": [4]}, "device": "cpu", "seed": 0}
    PPO("MlpPolicy", discrete, n_steps=4, batch_size=4, **tiny).save(folder / "ppo.zip")
    DQN("MlpPolicy", discrete, buffer_size=10, **tiny).save(folder / "dqn.zip")
    return folder


@pytest.fixture(scope="module")
def forecast_policy(tmp_path_factory: pytest.TempPathFactory, highway_checkpoint: str) -> Path:
    return save_forecast_policy(tmp_path_factory.mktemp("run"), "two-way-v0", highway_checkpoint)


@pytest.mark.parametrize("name", ["random", "varied", "idle"])
@pytest.mark.parametrize("env_id", ["two-way-v0", "racetrack-v1"])
def test_actions_lie_in_the_space_and_repeat_with_the_seed(name: str, env_id: str):
    env = make_env(env_id)
    actions = actions_of(name, env, seed=3)
    assert all(action in env.action_space for action in actions)
    np.testing.assert_array_equal(actions, actions_of(name, env, seed=3))
    if name != "idle":
        assert (np.array(actions) != np.array(actions_of(name, env, seed=4))).any()


@pytest.mark.parametrize(
    "space",
    [
        gym.spaces.Discrete(3, start=1),
        gym.spaces.Box(0.5, 1.0, (1,)),
        gym.spaces.MultiDiscrete([2, 3], start=[4, 5]),
        gym.spaces.MultiBinary(3),
    ],
)
def test_drivers_take_actions_of_every_space(space: gym.Space):
    env = gym.Env()
    env.action_space = space
    assert idle_action(env) in space
    for name in ("random", "varied"):
        drive = make_ego_driver(name, env, np.random.default_rng(0))
        taken = np.array([drive(None) for _ in range(200)])
        assert all(action in space for action in taken.astype(space.dtype))
        if not isinstance(space, gym.spaces.Box) and name == "random":
            rows = taken.reshape(200, -1)
            found = [len(np.unique(row)) for row in rows.T]
            assert found == {"Discrete": [3], "MultiDiscrete": [2, 3], "MultiBinary": [2, 2, 2]}[type(space).__name__]


@pytest.mark.parametrize("env_id", CHECKPOINTS)
def test_idle_is_the_simulators_idle(env_id: str):
    env = make_env(env_id)
    action = idle_action(env)
    assert action in env.action_space
    if isinstance(env.action_space, gym.spaces.Discrete):
        assert env.unwrapped.action_type.actions[action] == "IDLE"
    else:
        assert not action.any()


def test_idle_keeps_speed_and_lane():
    env = make_env("highway-fast-v0", config={"vehicles_count": 0})
    env.reset(seed=0)
    ego: Any = env.unwrapped.vehicle
    speed, lane = ego.speed, ego.lane_index
    env.step(idle_action(env))
    assert (ego.speed, ego.lane_index) == (pytest.approx(speed), lane)


def test_constant_actions_have_the_simulators_names(discrete: gym.Env, continuous: gym.Env):
    names = {"lane-left": 0, "idle": 1, "lane-right": 2, "faster": 3, "slower": 4}
    assert constant_actions(discrete) == names
    for name, action in names.items():
        assert actions_of(name, discrete, seed=0, count=5) == [action] * 5
    assert constant_actions(continuous) == {}


def test_actions_without_names_are_counted_from_the_spaces_start():
    env = gym.make("CartPole-v1")
    env.action_space = gym.spaces.Discrete(2, start=3)
    assert constant_actions(env) == {"action-3": 3, "action-4": 4}
    assert actions_of("action-4", env, seed=0, count=2) == [4, 4]


def test_a_list_of_drivers_names_each_constant_action_once(discrete: gym.Env, continuous: gym.Env):
    names = named_drivers(("planner", "slower", "constant-actions", "planner"), discrete)
    assert names == ("planner", "slower", "lane-left", "idle", "lane-right", "faster")
    assert named_drivers(("idle",), continuous) == ("idle",)


def test_random_takes_every_action_equally(discrete: gym.Env):
    counts = np.bincount(actions_of("random", discrete, seed=0, count=2000), minlength=5)
    assert counts.min() > 330  # 400 ± 18


def test_varied_keeps_to_a_choice_and_differs_between_episodes(discrete: gym.Env):
    def repeats(name: str, seed: int) -> float:
        actions = np.array(actions_of(name, discrete, seed, count=400))
        return float((actions[1:] == actions[:-1]).mean())

    varied = [repeats("varied", seed) for seed in range(12)]
    assert np.mean(varied) > 0.4 > repeats("random", 0)  # uniform actions repeat every fifth time
    assert np.ptp(varied) > 0.3
    favourites = {int(np.bincount(actions_of("varied", discrete, seed)).argmax()) for seed in range(12)}
    assert len(favourites) > 2


def steps_on_road(name: str) -> int:
    # As envs.collect makes it: gymnasium's checker takes an action that is passed twice for a flaw of the env.
    env = make_env("racetrack-v1", config={"other_vehicles": 0}, disable_env_checker=True)
    obs, _ = env.reset(seed=2)
    ego = make_ego_driver(name, env, np.random.default_rng(2))
    for step in range(TRACK_STEPS):
        obs, _, terminated, truncated, _ = env.step(ego(obs))
        if terminated or truncated or not env.unwrapped.vehicle.on_road:
            return step
    return TRACK_STEPS


@pytest.mark.slow
def test_keep_lane_follows_the_track_where_idling_leaves_it():
    assert steps_on_road("keep-lane") == TRACK_STEPS
    assert steps_on_road("idle") < TRACK_STEPS


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_trained_policies_drive(algorithm: str, policies: Path, discrete: gym.Env):
    ego = make_ego_driver(str(policies / f"{algorithm}.zip"), discrete, np.random.default_rng(0))
    model = {"ppo": PPO, "dqn": DQN}[algorithm].load(policies / f"{algorithm}.zip", device="cpu")
    rng = np.random.default_rng(1)
    observations = [rng.normal(size=discrete.observation_space.shape).astype(np.float32) for _ in range(20)]
    actions = [int(ego(obs)) for obs in observations]
    assert actions == [int(model.predict(obs, deterministic=True)[0]) for obs in observations]


@pytest.mark.parametrize("name", EGO_DRIVER_NAMES)
def test_only_policies_change_the_view(name: str, discrete: gym.Env, policies: Path):
    assert env_for_driver(discrete, name) is discrete
    assert not sees_forecasts(name)
    assert env_for_driver(discrete, str(policies / "dqn.zip")) is discrete
    assert not sees_forecasts(str(policies / "dqn.zip"))


def test_policies_trained_on_forecasts_get_those_of_their_run(
    forecast_policy: Path, discrete: gym.Env, highway_checkpoint: str
):
    name = str(forecast_policy)
    assert sees_forecasts(name)
    env, expected = env_for_driver(discrete, name), ForecastObservation(make_env("two-way-v0"), highway_checkpoint)
    ego = make_ego_driver(name, env, np.random.default_rng(0))
    model = PPO.load(forecast_policy, device="cpu")
    obs, _ = env.reset(seed=0)
    own, _ = expected.reset(seed=0)
    for _ in range(3):
        assert_same(obs, own, tolerance=0.0)
        action = int(ego(obs))
        assert action == int(model.predict(own, deterministic=True)[0])
        obs, own = env.step(action)[0], expected.step(action)[0]


# --- Errors -----------------------------------------------------------------------------------------------------------


def test_unknown_names_are_listed(discrete: gym.Env):
    names = ", ".join((*EGO_DRIVER_NAMES, "lane-left", "lane-right", "faster", "slower"))
    expected = rf"driver must be one of {names}, own:module:function or the path of a policy .zip, got 'fast'"
    with pytest.raises(UserError, match=expected):
        make_ego_driver("fast", discrete, np.random.default_rng(0))


def test_keep_lane_does_not_steer_with_the_throttle():
    config = {"action": {"type": "ContinuousAction", "lateral": False}}
    throttle = gym.make("highway-fast-v0", config=config)
    with pytest.raises(UserError, match=r"keep-lane needs continuous steering, got Box\(.*; use random"):
        make_ego_driver("keep-lane", throttle, np.random.default_rng(0))


def test_keep_lane_needs_steering(discrete: gym.Env):
    with pytest.raises(UserError, match=r"keep-lane needs continuous steering, got Discrete\(5\); use random"):
        make_ego_driver("keep-lane", discrete, np.random.default_rng(0))


def test_spaces_without_an_idle_or_random_action_are_named():
    env = make_env("intersection-multi-agent-v2")
    with pytest.raises(
        UserError, match="no idle action is known for Tuple.*; drive it with one of your own, own:module:function"
    ):
        idle_action(env)
    for name in ("random", "varied"):
        with pytest.raises(
            UserError, match="random egos need a Discrete, .* got Tuple.*; drive it with one of your own"
        ):
            make_ego_driver(name, env, np.random.default_rng(0))


def test_missing_policy_is_named(tmp_path: Path, discrete: gym.Env):
    with pytest.raises(UserError, match="no policy at .*absent.zip; train one with python train_policy.py"):
        make_ego_driver(str(tmp_path / "absent.zip"), discrete, np.random.default_rng(0))


@pytest.mark.parametrize("kind", ["text", "truncated", "foreign"])
def test_file_that_is_no_policy_is_named(kind: str, tmp_path: Path, policies: Path, discrete: gym.Env):
    path = tmp_path / f"{kind}.zip"
    if kind == "text":
        path.write_text("no zip at all")
    elif kind == "truncated":
        whole = (policies / "ppo.zip").read_bytes()
        path.write_bytes(whole[: len(whole) // 2])
    else:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("notes.txt", "a zip, but no policy")
    said = (
        "holds no policy of ppo, dqn, a2c, sac, qrdqn, recurrent-ppo, tqc" if kind == "foreign" else "is damaged; copy"
    )
    with pytest.raises(UserError, match=f"{kind}.zip {said}"):
        make_ego_driver(str(path), discrete, np.random.default_rng(0))


def test_policy_of_another_env_is_named(policies: Path):
    expected = r"policy .*ppo.zip was trained on Box\(.*\(3, 3, 5\).*, but the env gives Box\(.*\(5, 5\)"
    with pytest.raises(UserError, match=expected):
        env_for_driver(make_env("highway-fast-v0"), str(policies / "ppo.zip"))


@pytest.mark.filterwarnings("ignore:.* has no note")
def test_policy_of_other_forecasts_is_named(forecast_policy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Without its note, the forecasts it saw are unknown: those of constant velocity have other edges."""
    stray = tmp_path / "policy.zip"
    with zipfile.ZipFile(forecast_policy) as whole, zipfile.ZipFile(stray, "w") as bare:
        for name in set(whole.namelist()) - {NOTE_ENTRY}:
            bare.writestr(name, whole.read(name))
    monkeypatch.setattr("envs.observation.checkpoint_for", lambda source: "constant-velocity")
    with pytest.raises(UserError, match="policy .*policy.zip was trained on Dict.*, but the env gives Dict"):
        env_for_driver(make_env("two-way-v0"), str(stray))
