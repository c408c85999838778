from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3 import PPO

from envs import collect
from envs.collect import CollectConfig
from envs.drivers.ego import idle_action
from envs.readers import multiagent_reader_for
from envs.readers.highway import HighwayReader
from envs.readers.highway_labels import ATTRIBUTE_NAMES, LEADER
from envs.registry import make_env, make_multiagent_env
from predictor.data.store import Episode, read_store
from predictor.data.windows import Windows
from predictor.support.errors import UserError
from tests.envs.helpers import run_command, save_forecast_policy

ENV_ID = "two-way-v0"
TAG = "simple_tag_v3"
STEPS = 3


def config(**changes: Any) -> CollectConfig:
    return CollectConfig(**{"env_id": ENV_ID, "out": Path("unused"), "workers": 1, "max_steps": STEPS, **changes})


def assert_same_episodes(first: list[Episode], second: list[Episode]) -> None:
    assert len(first) == len(second) > 0
    for actual, expected in zip(first, second, strict=True):
        assert (actual.label, actual.seed) == (expected.label, expected.seed)
        for name in ("states", "valid", "ids", "edge_types", "edge_attributes", "causal_shift_m", "perturbed"):
            np.testing.assert_array_equal(getattr(actual, name), getattr(expected, name))


def test_an_episode_is_what_the_simulator_did():
    (episode,) = collect.collect(config(episodes=1, driver=("idle",), seed=11))
    env = make_env(ENV_ID)
    env.reset(seed=11)
    reader = HighwayReader(env)
    assert (episode.label, episode.seed, len(episode.states)) == ("idle", 11, STEPS + 1)
    for t in range(STEPS + 1):
        truth = reader.read_all(env)
        present = episode.valid[t]
        assert episode.ids[present].tolist() == truth.ids.tolist()
        np.testing.assert_allclose(episode.states[t, present], truth.states, rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(episode.states[t, 0, :2], env.unwrapped.vehicle.position, rtol=1e-6)
        env.step(idle_action(env))


def test_an_episode_ends_with_its_last_scene():
    (episode,) = collect.collect(config(episodes=1, env_id="u-turn-v1", driver=("idle",), max_steps=200))
    assert 2 < len(episode.states) <= 11  # highway-env stops u-turn-v1 after 10 s
    assert episode.valid[:, 0].all()


def test_an_episode_depends_on_its_seed_alone():
    """Neither on its place in the order nor on what the process did before."""
    many = list(collect.collect(config(episodes=3, seed=4, driver=("random",))))
    again = list(collect.collect(config(episodes=3, seed=4, driver=("random",))))
    assert_same_episodes(again, many)
    single = list(collect.collect(config(episodes=1, seed=6, driver=("random",))))
    assert_same_episodes(single, many[2:])
    assert not np.array_equal(many[0].states, many[1].states)


@pytest.mark.slow
def test_the_store_is_the_same_for_any_number_of_workers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    for workers in (1, 2):
        arguments = ["--env-id", ENV_ID, "--out", str(tmp_path / str(workers)), "--episodes", "5", "--seed", "30"]
        arguments += ["--workers", str(workers), "--max-steps", str(STEPS)]
        code, errors, output = run_command(collect.main, arguments, monkeypatch, capsys)
        assert (code, errors) == (0, [])
        assert "5 episodes" in output
        assert "seeds 30–34" in output
    alone, together = (read_store(tmp_path / name) for name in ("1", "2"))
    assert_same_episodes(together.episodes, alone.episodes)
    assert [e.label for e in alone.episodes] == ["varied", "random", "idle", "varied", "random"]
    assert [e.seed for e in alone.episodes] == list(range(30, 35))
    assert all(e.edge_types is not None and (e.edge_types == LEADER).any() for e in alone.episodes)
    assert alone.info.edge_attribute_names == ATTRIBUTE_NAMES
    assert alone.info.source == ENV_ID
    assert alone.info.spec == HighwayReader(make_env(ENV_ID)).spec
    assert alone.info.provenance["seed"] == 30
    assert sorted(p.name for p in tmp_path.iterdir()) == ["1", "2"]


@pytest.mark.parametrize(
    ("part", "setting"), [("content_of", "content_of_drivers"), ("content_of_module", "content_of_env")]
)
def test_a_recording_does_not_go_on_with_a_driver_or_environment_that_has_changed(
    part: str, setting: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    words = ["--env-id", TAG, "--episodes", "3", "--max-steps", "3", "--workers", "1", "--out", str(tmp_path / "store")]
    recorded = collect._record

    def stop_at_second(task: Any) -> Episode:
        if task.seed == 1:
            raise KeyboardInterrupt
        return recorded(task)

    monkeypatch.setattr(collect, part, lambda name: "before")
    with monkeypatch.context() as stopping:
        stopping.setattr(collect, "_record", stop_at_second)
        assert run_command(collect.main, words, stopping, capsys)[0] == 130
    monkeypatch.setattr(collect, part, lambda name: "after")
    code, errors, _ = run_command(collect.main, words, monkeypatch, capsys)
    assert code == 2 and f"unfinished recording that differs in {setting}; repeat its command" in errors[0]


def test_a_stop_before_the_first_new_episode_says_that_earlier_ones_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    def stop(*_: Any) -> Any:
        raise KeyboardInterrupt

    words = ["--env-id", TAG, "--episodes", "3", "--max-steps", "3", "--workers", "1", "--out", str(tmp_path / "store")]
    monkeypatch.setattr(collect, "_info_from", stop)
    code, errors, _ = run_command(collect.main, words, monkeypatch, capsys)
    assert (code, errors[-1]) == (130, "stopped: no episode is kept yet; the same command begins anew")
    (tmp_path / ".store.unfinished").mkdir()
    code, errors, _ = run_command(collect.main, words, monkeypatch, capsys)
    assert code == 130
    assert errors[-1] == "stopped: what an earlier start kept is still there; the same command goes on"


def test_a_recording_that_another_one_has_finished_meanwhile_is_not_played_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    words = ["--env-id", TAG, "--episodes", "1", "--max-steps", "3", "--workers", "1", "--out", str(tmp_path / "store")]
    made = collect._info_from

    def made_while_another_ends(*arguments: Any) -> Any:
        with monkeypatch.context() as other:
            other.setattr(collect, "_info_from", made)
            assert run_command(collect.main, words, other, capsys)[0] == 0
        monkeypatch.setattr(collect, "recorded", lambda *_: pytest.fail("played"))
        return made(*arguments)

    monkeypatch.setattr(collect, "_info_from", made_while_another_ends)
    code, errors, _ = run_command(collect.main, words, monkeypatch, capsys)
    assert code == 2 and errors == [f"error: {tmp_path / 'store'} exists; choose another path or pass --overwrite"]
    assert [path.name for path in tmp_path.iterdir()] == ["store"]


def test_what_the_reader_says_of_its_scenes_is_a_setting_of_a_recording():
    made = config(env_id=TAG, out=Path("store"))
    info = collect._info(made, 0)
    other = replace(info, spec=replace(info.spec, dt_s=2 * info.spec.dt_s))
    before, after = (collect._settings(made, one) for one in (info, other))
    assert {name for name in before if before[name] != after[name]} == {"spec"}


PERTURBED = ["--perturb", "0.7", "--causal-labels", "2", "--causal-horizon-s", "0.3", "--causal-senders", "2"]


@pytest.mark.slow
def test_a_perturbed_store_is_the_same_for_any_number_of_workers_and_after_a_stop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    base = ["--env-id", TAG, "--episodes", "4", "--seed", "30", "--max-steps", "6", *PERTURBED]
    whole = [*base, "--out", str(tmp_path / "whole"), "--workers", "1"]
    assert run_command(collect.main, whole, monkeypatch, capsys)[:2] == (0, [])
    recorded = collect._record

    def stop_at_third(task: Any) -> Episode:
        if task.seed == 32:
            raise KeyboardInterrupt
        return recorded(task)

    again = [*base, "--out", str(tmp_path / "stopped"), "--workers"]
    with monkeypatch.context() as stopping:
        stopping.setattr(collect, "_record", stop_at_third)
        assert run_command(collect.main, [*again, "1"], stopping, capsys)[0] == 130
    assert not (tmp_path / "stopped").exists()
    code, errors, output = run_command(collect.main, [*again, "2"], monkeypatch, capsys)
    assert (code, errors) == (0, [])
    assert "4 episodes (2 of them from an unfinished recording)" in output
    alone, stopped = (read_store(tmp_path / name) for name in ("whole", "stopped"))
    assert_same_episodes(stopped.episodes, alone.episodes)
    assert alone.info.causal_threshold_m == stopped.info.causal_threshold_m == 0.05
    assert alone.info.provenance["perturbations"]["share"] == 0.7
    assert alone.info.provenance["causal_labels"]["horizon_s"] == 0.3
    assert all(e.perturbed is not None and e.causal_shift_m is not None for e in alone.episodes)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["stopped", "whole"]


def test_every_ego_drives(tmp_path: Path):
    env = make_env(ENV_ID)
    PPO("MlpPolicy", env, n_steps=4, batch_size=4, policy_kwargs={"net_arch": [4]}, device="cpu").save(tmp_path / "p")
    egos = ("random", "idle", "varied", str(tmp_path / "p.zip"))
    episodes = list(collect.collect(config(episodes=4, driver=egos)))
    assert tuple(e.label for e in episodes) == egos
    (kept,) = collect.collect(config(episodes=1, env_id="racetrack-v1", driver=("keep-lane",)))
    assert kept.label == "keep-lane"
    assert all(np.isfinite(e.states).all() and e.valid[:, 0].all() for e in [*episodes, kept])


def test_a_policy_trained_on_forecasts_drives_the_same_each_time(tmp_path: Path, highway_checkpoint: str):
    ego = (str(save_forecast_policy(tmp_path, ENV_ID, highway_checkpoint)),)
    first = list(collect.collect(config(episodes=2, seed=8, driver=ego)))
    (alone,) = collect.collect(config(episodes=1, seed=9, driver=ego))
    assert_same_episodes([alone], first[1:])
    assert first[0].valid[:, 0].all()


def test_overwrite_replaces_the_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture):
    base = ["--env-id", ENV_ID, "--out", str(tmp_path / "s"), "--workers", "1", "--max-steps", "1", "--episodes", "1"]
    for seed, extra in ((1, []), (2, ["--overwrite"])):
        code, _, _ = run_command(collect.main, [*base, "--seed", str(seed), *extra], monkeypatch, capsys)
        assert code == 0
        assert read_store(tmp_path / "s").episodes[0].seed == seed


def test_labels_can_be_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture):
    arguments = ["--env-id", ENV_ID, "--out", str(tmp_path / "s"), "--workers", "1", "--max-steps", "1"]
    code, _, _ = run_command(collect.main, [*arguments, "--episodes", "1", "--no-labels"], monkeypatch, capsys)
    assert code == 0
    store = read_store(tmp_path / "s")
    assert store.info.edge_attribute_names == ()
    assert (store.episodes[0].edge_types, store.episodes[0].edge_attributes) == (None, None)
    batch = Windows(store.episodes, store.info.spec, 1, 1).batch(np.array([0]))
    assert (batch.edge_types, batch.edge_attributes) == (None, None)


# --- Many learners ----------------------------------------------------------------------------------------------------


def test_an_episode_of_many_learners_is_what_the_simulator_did():
    (episode,) = collect.collect(config(episodes=1, env_id=TAG, driver=("idle",), seed=11))
    env = make_multiagent_env(TAG)
    env.reset(seed=11)
    reader = multiagent_reader_for(env)
    assert (episode.label, episode.seed, len(episode.states)) == ("idle", 11, STEPS + 1)
    assert (episode.edge_types, episode.edge_attributes) == (None, None)
    assert episode.valid.all()
    for t in range(STEPS + 1):
        truth = reader.read(env).scene
        assert episode.ids.tolist() == truth.ids.tolist()
        np.testing.assert_allclose(episode.states[t], truth.states, rtol=1e-6, atol=1e-12)
        env.step({name: 0 for name in env.agents})


def test_an_episode_of_many_learners_ends_with_its_last_scene():
    (episode,) = collect.collect(config(episodes=1, env_id=TAG, driver=("random",), max_steps=200))
    assert len(episode.states) == 26  # mpe2 stops after 25 cycles
    assert episode.valid.all()


def test_many_learners_are_recorded_without_labels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    """Drivers take turns; labels are asked for, but no simulator of many learners knows its edges."""
    arguments = ["--env-id", TAG, "--out", str(tmp_path / "s"), "--episodes", "4", "--seed", "30", "--workers", "1"]
    code, errors, output = run_command(collect.main, [*arguments, "--max-steps", "5"], monkeypatch, capsys)
    assert (code, errors) == (0, [])
    assert "4 episodes, 24 scenes, seeds 30–33" in output
    store = read_store(tmp_path / "s")
    assert store.info.spec == multiagent_reader_for(make_multiagent_env(TAG)).spec
    assert (store.info.spec.has_ego, store.info.source) == (False, TAG)
    assert store.info.edge_attribute_names == ()
    assert all(e.edge_types is None for e in store.episodes)
    assert [e.label for e in store.episodes] == ["heuristic", "mixed", "varied", "heuristic"]
    again = list(collect.collect(config(episodes=4, env_id=TAG, seed=30, max_steps=5)))
    assert_same_episodes(again, store.episodes)
    landmark = store.info.spec.feature_names.index("landmark")
    still = store.episodes[0].states[0, :, landmark] == 1
    moved = np.ptp(store.episodes[0].states[..., :2], axis=0).max(-1)
    assert (moved[still] == 0).all() and (moved[~still] > 0).all()


def test_options_reach_the_recording_and_its_processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    settings = CollectConfig(
        TAG, tmp_path / "s", workers=2, timeout_s=7.0, branches=2, branch_history_steps=4, causal_senders=3,
        causal_threshold_m=0.2, causal_horizon_s=0.7,
    )  # fmt: skip
    made = collect.recording_of(settings)
    assert made.branches is not None and made.causal is made.branches.causal
    assert (made.branches.branches, made.branches.history_steps) == (2, 4)
    assert (made.causal.senders, made.causal.threshold_m, made.causal.horizon_s) == (3, 0.2, 0.7)
    asked: list[tuple[Any, ...]] = []
    monkeypatch.setattr(collect, "episode_pool", lambda *given: asked.append(given) or nullcontext())
    with collect.open_pool(settings):
        pass
    assert [given[1:4] for given in asked] == [(2, 7.0, "stop")]


ERRORS = {
    "unknown-id": (["--env-id", "nope-v0"], "cannot make env 'nope-v0'"),
    "unknown-version": (["--env-id", "merge-v9"], "cannot make env 'merge-v9'"),
    "another-family": (["--env-id", "CartPole-v1"], "no scene reader knows CartPoleEnv"),
    "zero-episodes": (["--episodes", "0"], "episodes must be at least 1, got 0"),
    "negative-steps": (["--max-steps", "-1"], "max_steps must be at least 1, got -1"),
    "zero-workers": (["--workers", "0"], "workers must be at least 1, got 0"),
    "negative-seed": (["--seed", "-1"], "seed must not be negative, got -1"),
    "share-above-one": (["--perturb", "1.5"], "perturb must lie between 0 and 1, got 1.5"),
    "kinds-of-nothing": (["--perturb-kinds", "brake"], "perturb_kinds needs perturb above 0, got 0"),
    "negative-labels": (["--causal-labels", "-1"], "causal_labels must not be negative, got -1"),
    "long-horizon": (["--causal-labels", "1", "--causal-horizon-s", "3601"], "causal_horizon_s must be at most 3,600"),
    "senders-of-nothing": (["--causal-senders", "3"], "causal_senders needs causal_labels or branches above 0, got 0"),
    "history-of-nothing": (["--branch-history-steps", "20"], "branch_history_steps needs branches above 0, got 0"),
    "horizon-of-branches": (
        ["--branches", "2", "--causal-horizon-s", "6"],
        "a branch is played for 5 s, got causal_hor",
    ),
    "horizon-of-nothing": (["--causal-horizon-s", "2"], "causal_horizon_s and causal_threshold_m need causal_labels"),
    "no-senders": (["--causal-labels", "2", "--causal-senders", "0"], "causal_senders must be at least 1, got 0"),
    "no-lanes": (
        ["--env-id", TAG, "--perturb", "0.2", "--perturb-kinds", "left"],
        "perturb_kinds must be among brake, accelerate, remove in this environment, got left",
    ),
    "grid-world": (["--env-id", "pursuit_v5", "--perturb", "0.2"], "raw_env cannot be perturbed; use an environment"),
    "unknown-ego": (["--driver", "random", "reckless"], "driver must be one of random, idle,"),
    "unfit-ego": (["--driver", "keep-lane"], "keep-lane needs continuous steering"),
    "missing-policy": (["--driver", "absent.zip"], "no policy at absent.zip"),
    "unknown-driver": (["--env-id", TAG, "--driver", "heuristic", "reckless"], "driver must be one of random, idle,"),
    "unfit-driver": (["--env-id", TAG, "--driver", "keep-lane"], "driver must be one of random, idle,"),
    "policy-among-many": (["--env-id", TAG, "--driver", "absent.zip"], "no policy at absent.zip"),
    "nothing-moves": (["--env-id", "mpe2.simple_crypto_v3:parallel_env"], "nothing moves in simple_crypto"),
}


@pytest.mark.parametrize("case", ERRORS)
def test_bad_input_is_one_line_and_leaves_nothing(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    arguments, message = ERRORS[case]
    base = ["--env-id", ENV_ID, "--out", str(tmp_path / "store"), "--workers", "1", "--episodes", "1"]
    code, errors, output = run_command(collect.main, [*base, *arguments], monkeypatch, capsys)
    assert code == 2
    assert len(errors) == 1
    assert errors[0].startswith(f"error: {message}")
    assert output == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_policy_of_another_env_is_one_line(
    tmp_path: Path, highway_checkpoint: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    policy = save_forecast_policy(tmp_path, ENV_ID, highway_checkpoint)
    arguments = ["--env-id", "intersection-v2", "--out", str(tmp_path / "store"), "--driver", str(policy)]
    code, errors, _ = run_command(collect.main, arguments, monkeypatch, capsys)
    assert code == 2
    assert len(errors) == 1
    assert errors[0].startswith(f"error: policy {policy} was trained on Dict(")
    assert not (tmp_path / "store").exists()


def test_an_existing_store_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture):
    out = tmp_path / "store"
    out.mkdir()
    (out / "mine.txt").write_text("keep")
    arguments = ["--env-id", ENV_ID, "--out", str(out), "--workers", "1", "--episodes", "1"]
    code, errors, _ = run_command(collect.main, arguments, monkeypatch, capsys)
    assert code == 2
    assert errors == [f"error: {out} exists; choose another path or pass --overwrite"]
    assert [p.name for p in tmp_path.rglob("*")] == ["store", "mine.txt"]
    assert (out / "mine.txt").read_text() == "keep"


def test_ranges_are_checked_before_anything_runs():
    config(episodes=1, max_steps=1)
    with pytest.raises(UserError, match="episodes must be at least 1, got 0"):
        config(episodes=0)
