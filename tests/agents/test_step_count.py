"""A step of a copy is one environment step, however many of its agents learn."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from agents.presets import DQNPreset, PPOPreset
from agents.runs import CHECKPOINT_FILE, CURVE_FILE, load_model
from agents.task import Task
from agents.training import SaveCheckpoint, SelectBest, TrainingPlan, train
from envs.sb3.agents_as_rows import ParallelVecEnv
from predictor.support.progress import WorkShown

TAG = "simple_tag_v3"
COPIES = 2
PRESETS: dict[Any, Any] = {
    "ppo": PPOPreset(n_steps=8, batch_size=16, n_epochs=1, net_arch=(8,)),
    "dqn": DQNPreset(learning_starts=8, batch_size=4, gradient_steps=1, net_arch=(8,)),
}


def tiny(monkeypatch: pytest.MonkeyPatch, learners: tuple[str, ...], algorithm: Any = "ppo") -> TrainingPlan:
    """Returns a plan of 64 environment steps, measured after each 16 and saved after each 32."""
    monkeypatch.setattr("agents.training.preset_for", lambda *_: PRESETS[algorithm])
    task = Task(TAG, "none", learners=learners)
    return TrainingPlan(
        task, algorithm, 64, COPIES, 0, selections=4, selection_episodes=1, selection_envs=1, checkpoint_every=32
    )


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
@pytest.mark.parametrize("learners", [("agent_0",), ("adversary",), ()], ids=["1", "3", "4"])
def test_budget_measurements_checkpoints_and_progress_count_steps_of_copies(
    algorithm: str, learners: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    stepped, shown, saved = [0], [0], list[int]()
    step, save = ParallelVecEnv.step_wait, SaveCheckpoint._on_rollout_start

    def count(self: ParallelVecEnv) -> Any:
        stepped[0] += len(self.envs) if len(self.envs) == COPIES else 0  # one copy: that of the measurements
        return step(self)

    def note_save(self: SaveCheckpoint) -> None:
        save(self)
        saved.append(self._saved_at)

    def show(self: WorkShown, done: int, note: str = "") -> None:
        shown[0] = done

    monkeypatch.setattr(ParallelVecEnv, "step_wait", count)
    monkeypatch.setattr(SaveCheckpoint, "_on_rollout_start", note_save)
    monkeypatch.setattr(WorkShown, "to", show)
    monkeypatch.setattr(SelectBest, "has_kept", lambda self: False)  # with which a checkpoint would go
    train(tiny(monkeypatch, learners, algorithm), tmp_path)
    assert stepped == shown == [64]
    assert [point["steps"] for point in json.loads((tmp_path / CURVE_FILE).read_text())] == [16, 32, 48, 64]
    assert sorted(set(saved)) == [0, 32]
    assert load_model(tmp_path / CHECKPOINT_FILE, algorithm).num_timesteps == 64  # type: ignore[arg-type]


def test_progress_counts_whole_collections(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A DQN that updates every 24 steps of each copy collects 48 at a time."""
    totals, begin = list[int](), WorkShown.__init__

    def note(self: WorkShown, name: str, total: int, *others: Any) -> None:
        totals.append(total)
        begin(self, name, total, *others)

    monkeypatch.setattr(WorkShown, "__init__", note)
    monkeypatch.setitem(PRESETS, "dqn", replace(PRESETS["dqn"], train_freq=24))
    train(tiny(monkeypatch, ("agent_0",), "dqn"), tmp_path)
    assert totals[0] == 96
