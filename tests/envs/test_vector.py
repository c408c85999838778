import subprocess
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecMonitor

from envs.entries import FORECAST_KEYS, PATH_KEYS
from envs.registry import make_env
from envs.sb3.forecast import VecForecast
from envs.vector import VectorForecast
from envs.wrappers import ForecastObservation, SceneObservation
from predictor.checkpoint import load_checkpoint
from predictor.scene import Scene
from predictor.support.errors import UserError
from tests.envs.helpers import (
    HIGHWAY_SPEC,
    MAX_AGENTS,
    PERCEPTION_M,
    assert_same,
    forecast_of_history,
    largest_difference,
    short_env,
    short_scene_env,
)
from tests.envs.played_alone import ACTIONS, DURATIONS, MAKERS, SEED, STEPS, Played, one_of, play_alone


@pytest.fixture(scope="module")
def alone(highway_checkpoint: str) -> list[Played]:
    return [play_alone(i, highway_checkpoint) for i in range(len(DURATIONS))]


@pytest.fixture(scope="module")
def alone_with_idle_steps(highway_checkpoint: str) -> list[Played]:
    return [play_alone(i, highway_checkpoint, idle_steps=True) for i in range(len(DURATIONS))]


def test_envs_end_at_different_steps(alone: list[Played], alone_with_idle_steps: list[Played]):
    """What the tests below rely on: every environment ends, no two alike, and not all at once."""
    for episodes in (alone, alone_with_idle_steps):
        ends = [tuple(played.ends) for played in episodes]
        assert all(any(e) for e in ends)
        assert len(set(ends)) == len(DURATIONS)


def test_mixed_histories_would_be_noticed(highway_checkpoint: str):
    """The forecast that opens an episode would differ visibly if it still remembered the last one, and vice versa."""
    env = short_scene_env(2)
    env.reset(seed=SEED)
    old: list[Scene] = [env.scene]
    for action in ACTIONS[:2, 0]:
        env.step(int(action))
        old.append(env.scene)
    env.reset()
    new = [env.scene]
    model, _ = load_checkpoint(highway_checkpoint)
    entries = partial(forecast_of_history, model, HIGHWAY_SPEC)
    assert largest_difference(entries(old + new), entries(new)) > 0.1
    assert largest_difference(entries(old), entries(old[-1:])) > 0.1


# --- Stable-Baselines3 ------------------------------------------------------------------------------------------------

SB3_KINDS: dict[str, Callable[[], VecEnv]] = {
    "dummy": lambda: DummyVecEnv(MAKERS),
    "fork": lambda: SubprocVecEnv(MAKERS[:2], start_method="fork"),
    "spawn": lambda: SubprocVecEnv(MAKERS[:2], start_method="spawn"),
}


# Python 3.12 warns of every fork of a process with threads; that it works is what is tested.
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*use of fork.. may lead to deadlocks:DeprecationWarning")
@pytest.mark.parametrize("kind", SB3_KINDS)
def test_sb3_envs_are_as_if_alone(kind: str, alone: list[Played], highway_checkpoint: str):
    venv = VecForecast(SB3_KINDS[kind](), highway_checkpoint)
    episodes = alone[: venv.num_envs]
    try:
        venv.seed(SEED)
        obs: Any = venv.reset()
        for i, played in enumerate(episodes):
            assert_same(one_of(obs, i), played.opening)
        for t in range(STEPS):
            obs, rewards, dones, infos = venv.step(ACTIONS[t, : len(episodes)])
            assert dones.tolist() == [played.ends[t] for played in episodes]
            assert rewards.tolist() == pytest.approx([played.rewards[t] for played in episodes], abs=1e-6)
            for i, played in enumerate(episodes):
                if played.ends[t]:
                    assert_same(infos[i]["terminal_observation"], played.steps[t])
                    assert_same(one_of(obs, i), played.successors[t])
                else:
                    assert "terminal_observation" not in infos[i]
                    assert_same(one_of(obs, i), played.steps[t])
    finally:
        venv.close()


def test_sb3_reset_forgets_every_env(alone: list[Played], highway_checkpoint: str):
    venv = VecForecast(DummyVecEnv(MAKERS), highway_checkpoint)
    venv.reset()
    venv.step(ACTIONS[0])
    venv.seed(SEED)
    obs: Any = venv.reset()
    for i, played in enumerate(alone):
        assert_same(one_of(obs, i), played.opening)


def test_sb3_observations_lie_in_the_space(highway_checkpoint: str):
    venv = VecForecast(VecMonitor(DummyVecEnv(MAKERS)), highway_checkpoint, num_samples=2, horizon_steps=4)
    space = venv.observation_space
    assert isinstance(space, gym.spaces.Dict)
    assert set(space) == {"observation", *FORECAST_KEYS, *PATH_KEYS, "mode_probs"}
    observations: list[Any] = [one_of(venv.reset(), i) for i in range(3)]
    for t in range(3):
        obs, _, dones, infos = venv.step(ACTIONS[t])
        observations += [one_of(obs, i) for i in range(3)]
        observations += [infos[i]["terminal_observation"] for i in np.flatnonzero(dones)]
        for i in np.flatnonzero(dones):
            assert {"TimeLimit.truncated", "episode"} <= set(infos[i])
    assert len(observations) > 12
    assert all(space.contains(obs) for obs in observations)
    assert observations[0]["forecast"].shape == (MAX_AGENTS - 1, 2, 4, 2)


# --- gymnasium --------------------------------------------------------------------------------------------------------


def vector(mode: AutoresetMode, checkpoint: str, kind: Any = SyncVectorEnv, **kwargs: Any) -> VectorForecast:
    return VectorForecast(kind(MAKERS, autoreset_mode=mode), checkpoint, **kwargs)


@pytest.mark.filterwarnings("ignore:.*use of fork.. may lead to deadlocks:DeprecationWarning")
@pytest.mark.parametrize("kind", [SyncVectorEnv, AsyncVectorEnv], ids=["sync", "async"])
def test_same_step_envs_are_as_if_alone(kind: Any, alone: list[Played], highway_checkpoint: str):
    env = vector(AutoresetMode.SAME_STEP, highway_checkpoint, kind)
    try:
        obs, _ = env.reset(seed=SEED)
        for i, played in enumerate(alone):
            assert_same(one_of(obs, i), played.opening)
        for t in range(STEPS):
            obs, rewards, terminations, truncations, infos = env.step(ACTIONS[t])
            assert (terminations | truncations).tolist() == [played.ends[t] for played in alone]
            assert rewards.tolist() == pytest.approx([played.rewards[t] for played in alone])
            for i, played in enumerate(alone):
                if played.ends[t]:
                    assert_same(infos["final_obs"][i], played.steps[t])
                    assert_same(one_of(obs, i), played.successors[t])
                else:
                    assert_same(one_of(obs, i), played.steps[t])
    finally:
        env.close()


def test_next_step_envs_are_as_if_alone(alone_with_idle_steps: list[Played], highway_checkpoint: str):
    env = vector(AutoresetMode.NEXT_STEP, highway_checkpoint)
    obs, _ = env.reset(seed=SEED)
    for i, played in enumerate(alone_with_idle_steps):
        assert_same(one_of(obs, i), played.opening)
    for t in range(STEPS):
        obs, rewards, terminations, truncations, _ = env.step(ACTIONS[t])
        assert (terminations | truncations).tolist() == [played.ends[t] for played in alone_with_idle_steps]
        assert rewards.tolist() == pytest.approx([played.rewards[t] for played in alone_with_idle_steps])
        for i, played in enumerate(alone_with_idle_steps):
            assert_same(one_of(obs, i), played.steps[t])


@pytest.mark.slow
def test_disabled_envs_are_as_if_alone(alone: list[Played], highway_checkpoint: str):
    env = vector(AutoresetMode.DISABLED, highway_checkpoint)
    obs, _ = env.reset(seed=SEED)
    for t in range(STEPS):
        obs, _, terminations, truncations, _ = env.step(ACTIONS[t])
        ended = terminations | truncations
        assert ended.tolist() == [played.ends[t] for played in alone]
        for i, played in enumerate(alone):
            assert_same(one_of(obs, i), played.steps[t])
        if ended.any():
            obs, _ = env.reset(options={"reset_mask": ended})
            for i, played in enumerate(alone):
                assert_same(one_of(obs, i), played.successors[t] if ended[i] else played.steps[t])


def test_disabled_partial_reset_right_after_reset(alone: list[Played], highway_checkpoint: str):
    """An environment that is reset before its episode ends forgets; the others carry on, having seen nothing twice."""
    env = vector(AutoresetMode.DISABLED, highway_checkpoint)
    env.reset(seed=SEED)
    env.step(ACTIONS[0])
    obs, _ = env.reset(seed=SEED, options={"reset_mask": np.array([True, False, False])})
    assert_same(one_of(obs, 0), alone[0].opening)
    again, _, _, _, _ = env.step(np.array([ACTIONS[0, 0], ACTIONS[1, 1], ACTIONS[1, 2]]))
    assert_same(one_of(again, 0), alone[0].steps[0])
    for i in (1, 2):
        assert_same(one_of(obs, i), alone[i].steps[0])
        assert_same(one_of(again, i), alone[i].steps[1])


@pytest.mark.slow
def test_the_mode_is_that_of_the_environment_whatever_others_of_its_class_have(
    alone: list[Played], highway_checkpoint: str
):
    """Gymnasium before 1.4 writes it into metadata that all environments of a class share."""
    inner = SyncVectorEnv(MAKERS, autoreset_mode=AutoresetMode.SAME_STEP)
    inner.metadata = inner.metadata | {"autoreset_mode": AutoresetMode.NEXT_STEP}
    env = VectorForecast(RecordEpisodeStatistics(inner), highway_checkpoint)
    env.reset(seed=SEED)
    for t in range(STEPS):
        obs, *_ = env.step(ACTIONS[t])
        for i, played in enumerate(alone):
            assert_same(one_of(obs, i), played.successors[t] if played.ends[t] else played.steps[t])


@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.name)
def test_gymnasium_observations_lie_in_the_space(mode: AutoresetMode, highway_checkpoint: str):
    env = vector(mode, highway_checkpoint, num_samples=2)
    assert env.metadata["autoreset_mode"] is mode
    obs, _ = env.reset(seed=SEED)
    assert obs in env.observation_space
    obs, _, _, _, _ = env.step(ACTIONS[0])
    assert obs in env.observation_space
    assert one_of(obs, 0) in env.single_observation_space
    assert obs["forecast"].shape == (3, MAX_AGENTS - 1, 2, 3, 2)


def test_returned_observations_are_not_written_to_later(highway_checkpoint: str):
    env = vector(AutoresetMode.DISABLED, highway_checkpoint)
    obs, _ = env.reset(seed=SEED)
    stepped = env.step(ACTIONS[0])[0]
    copies = [{key: value.copy() for key, value in o.items()} for o in (obs, stepped)]
    env.reset(options={"reset_mask": np.array([True, False, True])})
    env.step(ACTIONS[1])
    for kept, copy in zip((obs, stepped), copies, strict=True):
        assert_same(kept, copy, tolerance=0.0)


def test_the_usual_makers_work(highway_checkpoint: str):
    """What SB3 and gymnasium offer to make many environments at once, with the reader's own perception."""
    sb3 = VecForecast(make_vec_env("highway-fast-v0", 2, seed=SEED, wrapper_class=SceneObservation), highway_checkpoint)
    made = gym.make_vec("highway-fast-v0", 2, vectorization_mode="sync", wrappers=(SceneObservation,))
    gymnasium = VectorForecast(made, highway_checkpoint)
    first: Any = sb3.reset()
    second, _ = gymnasium.reset(seed=SEED)
    assert first["agents"].shape == (2, 11, 4)
    assert_same(first, second)


# --- One batched forward ----------------------------------------------------------------------------------------------


class Spy:
    """Notes the batch size of each call of a forecaster's `observe`."""

    def __init__(self, forecaster: Any, monkeypatch: pytest.MonkeyPatch) -> None:
        self.batches: list[int] = []
        observe = forecaster.observe

        def watched(memory: Any, states: Any, valid: Any) -> Any:
            self.batches.append(len(states))
            return observe(memory, states, valid)

        monkeypatch.setattr(forecaster, "observe", watched)

    def calls(self) -> list[int]:
        batches, self.batches = self.batches, []
        return batches


def test_sb3_makes_one_forward_per_step(highway_checkpoint: str, monkeypatch: pytest.MonkeyPatch):
    venv = VecForecast(DummyVecEnv(MAKERS), highway_checkpoint)
    spy = Spy(venv.stream.forecaster, monkeypatch)
    venv.reset()
    assert spy.calls() == [3]
    ended = 0
    for t in range(STEPS):
        _, _, dones, _ = venv.step(ACTIONS[t])
        assert spy.calls() == [3 + int(dones.sum())]  # fresh episodes ride along with the closing ones
        ended += int(dones.sum())
    assert ended > 2


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP], ids=lambda mode: mode.name)
def test_gymnasium_makes_one_forward_per_step(
    mode: AutoresetMode, highway_checkpoint: str, monkeypatch: pytest.MonkeyPatch
):
    env = vector(mode, highway_checkpoint)
    spy = Spy(env.stream.forecaster, monkeypatch)
    env.reset(seed=SEED)
    assert spy.calls() == [3]
    for t in range(STEPS):
        _, _, terminations, truncations, _ = env.step(ACTIONS[t])
        extra = int((terminations | truncations).sum()) if mode is AutoresetMode.SAME_STEP else 0
        assert spy.calls() == [3 + extra]


def test_a_partial_reset_forwards_only_its_envs(highway_checkpoint: str, monkeypatch: pytest.MonkeyPatch):
    env = vector(AutoresetMode.DISABLED, highway_checkpoint)
    env.reset(seed=SEED)
    spy = Spy(env.stream.forecaster, monkeypatch)
    env.reset(options={"reset_mask": np.array([False, True, True])})
    assert spy.calls() == [2]


def test_a_forecaster_can_be_passed(highway_checkpoint: str):
    model, _ = load_checkpoint(highway_checkpoint)
    venvs = [
        VecForecast(DummyVecEnv(MAKERS), forecaster=model),
        VecForecast(DummyVecEnv(MAKERS), highway_checkpoint),
    ]
    assert venvs[0].stream.forecaster is model
    observations: list[Any] = []
    for venv in venvs:
        venv.seed(SEED)
        observations.append(venv.reset())
    assert_same(*observations, tolerance=0.0)


# --- Randomness -------------------------------------------------------------------------------------------------------


def sb3_sequence(venv: VecEnv) -> list[Any]:
    venv.seed(SEED)
    sequence: list[Any] = [venv.reset()]
    for t in range(4):
        obs, rewards, _, infos = venv.step(ACTIONS[t])
        sequence += [obs, {"rewards": rewards}, *(i["terminal_observation"] for i in infos if len(i) > 5)]
    return sequence


def assert_same_sequences(first: list[Any], second: list[Any]) -> None:
    assert len(first) == len(second)
    for actual, expected in zip(first, second, strict=True):
        assert_same(actual, expected, tolerance=0.0)


@pytest.mark.slow
def test_sb3_same_seed_same_sequences(highway_checkpoint: str):
    make = partial(VecForecast, checkpoint=highway_checkpoint, num_samples=3)
    first, second = (sb3_sequence(make(DummyVecEnv(MAKERS))) for _ in range(2))
    assert_same_sequences(first, second)


@pytest.mark.slow
def test_sb3_seeding_again_repeats_the_samples(highway_checkpoint: str):
    venv = VecForecast(DummyVecEnv(MAKERS), highway_checkpoint, num_samples=3)
    first, second = sb3_sequence(venv), sb3_sequence(venv)
    assert_same_sequences(first, second)


def test_sb3_noise_has_a_seed_of_its_own(highway_checkpoint: str):
    first, second = (VecForecast(DummyVecEnv(MAKERS), highway_checkpoint, num_samples=3, seed=seed) for seed in (1, 2))
    samples: list[Any] = []
    for venv in (first, second):
        venv.venv.seed(SEED)
        samples.append(venv.reset())
    assert (samples[0]["forecast"][:, :, 0] == samples[1]["forecast"][:, :, 0]).all()
    assert (samples[0]["forecast"] != samples[1]["forecast"]).any()


def gymnasium_sequence(env: VectorForecast) -> list[Any]:
    sequence: list[Any] = [env.reset(seed=SEED)[0]]
    for t in range(4):
        obs, rewards, _, _, _ = env.step(ACTIONS[t])
        sequence += [obs, {"rewards": rewards}]
    return sequence


@pytest.mark.slow
def test_gymnasium_same_seed_same_sequences(highway_checkpoint: str):
    env = vector(AutoresetMode.NEXT_STEP, highway_checkpoint, num_samples=3)
    other = vector(AutoresetMode.NEXT_STEP, highway_checkpoint, num_samples=3)
    first, again, second = gymnasium_sequence(env), gymnasium_sequence(env), gymnasium_sequence(other)
    assert_same_sequences(again, first)
    assert_same_sequences(second, first)


# --- Errors -----------------------------------------------------------------------------------------------------------


def test_envs_without_scenes_are_named():
    bare = [partial(short_env, 2)]
    with pytest.raises(UserError, match="VecForecast needs environments that report scenes, got Box .*SceneObserva"):
        VecForecast(DummyVecEnv(bare), "constant-velocity")
    with pytest.raises(UserError, match="VectorForecast needs environments that report scenes, got Box"):
        VectorForecast(SyncVectorEnv(bare), "constant-velocity")


def differing() -> list[Callable[[], gym.Env]]:
    return [lambda range_m=range_m: SceneObservation(short_env(2), range_m, 4) for range_m in (50.0, 60.0)]


def test_envs_with_differing_specs_are_named():
    expected = r"all environments must have the same scene spec, got perception_m=50.0 and perception_m=60.0$"
    with pytest.raises(UserError, match=expected):
        VecForecast(DummyVecEnv(differing()), "constant-velocity")
    with pytest.raises(UserError, match=expected):
        VectorForecast(SyncVectorEnv(differing()), "constant-velocity")


def test_envs_of_differing_ids_are_named():
    """Both stand on a 1 s step and have observations of the same shape; their checkpoints differ."""
    ids = [lambda i=i: SceneObservation(make_env(i), PERCEPTION_M, 4) for i in ("merge-v1", "merge-generic-v1")]
    with pytest.raises(UserError, match=r"the same env id, got \['merge-generic-v1', 'merge-v1'\]"):
        VecForecast(DummyVecEnv(ids), "constant-velocity")
    with pytest.raises(UserError, match=r"the same env id, got \['merge-generic-v1', 'merge-v1'\]"):
        VectorForecast(SyncVectorEnv(ids), "constant-velocity")


def test_time_steps_that_differ_are_both_named(racetrack_checkpoint: str):
    expected = r"tiny-racetrack' was trained at dt_s=0.2 but env 'highway-fast-v0' steps at dt_s=1;"
    with pytest.raises(UserError, match=expected):
        VecForecast(DummyVecEnv(MAKERS), racetrack_checkpoint)
    with pytest.raises(UserError, match=expected):
        VectorForecast(SyncVectorEnv(MAKERS), racetrack_checkpoint)


@pytest.mark.parametrize("name", ["num_samples", "horizon_steps"])
def test_zero_is_named(name: str, highway_checkpoint: str):
    with pytest.raises(UserError, match=f"{name} must be at least 1, got 0"):
        VecForecast(DummyVecEnv(MAKERS), highway_checkpoint, **{name: 0})
    with pytest.raises(UserError, match=f"{name} must be at least 1, got 0"):
        VectorForecast(SyncVectorEnv(MAKERS), highway_checkpoint, **{name: 0})


# --- Under other wrappers, and without Stable-Baselines3 --------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*use of fork.. may lead to deadlocks:DeprecationWarning")
@pytest.mark.parametrize("kind", [SyncVectorEnv, AsyncVectorEnv], ids=["sync", "async"])
@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.name)
def test_a_wrapper_below_changes_nothing(mode: AutoresetMode, kind: Any, highway_checkpoint: str):
    plain = vector(mode, highway_checkpoint)
    env = VectorForecast(RecordEpisodeStatistics(kind(MAKERS, autoreset_mode=mode)), highway_checkpoint)
    try:
        assert_same(env.reset(seed=SEED)[0], plain.reset(seed=SEED)[0])
        episodes = 0
        for t in range(4):
            obs, _, terminations, truncations, infos = env.step(ACTIONS[t])
            expected, _, _, _, plain_infos = plain.step(ACTIONS[t])
            assert_same(obs, expected)
            ended = terminations | truncations
            episodes += int(infos["episode"]["l"].astype(bool).sum()) if "episode" in infos else 0
            for i in np.flatnonzero(ended) if mode is AutoresetMode.SAME_STEP else ():
                assert_same(infos["final_obs"][i], plain_infos["final_obs"][i])
            if mode is AutoresetMode.DISABLED and ended.any():
                masks = [{"reset_mask": ended.copy()} for _ in range(2)]
                assert_same(env.reset(options=masks[0])[0], plain.reset(options=masks[1])[0])
        assert episodes
    finally:
        env.close()


def test_infos_as_a_list_are_for_outside():
    with pytest.raises(UserError, match="reads infos as a dict; put DictInfoToList around it, not inside"):
        VectorForecast(DictInfoToList(SyncVectorEnv(MAKERS)), "constant-velocity")


def test_a_vector_environment_without_get_attr_is_named():
    env = SyncVectorEnv(MAKERS)

    class Bare(gym.vector.VectorEnv):
        num_envs = env.num_envs
        single_observation_space = env.single_observation_space

    with pytest.raises(UserError, match="asks each environment for its scene_spec, but Bare has no get_attr"):
        VectorForecast(Bare(), "constant-velocity")


def test_a_reset_seeds_the_noise_of_the_environments_it_resets(highway_checkpoint: str):
    """With seeds [None, s, None] only environment 1 draws anew; its samples are those of an environment alone."""
    env = vector(AutoresetMode.DISABLED, highway_checkpoint, num_samples=4)
    untouched = vector(AutoresetMode.DISABLED, highway_checkpoint, num_samples=4)
    for each in (env, untouched):
        each.reset(seed=SEED)
    mask = np.array([False, True, False])
    obs, _ = env.reset(seed=[None, 5, None], options={"reset_mask": mask})
    alone = ForecastObservation(short_env(DURATIONS[1]), highway_checkpoint, num_samples=4)
    assert_same(one_of(obs, 1), alone.reset(seed=5)[0])
    found, expected = env.step(ACTIONS[0])[0], untouched.step(ACTIONS[0])[0]
    for i in (0, 2):
        assert_same(one_of(found, i), one_of(expected, i))
    assert_same(one_of(found, 1), alone.step(int(ACTIONS[0, 1]))[0])


def test_seeds_may_come_in_any_sequence():
    """As Gymnasium's own vector environments take them."""
    env = VectorForecast(SyncVectorEnv(MAKERS), "constant-velocity")
    seeds = [3, 4, 5, 6, 7, 8][: env.num_envs]
    listed = env.reset(seed=seeds)[0]
    assert_same(env.reset(seed=tuple(seeds))[0], listed)


@pytest.mark.slow
@pytest.mark.parametrize("maker", ["sb3", "gymnasium"])
def test_samples_of_an_env_are_those_of_its_environment_alone(maker: str, highway_checkpoint: str):
    """Also over the ends of episodes, where the stream forecasts an environment twice in one batch."""
    alone = [ForecastObservation(short_env(d), highway_checkpoint, num_samples=5) for d in DURATIONS]
    venv: Any = VecForecast(DummyVecEnv(MAKERS), highway_checkpoint, num_samples=5)
    if maker == "gymnasium":
        venv = vector(AutoresetMode.SAME_STEP, highway_checkpoint, num_samples=5)
        obs = venv.reset(seed=SEED)[0]
    else:
        venv.seed(SEED)
        obs = venv.reset()
    for i, env in enumerate(alone):
        assert_same(one_of(obs, i), env.reset(seed=SEED + i)[0], 1e-3)
    for t in range(4):
        obs = venv.step(ACTIONS[t])[0]
        for i, env in enumerate(alone):
            own, _, terminated, truncated, _ = env.step(int(ACTIONS[t, i]))
            assert_same(one_of(obs, i), env.reset()[0] if terminated or truncated else own, 1e-3)


WITHOUT_SB3 = """
import sys
sys.modules["stable_baselines3"] = None  # an import of it fails
import gymnasium as gym
from envs.vector import VectorForecast
from envs.wrappers import SceneObservation
from envs.parallel import ForecastParallelEnv
env = gym.make_vec("highway-fast-v0", 2, vectorization_mode="sync", wrappers=(SceneObservation,))
print(VectorForecast(env, "constant-velocity").reset(seed=0)[0]["forecast"].shape)
"""


@pytest.mark.slow
def test_gymnasium_needs_no_stable_baselines():
    done = subprocess.run([sys.executable, "-c", WITHOUT_SB3], capture_output=True, text=True, timeout=90)
    assert done.returncode == 0, done.stderr
    assert "(2, 11, 5, 2)" in done.stdout


def test_a_reset_after_an_end_begins_anew(highway_checkpoint: str):
    """In the mode in which the next step would have: that step is not taken for the reset a second time."""
    env, fresh = (vector(AutoresetMode.NEXT_STEP, highway_checkpoint) for _ in range(2))
    fresh.reset(seed=SEED)
    expected = fresh.step(ACTIONS[0])[0]
    env.reset(seed=SEED)
    assert any(np.logical_or(*env.step(actions)[2:4]).any() for actions in ACTIONS)
    env.reset(seed=SEED)
    assert_same(env.step(ACTIONS[0])[0], expected)


def test_a_seed_for_some_environments_leaves_the_noise_of_the_others_alone(highway_checkpoint: str):
    env, untouched = (vector(AutoresetMode.DISABLED, highway_checkpoint, num_samples=4) for _ in range(2))
    for each in (env, untouched):
        each.reset(seed=SEED)
    env.reset(seed=5, options={"reset_mask": np.array([False, True, False])})
    found, expected = env.step(ACTIONS[0])[0], untouched.step(ACTIONS[0])[0]
    for place in (0, 2):
        assert_same(one_of(found, place), one_of(expected, place))
