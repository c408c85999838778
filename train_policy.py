"""Trains a policy that sees forecasts of the other agents: `python train_policy.py --out runs/highway`.

Ends with a table over held-out seeds (trained policy, every constant action, random and idle drivers on the same seeds)
and a video with the forecasts drawn in. The run folder holds config.json, tb/ (TensorBoard), checkpoint.zip (the latest
model), best_model.zip (the model selected so far), policy.zip (the final policy: the selected model), summary.json,
summary.md, episodes.parquet (where pyarrow is installed) and video.mp4.
"""

import os
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import torch
from rich.console import Console

from agents.evaluate import constant_drivers, evaluate_with_progress, show
from agents.preset_settings import settings_from_file, settings_from_words
from agents.presets import Algorithm
from agents.results import MOST_EPISODES, PACKAGES
from agents.runs import CHECKPOINT_FILE, FORECASTER, POLICY_FILE, check_forecaster, load_model, open_run
from agents.shaping import SHAPED
from agents.task import Backend, Observe, Task
from agents.training import TrainingPlan, train
from agents.video import film
from envs.readers.mpe import MPE_IDS
from envs.registry import entry_for, envpool_task_of, require_multiagent
from envs.simulators.envpool import begins_alike
from envs.supervision import TIMEOUT_S
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least, check_at_most, check_choices, check_positive
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import check_out
from predictor.support.locks import locked
from predictor.support.memory import ENV_BYTES, PROCESS_BYTES, check_count
from predictor.support.provenance import provenance
from predictor.support.runtime import keep_freed_memory
from predictor.support.stopping import resumable


@dataclass(frozen=True)
class Sizes:
    """Sizes of a training that the command line leaves open."""

    num_envs: int = 6
    """Number of parallel environments."""
    steps: int = 20_000
    """Number of environment steps."""
    selection_episodes: int = 20
    """Number of episodes per measurement for model selection."""
    eval_episodes: int = 50
    """Number of episodes per policy in the final table."""


SIZES: dict[Backend, Sizes] = {"gymnasium": Sizes(), "envpool": Sizes(num_envs=64)}
"""Sizes by backend."""
PARTICLES_SIZES = Sizes(num_envs=64, steps=60_000, selection_episodes=100, eval_episodes=200)
"""Sizes for mpe2's particle worlds. Rewards are rare (in simple_tag 10 for a touch), so that learning takes many steps
and a mean many episodes, both of which are cheap."""


def sizes_for(env_id: str, backend: Backend) -> Sizes:
    """Returns the sizes that fit an environment."""
    return PARTICLES_SIZES if env_id in MPE_IDS else SIZES[backend]


@dataclass(frozen=True)
class TrainPolicyConfig:
    """Trains a policy on forecasts, evaluates it and films it."""

    EVERYDAY: ClassVar = (
        "env_id", "algorithm", "set", "observe", "checkpoint", "num_samples", "what_if", "env_kwargs", "steps",
        "num_envs", "backend", "seed", "out", "resume", "eval_episodes", "video", "device",
    )  # fmt: skip
    """Fields that --help explains."""

    env_id: str = "highway-fast-v0"
    """Environment to train on: Gymnasium id (highway-fast-v0) or PettingZoo parallel id (simple_tag_v3)."""
    algorithm: Algorithm = "ppo"
    """Learning algorithm: ppo, dqn (discrete actions), a2c, sac (continuous actions); with the extra contrib also qrdqn
    (discrete), recurrent-ppo and tqc (continuous). Their hyperparameters are in agents/presets.py."""
    set: tuple[str, ...] = ()
    """Hyperparameters of the algorithm to change, as name=value: --set learning_rate=3e-4 gamma=0.95."""
    preset: Path | None = None
    """TOML file with hyperparameters of the algorithm to change, such as python -m agents.tune writes; --set comes
    after it."""
    observe: Observe = "forecast"
    """What the policy sees: learned forecasts ("forecast"), constant-velocity forecasts, no forecasts ("none"), or an
    arm of a controlled comparison (docs/arms.md)."""
    checkpoint: str | None = None
    """Forecaster: shipped name, folder or run folder; None takes the checkpoint that ships for the env id."""
    sizes_of: str | None = None
    """Checkpoint whose sizes the observation has (edges, steps, agents, range), so that policies with several
    forecasters have the same network; None takes the one that ships for the env id, with --observe forecast the
    sizes of --checkpoint itself."""
    num_samples: int = 1
    """Number of futures per agent in the observation."""
    horizon_steps: int | None = None
    """Number of steps to forecast; None takes what the checkpoint was trained for."""
    perception_m: float | None = None
    """Distance up to which the policy sees other agents, now and forecast [m]; None takes the checkpoint's."""
    what_if: bool = False
    """Show also what the others do in each candidate plan of the ego."""
    env_kwargs: str = ""
    """Arguments of the environment as a JSON object, for example '{"config": {"vehicles_density": 2}}'."""
    crash_key: str | None = None
    """Key of the infos that says whether the ego has crashed (outcome.collided leads into a nested dict); None takes
    the one that is registered with the reader or known; without one, tables say "not reported"."""
    success_key: str | None = None
    """Key of the infos that says whether the ego has succeeded; None takes the registered one or is_success."""
    steps: int | None = None
    """Number of environment steps to train for, over all environments, rounded up to whole updates of the algorithm.
    One step of a PettingZoo copy is one, however many agents learn. None takes 20,000, in mpe2's particle worlds
    (simple_tag_v3) 60,000."""
    num_envs: int | None = None
    """Number of parallel environments: processes, environments of EnvPool, or copies of a PettingZoo environment. None
    takes 6, with EnvPool and in mpe2's particle worlds 64."""
    backend: Backend = "gymnasium"
    """Simulator in training; the policy is measured and filmed on the gymnasium environment in any case."""
    learners: tuple[str, ...] | None = None
    """PettingZoo: agents or roles that learn, for example adversary; None takes all, in simple_tag
    and simple_world_comm the adversaries."""
    driver: str = "heuristic"
    """PettingZoo: driver of the agents that do not learn: random, idle, varied, heuristic or mixed."""
    shaping: bool = True
    """simple_tag: learn also from a reward of 10 for each metre that a predator comes closer to the prey; selection and
    evaluation never count it."""
    seed: int = 0
    """Random seed for torch, NumPy and the environments; evaluation seeds do not depend on it."""
    out: Path | None = None
    """Run folder to write; None takes runs/ENV_ID-ALGORITHM-OBSERVE-SEED."""
    resume: bool = False
    """Continue the run in `out`, or start it if the folder holds none."""
    selections: int = 8
    """Number of times that the policy is measured for model selection, evenly spread as far as its updates allow: a
    measurement comes after an update, and the last one after the last. The model with the highest mean return is
    kept, of equal ones the latest."""
    selection_episodes: int | None = None
    """Number of episodes per such measurement, on seeds that neither training nor the final table uses. None takes 20,
    in mpe2's particle worlds 100."""
    checkpoint_every: int = 2_000
    """Number of environment steps between checkpoints."""
    eval_episodes: int | None = None
    """Number of episodes per policy in the final table. None takes 50, in mpe2's particle worlds 200."""
    video: bool = True
    """Film one episode at the end."""
    device: str = "cpu"
    """Device that runs forecaster and policy: cpu, cuda or auto (cuda where there is one)."""
    timeout_s: float = TIMEOUT_S
    """Largest time that one step of an environment may take in a process of its own [s]; one that takes longer hangs,
    which ends the command."""

    def __post_init__(self) -> None:
        """Checks choices and ranges; `plan` checks that the values fit together.

        Raises:
            UserError: a value is out of range or does not fit the others.
        """
        check_choices(self)
        check_positive(self, "perception_m")
        check_at_least(
            self, 1, "steps", "num_envs", "selections", "selection_episodes", "checkpoint_every", "eval_episodes"
        )
        for name in ("num_samples", "horizon_steps"):
            if self.observe == "none" and getattr(self, name) != getattr(type(self), name):
                raise UserError(f"{name} has no effect with observe=none; leave one out")
        if self.driver != type(self).driver:
            require_multiagent(self.env_id, "driver", "drives the other agents of PettingZoo")
            if not self.plan.task.learners:
                raise UserError(
                    f"driver drives the agents that do not learn, and all of {self.env_id} do; name those that learn "
                    "(learners), or leave driver out"
                )
        if not self.shaping:
            require_multiagent(self.env_id, "no-shaping", "changes the rewards of simple_tag alone")
            if ":" not in self.env_id and not self.env_id.startswith(SHAPED):
                raise UserError(f"no-shaping changes the rewards of {SHAPED} alone, got {self.env_id}; leave it out")
        for name in ("eval_episodes", "selection_episodes"):
            check_count(getattr(self.sizes, name), name)
        check_at_most(self.sizes, MOST_EPISODES, "eval_episodes")
        plan = self.plan
        here = self.backend == "envpool" or plan.task.is_multiagent or plan.num_envs == 1
        check_count(plan.num_envs, "num_envs", ENV_BYTES if here else PROCESS_BYTES)
        object.__setattr__(self, "device", plan.device)

    @property
    def folder(self) -> Path:
        """Path of the run folder."""
        return self.out or Path("runs") / f"{self.env_id}-{self.algorithm}-{self.observe}-{self.seed}"

    @property
    def plan(self) -> TrainingPlan:
        """Plan of the training."""
        learners = entry_for(self.env_id).learners if self.learners is None else self.learners
        task = Task(
            self.env_id, self.observe, self.checkpoint, self.device, self.backend, tuple(learners), self.driver,
            self.num_samples, self.horizon_steps, self.perception_m, self.what_if, self.env_kwargs, self.timeout_s,
            crash_key=self.crash_key, success_key=self.success_key, sizes_of=self.sizes_of,
        )  # fmt: skip
        return TrainingPlan(
            task,
            self.algorithm,
            self.sizes.steps,
            self.sizes.num_envs,
            self.seed,
            self.device,
            self.selections,
            self.sizes.selection_episodes,
            self.measuring_envs,
            self.checkpoint_every,
            settings=self.settings,
            shaping=self.shaping,
        )

    @property
    def settings(self) -> dict[str, Any]:
        """Hyperparameters in place of the preset's."""
        read = {} if self.preset is None else settings_from_file(self.algorithm, self.preset)
        return read | settings_from_words(self.algorithm, self.set)

    @property
    def sizes(self) -> Sizes:
        """Sizes of the training: the given ones, and those that fit the environment."""
        fitting = sizes_for(self.env_id, self.backend)
        given = {name: getattr(self, name) for name in asdict(fitting)}
        return replace(fitting, **{name: size for name, size in given.items() if size is not None})

    @property
    def measuring_envs(self) -> int:
        """Number of parallel environments that measure a policy; results do not depend on it, but for rounding."""
        return min(self.sizes.num_envs, os.cpu_count() or 1)


def run(config: TrainPolicyConfig, console: Console) -> None:
    """Trains, evaluates and films, in a folder that no other training uses meanwhile."""
    check_out(config.folder)
    with resumable(lambda: _kept(config)), locked(config.folder, "training"):
        _run(config, console)


def _kept(config: TrainPolicyConfig) -> str:
    """Returns what a run that is stopped keeps."""
    if (config.folder / POLICY_FILE).exists():
        return f"the policy is in {config.folder}; the same command with --resume measures it"
    if (config.folder / CHECKPOINT_FILE).exists():
        return f"the latest checkpoint is in {config.folder}; the same command with --resume goes on"
    return "no checkpoint is saved yet; the same command with --resume begins anew"


def _run(config: TrainPolicyConfig, console: Console) -> None:
    """Trains, evaluates and films; nothing is written before the input has been checked."""
    plan = config.plan
    plan.check_spaces(*plan.task.check())
    settings = asdict(config) | asdict(config.sizes)
    settings |= {"preset": asdict(plan.preset), "attention": asdict(plan.attention)}
    # config.json keeps the older names of two options, so that earlier runs can be read and resumed
    settings |= {"learners": plan.task.learners, "envs": config.sizes.num_envs, "partner": config.driver}
    pin = plan.task.note.forecaster
    settings[FORECASTER] = None if pin is None else asdict(pin)
    settings["preset_file"] = config.preset
    for name in ("out", "resume", "num_envs", "driver", "timeout_s"):
        settings.pop(name)
    if config.resume and not check_forecaster(config.folder, pin):
        console.print(
            f"note: {config.folder} does not say which forecaster it was trained on; it goes on with this one"
        )
    free = ("checkpoint_every", "eval_episodes", "video", "device", "set", "preset_file", FORECASTER)
    # the forecaster is compared above, what --set and --preset say as part of the preset
    open_run(config.folder, settings, provenance(PACKAGES) | {"seed": config.seed}, config.resume, free)
    if config.backend == "envpool" and begins_alike(copy := envpool_task_of(config.env_id)):
        console.print(f"note: EnvPool's {copy} begins every episode in the same state; the original does not")
    policy = train(plan, config.folder)
    model = load_model(policy, config.algorithm, device=plan.device)
    evaluation = evaluate_with_progress(
        plan.task,
        model,
        f"{config.algorithm} ({config.observe})",
        config.sizes.eval_episodes,
        config.measuring_envs,
        drivers=constant_drivers(plan.task),
    )
    evaluation.write(config.folder, algorithm=config.algorithm, observe=config.observe)
    show(evaluation, console)
    console.print(f"policy: {policy}")
    if config.video:
        shown = film(plan.task, model, config.folder / "video.mp4")
        console.print(f"video: {shown or 'none, no view of this environment is registered'}")


def main() -> None:
    """Runs the command."""
    keep_freed_memory()
    config = parse(TrainPolicyConfig, __doc__)
    if config.backend != "envpool":  # EnvPool's environments wait while networks compute
        torch.set_num_threads(1)  # small networks; the environments' processes fill the cores
    run(config, Console())


if __name__ == "__main__":
    run_entry_point(main)
