"""Environments that misbehave, in the commands that play them: one line, and what was recorded stays."""

import copy
import multiprocessing
import pickle
import re
from pathlib import Path

import numpy as np
import pytest

import train_policy
from agents import evaluate as agents_evaluate
from agents.task import SELECTION_SEED
from envs import collect, evaluate, supervision
from envs.supervision import NUMBERS, EnvironmentFailedError, Place, SupervisedEnv, check_numbers
from predictor.data.store import read_store
from predictor.support.errors import UserError
from tests.envs.helpers import run_command
from tests.envs.misbehaving import NUM_STEPS, Misbehaving, env_id

Patch, Caught = pytest.MonkeyPatch, pytest.CaptureFixture[str]


@pytest.mark.slow
def test_collection_stops_at_an_environment_that_raises_and_goes_on_without_it(
    tmp_path: Path, monkeypatch: Patch, capsys: Caught
):
    """The episodes before it are kept; the one that failed is counted, printed and named in the store."""
    base = ["--env-id", env_id("Raise"), "--out", str(tmp_path / "store"), "--driver", "random", "--seed", "1"]
    base += ["--episodes", "5", "--workers", "1"]
    code, errors, _ = run_command(collect.main, base, monkeypatch, capsys)
    assert code == 2
    (line,) = errors
    assert line.startswith(f"error: {env_id('Raise')}, seed 3, step 2: RuntimeError: the simulator broke (")
    assert not (tmp_path / "store").exists()
    code, errors, output = run_command(collect.main, [*base, "--on-error", "skip"], monkeypatch, capsys)
    assert (code, errors) == (0, [])
    assert "4 episodes (2 of them from an unfinished recording)" in output
    assert "skipped: 1 of 5 seeds, whose environment failed" in output
    store = read_store(tmp_path / "store")
    assert [e.seed for e in store.episodes] == [1, 2, 4, 5]
    assert all(len(e.states) == NUM_STEPS + 1 for e in store.episodes)
    skipped = store.info.provenance["skipped"]
    assert skipped["episodes"] == 1 and "seed 3, step 2" in skipped["reasons"]["3"]
    assert [path.name for path in tmp_path.iterdir()] == ["store"]
    assert not multiprocessing.active_children()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "message"),
    [("Raise", "all 1 episodes failed, the first so: "), ("ExitReset", "none of the first 1 seeds can be played: ")],
)
def test_a_recording_of_which_nothing_is_left_says_why(
    kind: str, message: str, tmp_path: Path, monkeypatch: Patch, capsys: Caught
):
    base = ["--env-id", env_id(kind), "--out", str(tmp_path / "store"), "--driver", "random", "--seed", "3"]
    base += ["--episodes", "1", "--on-error", "skip"]
    code, errors, _ = run_command(collect.main, base, monkeypatch, capsys)
    (line,) = errors
    assert code == 2 and line.startswith(f"error: {message}{env_id(kind)}, seed 3, ")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_an_evaluation_names_an_environment_that_dies(tmp_path: Path, monkeypatch: Patch, capsys: Caught):
    words = ["--env-ids", env_id("Exit"), "--checkpoint", "constant-velocity", "--horizon-steps", "2", "--seed", "3"]
    words += ["--episodes", "1", "--workers", "1", "--out", str(tmp_path / "out")]
    code, errors, _ = run_command(evaluate.main, words, monkeypatch, capsys)
    assert (code, errors) == (2, [f"error: {env_id('Exit')}, seed 3, step 2: its process ended with status 3"])
    assert not multiprocessing.active_children()


@pytest.mark.slow
def test_an_evaluation_of_policies_names_an_environment_that_dies(tmp_path: Path, monkeypatch: Patch, capsys: Caught):
    words = ["--env-id", env_id("Exit"), "--policy", "random", "--episodes", "2", "--num-envs", "2", "--seed", "2"]
    code, errors, _ = run_command(
        agents_evaluate.main, [*words, "--drivers", "none", "--out", str(tmp_path / "out")], monkeypatch, capsys
    )
    assert code == 2
    assert errors == [f"error: {env_id('Exit')}, environment 1, seed 3, step 2: its process ended with status 3"]
    assert not multiprocessing.active_children() and not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:rich is experimental")
@pytest.mark.parametrize(("kind", "num_envs", "seed"), [("Raise", 1, 3), ("NanReward", 1, 3), ("Kill", 2, 0)])
def test_a_training_names_an_environment_that_misbehaves(
    kind: str, num_envs: int, seed: int, tmp_path: Path, monkeypatch: Patch, capsys: Caught
):
    """With the seed of its episode, drawn from the training's; these trainings begin with a multiple of three."""
    words = ["--env-id", env_id(kind), "--observe", "none", "--out", str(tmp_path / "run"), "--num-envs", str(num_envs)]
    words += ["--steps", "64", "--seed", str(seed), "--set", "n_steps=32", "batch_size=32", "--selection-episodes", "1"]
    code, errors, _ = run_command(train_policy.main, [*words, "--no-video"], monkeypatch, capsys)
    assert code == 2
    (line,) = errors
    (named,) = re.findall(r"seed (\d+), step 2: ", line)
    assert line.startswith(f"error: {env_id(kind)}, ") and int(named) % 3 == 0 and int(named) < SELECTION_SEED
    assert not multiprocessing.active_children()


@pytest.mark.parametrize("kind", ["NanReward", "NanObservation"])
def test_nan_is_refused_where_it_appears(kind: str):
    env = SupervisedEnv(Misbehaving(kind), "toy-v0")
    for seed, is_bad in ((1, False), (3, True)):
        env.reset(seed=seed)
        env.step(0)
        if is_bad:
            with pytest.raises(EnvironmentFailedError, match=r"^toy-v0, seed 3, step 2: the (reward|observation) must"):
                env.step(0)
        else:
            assert np.isfinite(env.step(0)[1])


@pytest.mark.parametrize(("number", "name"), [(np.nan, "NaN"), (np.inf, "infinity"), (-np.inf, "infinity")])
def test_numbers_that_are_not_finite_are_named(number: float, name: str):
    with pytest.raises(UserError, match=f"the reward must be a finite number, got {name}"):
        check_numbers(np.zeros(2), number)
    for seen in (np.array([1, number]), {"a": 1, "b": (np.zeros(1), np.float32(number))}):
        with pytest.raises(UserError, match=f"the observation must be of finite numbers, got {name}"):
            check_numbers(seen)
    check_numbers({"a": np.array([np.finfo(np.float32).max]), "b": "text"}, 1e30)


def test_a_copy_of_a_place_counts_for_itself():
    """As environments are copied with all they hold; memory that processes share could not be."""
    numbers = multiprocessing.get_context("spawn").RawArray("q", NUMBERS)
    place = Place(numbers)
    place.begin(7)
    for other in (copy.deepcopy(place), pickle.loads(pickle.dumps(place))):
        other.move()
        assert (str(other), str(place)) == ("seed 7, step 1", "seed 7, its reset")


def test_who_looks_for_a_hang_sees_that_a_copy_moves(monkeypatch: pytest.MonkeyPatch):
    """A process that plays branches is not hanging, however long they take."""
    monkeypatch.setattr(supervision, "_shared", None)
    place = supervision.share(multiprocessing.get_context("spawn").RawArray("q", NUMBERS))
    place.begin(7)
    before, other = place.moves, copy.deepcopy(place)
    other.move()
    assert place.moves == before + 1 and str(place) == "seed 7, its reset"
    place.move()
    assert place.moves == before + 2


def test_a_place_says_where_an_episode_is():
    place, said = Place(), []
    said.append(str(place))
    place.begin(7)
    said.append(str(place))
    place.move()
    said.append(str(place))
    place.begin(None)
    place.move()
    place.move()
    said.append(str(place))
    assert said == ["before its first reset", "seed 7, its reset", "seed 7, step 1", "seed 7, episode 2, step 2"]
    unseeded = Place()
    unseeded.begin(None)
    assert str(unseeded) == "episode 1, its reset"
