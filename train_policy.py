"""Train a policy that sees what the others are about to do: `python train_policy.py --run-dir runs/highway`.

Ends with a table over held-out seeds (trained, random and idle egos on the same seeds) and a video with the forecasts
drawn in. The run folder holds config.json, tb/ (TensorBoard), checkpoint.zip (the latest), best_model.zip (best on the
selection seeds), policy.zip (the final policy: the best), summary.json, summary.md and video.mp4.
"""

import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from rich.console import Console
from stable_baselines3.common.base_class import BaseAlgorithm

from agents.evaluate import EVALUATION_SEED, PACKAGES, evaluate_with_progress
from agents.features import EGO_KEY, AttentionConfig
from agents.rows import Task
from agents.runs import load_model, open_run
from agents.training import TrainingPlan, train
from envs.registry import CHECKPOINTS, make_env
from envs.render import record_episode
from envs.wrappers import ForecastObservation
from predictor.errors import UserError, run_entry_point
from predictor.provenance import provenance

MAX_VIDEO_STEPS = 200
"""Longest video [policy steps]; racetracks go on for 1500."""


@dataclass(frozen=True)
class TrainPolicyConfig:
    """Train a policy on forecasts, evaluate it and film it."""

    env_id: str = "highway-fast-v0"
    """Gymnasium id."""
    algorithm: Literal["ppo", "dqn"] = "ppo"
    """Learning algorithm; its hyperparameters are in agents/presets.py."""
    observe: Literal["forecast", "none", "constant-velocity"] = "forecast"
    """What the policy sees: learned forecasts, the env's own observation alone, or constant-velocity forecasts."""
    checkpoint: str | None = None
    """Forecaster: name of a shipped checkpoint or a path; None takes the one that ships for the env id."""
    steps: int = 20_000
    """Environment steps to train for, over all environments."""
    envs: int = 6
    """Parallel environments, each in its own process."""
    seed: int = 0
    """Drives torch, NumPy and the environments; evaluation seeds do not depend on it."""
    run_dir: Path | None = None
    """Run folder; None takes runs/ENV_ID-ALGORITHM-OBSERVE-SEED."""
    resume: bool = False
    """Continue the run in run_dir (or start it, if nothing is there yet)."""
    selections: int = 8
    """How often, evenly spread, the policy is measured to find the best one."""
    selection_episodes: int = 20
    """Episodes per such measurement, on seeds that neither training nor the final table uses."""
    checkpoint_every: int = 2_000
    """Environment steps between checkpoints."""
    eval_episodes: int = 50
    """Episodes per policy in the final table."""
    video: bool = True
    """Film one episode at the end."""
    device: str = "cpu"
    """Where forecaster and policy run: cpu, cuda or auto."""

    def check(self) -> None:
        """Check ranges; what belongs together is checked by the parts.

        Raises:
            UserError: a number that makes no sense. (In `__post_init__`, tyro would turn it into a box of lines.)
        """
        for name in ("steps", "envs", "selections", "selection_episodes", "checkpoint_every", "eval_episodes"):
            if getattr(self, name) < 1:
                raise UserError(f"{name} must be at least 1, got {getattr(self, name)}")

    @property
    def folder(self) -> Path:
        """The run folder."""
        return self.run_dir or Path("runs") / f"{self.env_id}-{self.algorithm}-{self.observe}-{self.seed}"

    @property
    def plan(self) -> TrainingPlan:
        """The training."""
        task = Task(self.env_id, self.observe, self.checkpoint, self.device)
        return TrainingPlan(
            task,
            self.algorithm,
            self.steps,
            self.envs,
            self.seed,
            self.device,
            self.selections,
            self.selection_episodes,
            self.measuring_rows,
            self.checkpoint_every,
        )

    @property
    def measuring_rows(self) -> int:
        """Parallel environments that measure a policy; results do not depend on it."""
        return min(self.envs, os.cpu_count() or 1)


def run(config: TrainPolicyConfig, console: Console) -> None:
    """Train, evaluate, film. Nothing is written before the input has been checked."""
    config.check()
    plan = config.plan
    plan.check_action_space(plan.task.check())
    settings = asdict(config) | {"preset": asdict(plan.preset), "attention": asdict(AttentionConfig())}
    for name in ("run_dir", "resume"):
        settings.pop(name)
    free = ("checkpoint_every", "eval_episodes", "video", "device")
    open_run(config.folder, settings, provenance(PACKAGES) | {"seed": config.seed}, config.resume, free)
    policy = train(plan, config.folder)
    model = load_model(policy, config.algorithm)
    evaluation = evaluate_with_progress(
        plan.task, model, f"{config.algorithm} ({config.observe})", config.eval_episodes, config.measuring_rows
    )
    evaluation.write(config.folder, algorithm=config.algorithm, observe=config.observe)
    console.print(evaluation.table())
    console.print(f"policy: {policy}")
    if config.video:
        console.print(f"video: {film(config, model)}")


def film(config: TrainPolicyConfig, model: BaseAlgorithm) -> Path:
    """Film the first evaluation episode with the forecasts drawn in, also for a policy that sees none."""
    checkpoint = config.plan.task.forecaster
    if config.observe == "none" and config.env_id not in CHECKPOINTS:
        checkpoint = "constant-velocity"
    env = ForecastObservation(make_env(config.env_id, render_mode="rgb_array"), checkpoint)
    path = config.folder / "video.mp4"
    try:
        record_episode(env, _act(config, model), seed=EVALUATION_SEED, max_steps=MAX_VIDEO_STEPS).write_video(path)
    finally:
        env.close()
    return path


def _act(config: TrainPolicyConfig, model: BaseAlgorithm) -> Callable[[Any], Any]:
    def act(obs: dict[str, Any]) -> Any:
        seen = obs[EGO_KEY] if config.observe == "none" else obs
        return model.predict(seen, deterministic=True)[0]

    return act


def main() -> None:
    """Entry point."""
    torch.set_num_threads(1)  # small networks; the environments' processes fill the cores
    run(tyro.cli(TrainPolicyConfig, description=__doc__), Console())


if __name__ == "__main__":
    run_entry_point(main)
