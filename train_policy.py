"""Train a policy that sees what the others are about to do: `python train_policy.py --run-dir runs/highway`.

Ends with a table over held-out seeds (trained, random and idle egos on the same seeds) and a video with the forecasts
drawn in. The run folder holds config.json, tb/ (TensorBoard), checkpoint.zip (the latest), best_model.zip (best on the
selection seeds), policy.zip (the final policy: the best), summary.json, summary.md and video.mp4.
"""

import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro
from rich.console import Console

from agents.evaluate import PACKAGES, evaluate_with_progress
from agents.runs import FORECASTER, check_forecaster, load_model, open_run
from agents.task import Task
from agents.training import TrainingPlan, train
from agents.video import film
from envs.registry import native_task_of
from envs.simulators.envpool import ONE_START
from predictor.errors import UserError, run_entry_point
from predictor.provenance import provenance
from predictor.runtime import keep_freed_memory

ENVS = {"gymnasium": 6, "envpool": 64}
"""Parallel environments by default."""

LEARNERS: dict[str, tuple[str, ...]] = {"simple_tag_v3": ("adversary",), "simple_world_comm_v3": ("adversary",)}
"""Who learns by default where the sides are opponents: pursuers, against a prey that flees by rule."""


@dataclass(frozen=True)
class TrainPolicyConfig:
    """Train a policy on forecasts, evaluate it and film it."""

    env_id: Annotated[str, tyro.conf.arg(aliases=["--env"])] = "highway-fast-v0"
    """Gymnasium id (highway-fast-v0) or PettingZoo parallel id (simple_tag_v3)."""
    algorithm: Literal["ppo", "dqn"] = "ppo"
    """Learning algorithm; its hyperparameters are in agents/presets.py."""
    observe: Literal["forecast", "none", "constant-velocity"] = "forecast"
    """What the policy sees: learned forecasts, the env's own observation alone, or constant-velocity forecasts."""
    checkpoint: str | None = None
    """Forecaster: name of a shipped checkpoint or a path; None takes the one that ships for the env id."""
    steps: int = 20_000
    """Environment steps to train for, over all environments."""
    envs: int | None = None
    """Parallel environments: processes, native ones with EnvPool, copies of a PettingZoo environment. None takes 6,
    with EnvPool 64."""
    backend: Literal["gymnasium", "envpool"] = "gymnasium"
    """Who simulates in training; measured and filmed on the gymnasium environment in any case."""
    learners: tuple[str, ...] | None = None
    """PettingZoo: agents or roles that learn, for example adversary; None takes all, in simple_tag the adversaries."""
    partner: str = "heuristic"
    """PettingZoo: who drives the agents that do not learn: random, idle, varied, heuristic or mixed."""
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
        for name in ("steps", "num_envs", "selections", "selection_episodes", "checkpoint_every", "eval_episodes"):
            if getattr(self, name) < 1:
                raise UserError(f"{name} must be at least 1, got {getattr(self, name)}")

    @property
    def folder(self) -> Path:
        """The run folder."""
        return self.run_dir or Path("runs") / f"{self.env_id}-{self.algorithm}-{self.observe}-{self.seed}"

    @property
    def plan(self) -> TrainingPlan:
        """The training."""
        learners = LEARNERS.get(self.env_id, ()) if self.learners is None else self.learners
        task = Task(
            self.env_id, self.observe, self.checkpoint, self.device, self.backend, tuple(learners), self.partner
        )
        return TrainingPlan(
            task,
            self.algorithm,
            self.steps,
            self.num_envs,
            self.seed,
            self.device,
            self.selections,
            self.selection_episodes,
            self.measuring_envs,
            self.checkpoint_every,
        )

    @property
    def num_envs(self) -> int:
        """Parallel environments."""
        return self.envs if self.envs is not None else ENVS[self.backend]

    @property
    def measuring_envs(self) -> int:
        """Parallel environments that measure a policy; results do not depend on it."""
        return min(self.num_envs, os.cpu_count() or 1)


def run(config: TrainPolicyConfig, console: Console) -> None:
    """Train, evaluate, film. Nothing is written before the input has been checked."""
    config.check()
    plan = config.plan
    plan.check_action_space(plan.task.check())
    settings = asdict(config) | {"preset": asdict(plan.preset), "attention": asdict(plan.attention)}
    settings |= {"learners": plan.task.learners, "envs": config.num_envs}
    pin = plan.task.note.forecaster
    settings[FORECASTER] = None if pin is None else asdict(pin)
    for name in ("run_dir", "resume"):
        settings.pop(name)
    if config.resume and not check_forecaster(config.folder, pin):
        console.print(
            f"note: {config.folder} does not say which forecaster it was trained on; it goes on with this one"
        )
    free = ("checkpoint_every", "eval_episodes", "video", "device", FORECASTER)  # the last is compared above
    open_run(config.folder, settings, provenance(PACKAGES) | {"seed": config.seed}, config.resume, free)
    if config.backend == "envpool" and (copy := native_task_of(config.env_id)) in ONE_START:
        console.print(f"note: EnvPool's {copy} begins every episode in the same state; the original does not")
    policy = train(plan, config.folder)
    model = load_model(policy, config.algorithm)
    evaluation = evaluate_with_progress(
        plan.task, model, f"{config.algorithm} ({config.observe})", config.eval_episodes, config.measuring_envs
    )
    evaluation.write(config.folder, algorithm=config.algorithm, observe=config.observe)
    console.print(evaluation.table())
    console.print(f"policy: {policy}")
    if config.video:
        shown = film(plan.task, model, config.folder / "video.mp4")
        console.print(f"video: {shown or 'none, only highway-env and PettingZoo environments are drawn'}")


def main() -> None:
    """Entry point."""
    keep_freed_memory()
    config = tyro.cli(TrainPolicyConfig, description=__doc__)
    if config.backend != "envpool":  # its environments wait while networks compute
        torch.set_num_threads(1)  # small networks; the environments' processes fill the cores
    run(config, Console())


if __name__ == "__main__":
    run_entry_point(main)
