import json
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from agents.algorithms import DivergedError, check_finite, even_batches
from agents.arena import EgoArena
from agents.features import ForecastAttention
from agents.presets import (
    A2CPreset,
    Algorithm,
    DQNPreset,
    PPOPreset,
    QRDQNPreset,
    RecurrentPPOPreset,
    SACPreset,
    TQCPreset,
    preset_for,
)
from agents.runs import load_model, save_model
from agents.task import EVALUATION_SEED, SELECTION_SEED, Task
from agents.training import (
    SaveCheckpoint,
    SelectBest,
    TrainingPlan,
    driving_scalars,
    make_model,
    read_curve,
    train,
)
from agents.vec_envs import EpisodeResult, SeededEpisodes, make_venv
from envs.rollouts.loop_errors import LoopErrors
from envs.sb3.algorithms import algorithm_class
from envs.sb3.policy_file import read_note, read_policy_note
from predictor.support.errors import UserError
from tests.agents.helpers import STEERING
from tests.agents.studies.helpers import TOY, Corridor

CONSTANT_VELOCITY = Task("highway-fast-v0", "constant-velocity")


class Coin(gym.Env[np.ndarray, np.int64]):
    """Environment with episodes of three steps and a reward for action 1."""

    observation_space = gym.spaces.Box(0, 1, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._steps += 1
        return np.zeros(1, np.float32), float(action), self._steps == 3, False, {}


@pytest.fixture
def make_selection(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], EgoArena]:
    """Function from a number of environments to an arena of coins."""

    def make_venv(task: Task, num_envs: int, seeded: bool, in_process: bool) -> VecMonitor:
        assert seeded
        return VecMonitor(DummyVecEnv([lambda: SeededEpisodes(Coin())] * num_envs))

    monkeypatch.setattr("agents.arena.make_venv", make_venv)
    return lambda num_envs: EgoArena(CONSTANT_VELOCITY, num_envs)


def make_ppo() -> PPO:
    venv = VecMonitor(DummyVecEnv([Coin]))
    return PPO("MlpPolicy", venv, n_steps=8, batch_size=8, n_epochs=1, seed=0, device="cpu")


def plan(**changes: Any) -> TrainingPlan:
    defaults = {"task": CONSTANT_VELOCITY, "algorithm": "ppo", "steps": 10, "num_envs": 1, "seed": 0}
    return TrainingPlan(**(defaults | changes))


@pytest.mark.parametrize("num_envs", [1, 2, 3])
def test_every_selection_plays_the_same_seeds(
    num_envs: int, make_selection: Callable[[int], EgoArena], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    played: list[int] = []
    queue = SeededEpisodes.queue

    def note(self: SeededEpisodes, seeds: Sequence[int], ego: str | None = None) -> None:
        played.extend(seeds)
        queue(self, seeds, ego)

    monkeypatch.setattr(SeededEpisodes, "queue", note)
    make_ppo().learn(32, callback=SelectBest(make_selection(num_envs), tmp_path / "best.zip", 5, every_steps=16))
    seeds = [SELECTION_SEED + i for i in range(5)]
    assert [sorted(played[:5]), sorted(played[5:])] == [seeds, seeds]  # environments take turns


def test_there_is_always_a_selection_at_the_end(make_selection: Callable[[int], EgoArena], tmp_path: Path):
    make_ppo().learn(24, callback=SelectBest(make_selection(1), tmp_path / "best.zip", 2, every_steps=1000))
    assert read_note(tmp_path / "best.zip")["steps"] == 24


@pytest.mark.parametrize(
    ("steps", "selections", "expected"),
    [(10, 3, [4, 7, 10]), (9, 2, [5, 9]), (3, 5, [1, 2, 3]), (10, 6, [2, 4, 5, 7, 9, 10])],
)
def test_a_policy_is_measured_as_often_as_it_is_said(
    steps: int, selections: int, expected: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """At most once after each update; the DQN updates after each step."""
    measured = list[int]()
    monkeypatch.setattr(SelectBest, "_measure", lambda self: measured.append(self.num_timesteps) or note(self))

    def note(select: SelectBest) -> None:
        select._measured_at = select.num_timesteps

    settings = {"learning_starts": 0, "net_arch": (4,), "batch_size": 2}
    train(
        plan(algorithm="dqn", steps=steps, selections=selections, settings=settings, in_process=True), tmp_path, False
    )
    assert measured == expected


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": "0"}, "seed must be a whole number, got '0'"),
        ({"steps": 1.5}, "steps must be a whole number, got 1.5"),
        ({"settings": {"nosuch": 1}}, "ppo has no hyperparameter 'nosuch'; there are learning_rate, gamma"),
        ({"settings": {"gamma": "x"}}, "ppo: gamma must be a number, got 'x'"),
    ],
)
def test_values_of_other_types_are_refused(changes: dict[str, Any], message: str):
    with pytest.raises(UserError, match=message):
        plan(**changes)


def test_presets_of_what_there_is_not_are_refused():
    with pytest.raises(UserError, match="algorithm must be one of ppo, .*, got 'nosuch'"):
        preset_for("merge-v1", "nosuch")  # type: ignore[arg-type]
    with pytest.raises(UserError, match="backend must be one of gymnasium, envpool, got 'nosuch'"):
        preset_for("merge-v1", "ppo", "nosuch")  # type: ignore[arg-type]


def test_steps_that_teach_nothing_are_refused():
    with pytest.raises(
        UserError, match=r"dqn makes its first update after learning_starts=200 steps, so 200 steps teach"
    ):
        plan(algorithm="dqn", steps=200)
    assert plan(algorithm="dqn", steps=201).steps == 201
    assert plan(algorithm="dqn", steps=200, settings={"learning_starts": 199}).steps == 200
    early = {"learning_starts": 10, "train_freq": 65}
    with pytest.raises(UserError, match=r"dqn makes an update every train_freq=65 steps .* so 64 steps teach it"):
        plan(algorithm="dqn", steps=64, settings=early)
    assert plan(algorithm="dqn", steps=65, settings=early).steps == 65


@pytest.mark.parametrize("every_steps", [2, 8])
def test_each_measurement_is_of_a_model_that_has_learned_from_all_that_it_collected(every_steps: int, tmp_path: Path):
    """The last one, too, and none is of a model that was measured already."""
    model, arena, updates = make_ppo(), Scripted([0.0], [0.0], [0.0]), list[int]()
    play = arena.play
    arena.play = lambda policy, seeds, _=None: updates.append(policy._n_updates) or play(policy, seeds)  # type: ignore[method-assign]
    curve = tmp_path / "curve.json"
    model.learn(24, callback=SelectBest(arena, tmp_path / "best.zip", 1, every_steps=every_steps, curve=curve))
    assert updates == [1, 2, 3] and [point["steps"] for point in read_curve(curve)] == [8, 16, 24]
    kept = PPO.load(tmp_path / "best.zip", device="cpu")
    for name, weights in model.policy.state_dict().items():
        assert torch.equal(weights, kept.policy.state_dict()[name]), name


@pytest.mark.parametrize(
    ("measured_at", "every", "expected"), [([8], 24, [8, 24, 48]), ([], 16, [16, 32, 48]), ([8], 20, [8, 24, 40, 48])]
)
def test_measurements_go_on_from_the_last_one_not_from_the_checkpoint(
    measured_at: list[int], every: int, expected: list[int], tmp_path: Path
):
    """Resumed at step 16."""
    model, curve = make_ppo(), tmp_path / "curve.json"
    model.learn(16)
    curve.write_text(json.dumps([{"steps": step, "return": 0.0} for step in measured_at]))
    select = SelectBest(Scripted(*[[0.0]] * 4), tmp_path / "best.zip", 1, every_steps=every, curve=curve)
    model.learn(32, reset_num_timesteps=False, callback=select)
    assert [point["steps"] for point in read_curve(curve)] == expected


class Scripted:
    """Arena with given results: one list of returns per measurement."""

    baselines = ()

    def __init__(self, *measurements: list[float]) -> None:
        self.measurements, self.seeds = list(measurements), list[range]()

    def play(self, policy: Any, seeds: Any, on_episode: Any = None) -> list[EpisodeResult]:
        self.seeds.append(seeds)
        returns = self.measurements.pop(0)
        return [EpisodeResult(s, value, 3, None, float("nan")) for s, value in zip(seeds, returns, strict=True)]

    def close(self) -> None: ...


@pytest.mark.parametrize(
    ("measured", "kept"),
    [
        ([[2.0, 4.0], [2.0, 3.9]], 8),
        ([[2.0, 3.9], [2.0, 4.0]], 16),
        ([[2.0, 4.0], [4.0, 2.0]], 16),
        ([[2.0, 4.0], [5.0, 0.0], [3.0, 2.9], [1.0, 1.0]], 8),
        ([[2.0, 4.0], [0.0, 0.0], [3.0, 3.5], [3.0, 3.0]], 24),
    ],
    ids=["lower by little", "higher by little", "equal", "falls", "recovers"],
)
def test_the_model_with_the_highest_mean_is_kept(measured: list[list[float]], kept: int, tmp_path: Path):
    arena, path = Scripted(*measured), tmp_path / "best.zip"
    make_ppo().learn(8 * len(measured), callback=SelectBest(arena, path, 2, every_steps=8))
    assert arena.measurements == []
    assert set(arena.seeds) == {range(SELECTION_SEED, SELECTION_SEED + 2)}
    note = read_note(path)
    assert note["steps"] == kept == PPO.load(path, device="cpu").num_timesteps
    assert note["selection_return"] == pytest.approx(np.mean(measured[kept // 8 - 1]))


@pytest.mark.parametrize(("stored", "replaced"), [(-1.0, True), (100.0, False)], ids=["worse", "better"])
def test_the_best_result_of_an_earlier_start_counts(
    stored: float, replaced: bool, make_selection: Callable[[int], EgoArena], tmp_path: Path
):
    path = tmp_path / "best.zip"
    save_model(make_ppo(), path, {"selection_return": stored, "steps": 0})
    model = make_ppo()
    model.num_timesteps = 8
    model.learn(8, callback=SelectBest(make_selection(1), path, 2, every_steps=8), reset_num_timesteps=False)
    assert (read_note(path)["steps"] == 16) is replaced


def test_a_training_that_begins_anew_does_not_compare_with_a_lost_one(
    make_selection: Callable[[int], EgoArena], tmp_path: Path
):
    path = tmp_path / "best.zip"
    save_model(make_ppo(), path, {"selection_return": 100.0, "steps": 24})
    make_ppo().learn(8, callback=SelectBest(make_selection(1), path, 2, every_steps=8))
    assert read_note(path)["steps"] == 8


def test_damaged_best_model_is_one_clear_line(make_selection: Callable[[int], EgoArena], tmp_path: Path):
    (tmp_path / "best.zip").write_bytes(b"not a zip")
    with pytest.raises(UserError, match="is damaged; remove it"):
        make_ppo().learn(8, callback=SelectBest(make_selection(1), tmp_path / "best.zip", 2, every_steps=8))


def test_a_damaged_best_model_does_not_become_the_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """As after a kill between the last update and the copy; without the file the last model stands for it."""
    monkeypatch.setattr("agents.training.preset_for", lambda *_: PPOPreset(n_steps=8, batch_size=8, n_epochs=1))
    training = plan(steps=16, selections=1, selection_episodes=1, selection_envs=1, in_process=True)
    policy, best = train(training, tmp_path), tmp_path / "best_model.zip"
    policy.unlink()
    best.write_bytes(best.read_bytes()[:500])
    for _ in range(2):
        with pytest.raises(UserError, match="best_model.zip is damaged; remove it to go on without it"):
            train(training, tmp_path)
        assert not policy.exists()
    best.unlink()
    assert load_model(train(training, tmp_path), "ppo").num_timesteps == 16


def test_a_best_model_with_a_wrong_byte_does_not_replace_the_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("agents.training.preset_for", lambda *_: PPOPreset(n_steps=8, batch_size=8, n_epochs=1))
    training = plan(steps=16, selections=1, selection_episodes=1, selection_envs=1, in_process=True)
    policy, best = train(training, tmp_path), tmp_path / "best_model.zip"
    good, content = policy.read_bytes(), bytearray(best.read_bytes())
    with zipfile.ZipFile(best) as archive:
        later = archive.start_dir + 10  # how the first entry is compressed, by the list of entries
    for place in (len(content) // 2, later):
        damaged = content.copy()
        damaged[place] ^= 0xFF
        best.write_bytes(damaged)
        with pytest.raises(UserError, match="best_model.zip is damaged; remove it to go on without it"):
            train(training, tmp_path)
        assert policy.read_bytes() == good


def test_a_damaged_checkpoint_says_what_to_do_and_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("agents.training.preset_for", lambda *_: PPOPreset(n_steps=8, batch_size=8, n_epochs=1))
    training = plan(steps=16, selections=1, selection_episodes=1, selection_envs=1, in_process=True)
    train(training, tmp_path)
    checkpoint = tmp_path / "checkpoint.zip"
    save_model(make_ppo(), checkpoint, to_continue=True)
    checkpoint.write_bytes(checkpoint.read_bytes()[:500])
    before = {file: file.read_bytes() for file in tmp_path.glob("*.zip")}
    with pytest.raises(UserError, match="checkpoint.zip is damaged; remove it: the training has ended, with polic"):
        train(training, tmp_path)
    assert {file: file.read_bytes() for file in tmp_path.glob("*.zip")} == before
    (tmp_path / "policy.zip").unlink()
    with pytest.raises(UserError, match="damaged; remove it to train anew; copy best_model.zip first"):
        train(training, tmp_path)


def test_checkpoints_are_taken_between_updates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    saved: list[int] = []

    def note_steps(model: PPO, path: Path, extra: Any, note: Any, to_continue: bool) -> None:
        saved.append(model.num_timesteps)

    monkeypatch.setattr("agents.training.save_model", note_steps)
    make_ppo().learn(40, callback=SaveCheckpoint(tmp_path / "checkpoint.zip", every_steps=12))
    assert saved == [16, 32]


def test_a_checkpoint_goes_with_each_model_that_is_kept(make_selection: Callable[[int], EgoArena], tmp_path: Path):
    """A resumed training otherwise compares with a model of steps that it does not have."""
    select = SelectBest(make_selection(1), tmp_path / "best.zip", 2, every_steps=16)
    save = SaveCheckpoint(tmp_path / "checkpoint.zip", every_steps=1000, also=select.has_kept)
    make_ppo().learn(24, callback=CallbackList([select, save]))
    assert load_model(tmp_path / "checkpoint.zip", "ppo").num_timesteps == 16


def test_seeds_of_training_selection_and_evaluation_are_apart():
    assert plan(seed=SELECTION_SEED - 1).seed < SELECTION_SEED < EVALUATION_SEED
    with pytest.raises(UserError, match="seed must lie in"):
        plan(seed=SELECTION_SEED)


@pytest.mark.parametrize(
    "field", ["steps", "num_envs", "selections", "selection_episodes", "selection_envs", "checkpoint_every"]
)
def test_numbers_below_one_are_refused(field: str):
    assert getattr(plan(**{field: 1}), field) == 1
    with pytest.raises(UserError, match=f"{field} must be at least 1, got 0"):
        plan(**{field: 0})


def test_dqn_needs_discrete_actions():
    space = gym.spaces.Box(-1, 1, (2,), np.float32)
    plan(algorithm="ppo").check_spaces(space, space)
    with pytest.raises(UserError, match="dqn needs a discrete action space, highway-fast-v0 has Box"):
        plan(algorithm="dqn", steps=201).check_spaces(space, space)
    with pytest.raises(UserError, match="a policy reads arrays .* highway-fast-v0 has Tuple"):
        plan(algorithm="ppo").check_spaces(gym.spaces.Tuple([space]), space)


def test_models_follow_their_preset():
    venv = make_venv(CONSTANT_VELOCITY, 1)
    ppo = make_model(plan(), venv)
    assert isinstance(ppo, PPO)
    assert (ppo.n_steps, ppo.batch_size, ppo.gamma, ppo.learning_rate) == (128, 64, 0.8, 5e-4)
    assert isinstance(ppo.policy.features_extractor, ForecastAttention)
    dqn = make_model(plan(algorithm="dqn", steps=201), venv)
    assert isinstance(dqn, DQN)
    assert (dqn.buffer_size, dqn.learning_starts, dqn.target_update_interval) == (15_000, 200, 50)
    venv.close()


def test_presets():
    assert preset_for("highway-fast-v0", "ppo") == PPOPreset()
    assert preset_for("merge-v1", "dqn") == DQNPreset()
    assert preset_for("crossing_reader:Crossing-v0", "ppo").gamma == preset_for("Pendulum-v1", "sac").gamma == 0.99
    assert preset_for("lane-keeping-v0", "ppo").gamma == preset_for("highway_env:parking-v0", "sac").gamma == 0.8
    assert preset_for("racetrack-oval-v1", "ppo").gamma == 0.9
    particles = preset_for("simple_tag_v3", "ppo")
    assert (particles.gamma, particles.n_steps) == (0.95, 25)  # type: ignore[union-attr]
    assert preset_for("intersection-multi-agent-v2", "ppo").n_steps == 100  # type: ignore[union-attr]
    assert preset_for("simple_tag_v3", "dqn") == DQNPreset(gamma=0.95)
    envpool = preset_for("highway-fast-v0", "ppo", "envpool")
    assert (envpool.gamma, envpool.batch_size) == (0.8, 512)
    assert preset_for("racetrack-v1", "ppo", "envpool").gamma == 0.9
    assert preset_for("highway-fast-v0", "dqn", "envpool") == DQNPreset()


@pytest.mark.slow
def test_same_seed_same_policy(monkeypatch: pytest.MonkeyPatch):
    short = replace(preset_for("highway-fast-v0", "ppo"), n_steps=16, batch_size=8, n_epochs=2)  # type: ignore[call-arg]
    monkeypatch.setattr("agents.training.preset_for", lambda *arguments: short)

    def trained() -> dict[str, torch.Tensor]:
        venv = make_venv(CONSTANT_VELOCITY, 1)
        model = make_model(plan(seed=3), venv)
        model.learn(32)
        venv.close()
        return model.policy.state_dict()

    first, second = trained(), trained()
    assert first.keys() == second.keys()
    for name, value in first.items():
        torch.testing.assert_close(second[name], value, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("rollout", "most", "batch"),
    [
        (4800, 480, 480),
        (75, 480, 75),
        (600, 480, 300),
        (1600, 480, 400),
        (7, 4, 4),
        (3, 2, 3),
        (7, 3, 4),
        (65, 64, 63),
        (193, 64, 63),
    ],
)
def test_batches_divide_a_rollout_or_leave_more_than_one_sample(rollout: int, most: int, batch: int):
    assert even_batches(rollout, most) == batch


def test_a_batch_is_never_larger_than_a_rollout():
    """EnvPool's preset is made for many environments; with few, SB3 would warn of a cut batch."""
    pytest.importorskip("envpool")
    task = Task("highway-fast-v0", "none", backend="envpool")
    few = TrainingPlan(task, "ppo", 100, 2, 0)
    venv = DummyVecEnv([lambda: gym.make("CartPole-v1")] * 2)
    model = make_model(few, venv)
    assert few.preset.n_steps * 2 < few.preset.batch_size
    assert model.batch_size == few.preset.n_steps * 2


class Killed(Exception):
    """Stands for a kill."""


def dies_after(calls: int, kind: type, method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Raises `Killed` after so many calls of a method, once."""
    kept, left = getattr(kind, method), [calls]

    def call_and_die(self: Any) -> None:
        kept(self)
        left[0] -= 1
        if left[0] == 0:
            raise Killed

    monkeypatch.setattr(kind, method, call_and_die)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:rich is experimental")
@pytest.mark.parametrize(
    ("algorithm", "task", "preset"),
    [
        ("ppo", CONSTANT_VELOCITY, PPOPreset(n_steps=8, batch_size=8, n_epochs=2, net_arch=(8,))),
        ("ppo", Task("simple_spread_v3", "zeros"), PPOPreset(n_steps=8, batch_size=8, n_epochs=2, net_arch=(8,))),
        ("dqn", Task(TOY, "none"), DQNPreset(learning_starts=8, batch_size=4, net_arch=(8,))),
        ("a2c", Task(TOY, "none"), A2CPreset(n_steps=4, net_arch=(8,))),
        ("sac", Task(STEERING, "none"), SACPreset(learning_starts=8, batch_size=4, net_arch=(8,))),
        ("qrdqn", Task(TOY, "none"), QRDQNPreset(learning_starts=8, batch_size=4, net_arch=(8,), n_quantiles=5)),
        (
            "recurrent-ppo",
            Task(TOY, "none"),
            RecurrentPPOPreset(n_steps=8, batch_size=8, n_epochs=2, net_arch=(8,), lstm_hidden_size=4),
        ),
        ("tqc", Task(STEERING, "none"), TQCPreset(learning_starts=8, batch_size=4, net_arch=(8,), n_quantiles=5)),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_repeatable_run_that_was_killed_ends_as_one_that_was_not(
    algorithm: Algorithm, task: Task, preset: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Killed right after a measurement that no checkpoint has seen; every weight and every point is as without."""
    monkeypatch.setattr("agents.training.preset_for", lambda *_: preset)
    sizes = {"steps": 64, "num_envs": 2, "selections": 4, "selection_episodes": 1, "selection_envs": 1}
    training = plan(
        task=task, algorithm=algorithm, checkpoint_every=24, in_process=True, repeatable=True, seed=5, **sizes
    )
    for name in ("whole", "killed"):
        (tmp_path / name).mkdir()
    train(training, tmp_path / "whole")

    dies_after(3, SelectBest, "_measure", monkeypatch)
    with pytest.raises(Killed):
        train(training, tmp_path / "killed")
    saved = load_model(tmp_path / "killed" / "checkpoint.zip", algorithm).num_timesteps
    assert 0 < saved < 48, "the last measurement is younger than the checkpoint"
    train(training, tmp_path / "killed")

    whole, killed = (load_model(tmp_path / n / "checkpoint.zip", algorithm) for n in ("whole", "killed"))
    assert type(whole) is algorithm_class(algorithm)
    assert whole.num_timesteps == killed.num_timesteps >= 64
    for name, weights in whole.policy.state_dict().items():
        assert torch.equal(weights, killed.policy.state_dict()[name]), name
    points = [
        [{k: v for k, v in p.items() if k != "seconds"} for p in read_curve(tmp_path / n / "curve.json")]
        for n in ("whole", "killed")
    ]
    assert points[0] == points[1] and [p["steps"] for p in points[0]] == [16, 32, 48, 64]
    notes = [read_note(tmp_path / n / "policy.zip") for n in ("whole", "killed")]
    assert notes[0] == notes[1]


def test_runs_of_neighbouring_seeds_do_not_share_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    preset = PPOPreset(n_steps=4, batch_size=8, n_epochs=1, net_arch=(8,))
    monkeypatch.setattr("agents.training.preset_for", lambda *_: preset)
    begun: list[int] = []
    monkeypatch.setattr(Corridor, "reset", noted(Corridor.reset, begun))
    sizes = {"steps": 8, "num_envs": 8, "selections": 1, "selection_episodes": 1, "selection_envs": 1}
    of_seed = []
    for seed in (5, 6, 5):
        begun.clear()
        folder = tmp_path / str(len(of_seed))
        folder.mkdir()
        train(plan(task=Task(TOY, "none"), seed=seed, in_process=True, **sizes), folder)
        of_seed.append({number for number in begun if number < SELECTION_SEED})
    assert [len(seeds) for seeds in of_seed] == [8, 8, 8]
    assert of_seed[0] == of_seed[2] and not of_seed[0] & of_seed[1]


def noted(reset: Callable[..., Any], begun: list[int]) -> Callable[..., Any]:
    """Returns a reset that adds its seeds to a list."""

    def noting(self: Any, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        if seed is not None:
            begun.append(seed)
        return reset(self, seed=seed, options=options)

    return noting


def test_a_run_at_its_end_without_its_best_model_keeps_the_last(tmp_path: Path):
    """The best one was damaged, and removed as the message says."""
    training = plan(task=Task(TOY, "none"), in_process=True, num_envs=1, selections=1, selection_episodes=1, steps=8,
                    settings={"n_steps": 8, "batch_size": 8})  # fmt: skip
    train(training, tmp_path)
    (tmp_path / "best_model.zip").unlink()
    (tmp_path / "policy.zip").unlink()
    assert train(training, tmp_path) == tmp_path / "policy.zip"
    assert read_policy_note(tmp_path / "policy.zip") == training.task.note
    last, kept = (load_model(tmp_path / name, "ppo").policy.state_dict() for name in ("checkpoint.zip", "policy.zip"))
    for name, weights in last.items():
        assert torch.equal(weights, kept[name]), name


@pytest.mark.parametrize("gone", [("checkpoint.zip",), ("best_model.zip",), ("checkpoint.zip", "best_model.zip")])
def test_a_finished_run_keeps_its_policy_whatever_else_is_deleted(gone: tuple[str, ...], tmp_path: Path):
    """A checkpoint with a replay buffer is large, and the best model a copy of the policy."""
    training = plan(task=Task(TOY, "none"), in_process=True, num_envs=1, selections=1, selection_episodes=1, steps=8,
                    settings={"n_steps": 8, "batch_size": 8})  # fmt: skip
    train(training, tmp_path)
    for name in gone:
        (tmp_path / name).unlink()
    (tmp_path / "policy.zip").write_bytes(b"the one that was measured")
    curve = (tmp_path / "curve.json").read_bytes()
    assert train(training, tmp_path) == tmp_path / "policy.zip"
    assert (tmp_path / "policy.zip").read_bytes() == b"the one that was measured"
    assert (tmp_path / "curve.json").read_bytes() == curve


@pytest.mark.slow
def test_errors_in_the_loop_cover_all_steps_since_the_last_measurement(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Also those before a checkpoint, where environments start anew, and before a stop."""
    preset = PPOPreset(n_steps=8, batch_size=8, n_epochs=1, net_arch=(8,))
    monkeypatch.setattr("agents.training.preset_for", lambda *_: preset)
    counted: list[int] = []
    found = LoopErrors.errors_m
    monkeypatch.setattr(LoopErrors, "errors_m", lambda self: counted.append(self.sums()["counts"][0]) or found(self))
    sizes = {"steps": 64, "num_envs": 2, "selections": 1, "selection_episodes": 1, "selection_envs": 1}
    training = plan(task=CONSTANT_VELOCITY, checkpoint_every=16, in_process=True, repeatable=True, seed=5, **sizes)
    (tmp_path / "whole").mkdir()
    (tmp_path / "killed").mkdir()
    train(training, tmp_path / "whole")

    dies_after(3, SaveCheckpoint, "_on_rollout_start", monkeypatch)
    with pytest.raises(Killed):
        train(training, tmp_path / "killed")
    assert load_model(tmp_path / "killed" / "checkpoint.zip", "ppo").num_timesteps == 32
    train(training, tmp_path / "killed")
    whole, killed = counted
    assert whole == killed > 3 * 64, "five others in sight at most: the last 16 steps alone have no more than 80"


def test_a_damaged_curve_is_named(tmp_path: Path):
    (tmp_path / "curve.json").write_text("[{")
    with pytest.raises(UserError, match="curve.json is damaged; remove it to go on without it"):
        read_curve(tmp_path / "curve.json")
    assert read_curve(tmp_path / "absent.json") == []
    (tmp_path / "curve.json").write_text('[{"steps": 8, "return": 1.0}, {"steps": 8, "return": 2.0}]')
    with pytest.raises(UserError, match="curve.json is damaged; .*1: steps must rise, got 8"):
        read_curve(tmp_path / "curve.json")


def test_tensorboard_shows_crashes_speed_and_actions():
    """Two episodes of 1 and 3 steps; the second one reports no crash, and neither does a toy."""
    first = EpisodeResult(0, 1.0, 1, True, 20.0, action_counts={"idle": 1})
    second = EpisodeResult(1, 2.0, 3, False, 30.0, action_counts={"faster": 2, "idle": 1})
    shown = driving_scalars([first, second])
    assert shown == {"crash_rate": 0.5, "speed_mps": 25.0, "share_faster": 0.5, "share_idle": 0.5}
    assert driving_scalars([EpisodeResult(0, 1.0, 1, None, float("nan"))]) == {}


def test_tensorboard_draws_what_no_longer_happens_as_zero(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    happened: list[dict[str, Any]] = [
        {"crashed": True, "action_counts": {"faster": 1, "idle": 1}},
        {"crashed": None, "action_counts": {"idle": 2}},
    ]
    drawn: list[dict[str, Any]] = []
    select = SelectBest(Scripted([1.0], [1.0]), tmp_path / "best.zip", 1, every_steps=8)
    play = select._arena.play
    monkeypatch.setattr(select._arena, "play", lambda *args: [replace(e, **happened.pop(0)) for e in play(*args)])
    model = make_ppo()
    logger = configure(None, [])
    monkeypatch.setattr(logger, "dump", lambda step: drawn.append(dict(logger.name_to_value)))
    model.set_logger(logger)
    model.learn(16, callback=select)
    assert happened == []
    shown = [{key: one[f"eval/{key}"] for key in ("crash_rate", "share_faster", "share_idle")} for one in drawn[-2:]]
    assert shown == [
        {"crash_rate": 1.0, "share_faster": 0.5, "share_idle": 0.5},
        {"crash_rate": 0.0, "share_faster": 0.0, "share_idle": 1.0},
    ]


def test_a_crash_that_is_reported_only_when_it_happens_is_a_share_of_all_episodes():
    reported = [True, None, None, None]
    results = [EpisodeResult(i, 1.0, 1, crashed, float("nan")) for i, crashed in enumerate(reported)]
    assert driving_scalars(results)["crash_rate"] == 0.25


def test_an_algorithm_that_goes_on_with_weights_that_are_no_numbers_is_stopped(tmp_path: Path):
    """DQN has no distribution that would refuse them."""
    sizes = {"steps": 64, "num_envs": 1, "selections": 2, "selection_episodes": 1, "selection_envs": 1}
    wild = {"learning_rate": 1e30, "learning_starts": 4, "train_freq": 4, "net_arch": (8,), "batch_size": 4}
    with pytest.raises(DivergedError, match="the policy's weights are not finite"):
        train(plan(task=Task(TOY, "none"), algorithm="dqn", settings=wild, in_process=True, **sizes), tmp_path)


def test_a_diverged_policy_is_named_in_one_line():
    model = PPO("MlpPolicy", "CartPole-v1", n_steps=4, batch_size=4, device="cpu")
    check_finite(model)
    next(model.policy.parameters()).data.fill_(float("nan"))
    with pytest.raises(UserError, match="the policy's weights are not finite after 0 steps: its training diverged; sc"):
        check_finite(model)
