"""Evaluates a policy in closed loop on held-out seeds: `python -m agents.evaluate --run-dir runs/highway`.

Every policy drives the same seeds; the table compares the trained policy with random and idle drivers, with every
constant action where actions are discrete, and with others that `--drivers` names. `--policy planner --env-id
highway-fast-v0 --out results` evaluates a driver without a training run. Evaluation seeds are disjoint from those of
training and of model selection (`agents.task`). docs/protocol.md defines each measure.
"""

import os
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from rich.console import Console
from rich.markup import escape
from stable_baselines3.common.base_class import BaseAlgorithm

from agents.arena import EgoArena, open_arena
from agents.episode_file import NO_PYARROW, has_pyarrow
from agents.hub import local_policy
from agents.policy import require_env_of, require_forecaster_of, task_of_policy
from agents.results import MOST_EPISODES, Evaluation
from agents.runs import CONFIG_FILE, load_model, policy_zip, read_config, shipped_policies
from agents.summaries import EXTREMES
from agents.task import EVALUATION_SEED, Task, task_of
from envs.drivers.ego import CONSTANT_ACTIONS, constant_actions, make_ego_driver, named_drivers
from envs.drivers.planner import is_planner, planner_checkpoint
from envs.drivers.trained import require_own_view
from envs.registry import arguments_of
from envs.sb3.policy_file import Algorithm, algorithm_of, read_policy_note
from envs.simulators.envpool import ENV_IDS, begins_alike
from envs.supervision import TIMEOUT_S
from predictor.own_forecasters import is_own
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least, check_at_most, check_positive
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import check_out
from predictor.support.hub import is_hub
from predictor.support.memory import PROCESS_BYTES, check_count
from predictor.support.progress import WorkShown
from predictor.support.remote import is_remote
from predictor.support.runtime import keep_freed_memory, resolve_device

NO_DRIVERS = "none"
"""Word that stands for no further drivers."""
MOST_CONSTANTS = 32
"""Largest number of constant actions that play beside a policy without being asked for."""
NOT_PINNED = "note: {} does not say which forecaster it was trained on; it gets the one of its run's config"


def evaluate_policy_on_seeds(
    task: Task,
    model: BaseAlgorithm | str,
    name: str,
    num_episodes: int,
    num_envs: int = 1,
    first_seed: int = EVALUATION_SEED,
    on_episode: Callable[[], None] = lambda: None,
    drivers: Sequence[str] = (),
) -> Evaluation:
    """Evaluates the trained policy (most likely actions) and the arena's baselines on the same seeds.

    Args:
        task: task that the model was trained on.
        model: the trained policy, or the name of a driver.
        name: name of the policy in the table.
        num_episodes: number of episodes per policy.
        num_envs: number of parallel environments; the results do not depend on it, but for rounding.
        first_seed: seed of the first episode; episode i is reset with first_seed + i.
        on_episode: called after each episode.
        drivers: names of drivers that are compared beside the arena's baselines ("planner").

    Raises:
        UserError: fewer than one episode, or fewer than one environment.
    """
    for what, number in (("num_episodes", num_episodes), ("num_envs", num_envs)):
        if number < 1:
            raise UserError(f"{what} must be at least 1, got {number}")
    seeds = range(first_seed, first_seed + num_episodes)
    arena = open_arena(task, min(num_envs, num_episodes))
    try:
        results = {name: arena.play(model, seeds, on_episode)}
        for baseline in dict.fromkeys((*drivers, *arena.baselines)):
            if baseline not in results:
                results[baseline] = arena.play(baseline, seeds, on_episode)
    finally:
        arena.close()
    return Evaluation(task.env_id, first_seed, results, not task.is_multiagent, task.env_kwargs)


def evaluate_with_progress(
    task: Task,
    model: BaseAlgorithm | str,
    name: str,
    num_episodes: int,
    num_envs: int,
    first_seed: int = EVALUATION_SEED,
    drivers: Sequence[str] = (),
) -> Evaluation:
    """Runs `evaluate_policy_on_seeds` with a progress bar."""
    policies = {name, *drivers, *EgoArena.baselines}  # an arena without an ego has as many baselines
    with WorkShown(f"evaluate {task.env_id}", num_episodes * len(policies)) as shown:
        return evaluate_policy_on_seeds(task, model, name, num_episodes, num_envs, first_seed, shown.advance, drivers)


@dataclass(frozen=True)
class EvaluateConfig:
    """Evaluates the policy of a training run on held-out seeds, beside random, idle and constant actions."""

    EVERYDAY: ClassVar = (
        "run_dir", "trust_pickle", "policy", "env_id", "env_kwargs", "checkpoint", "episodes", "seed", "out",
    )  # fmt: skip
    """Fields that --help explains."""

    run_dir: Path | None = None
    """Trained policy: the folder of its run, as train_policy.py wrote it, a .zip, one that ships (highway-fast), or
    hub:owner/name with --trust-pickle; leave it out with --policy."""
    trust_pickle: bool = False
    """Load a policy of a hub, which runs code of everyone who can write to its repository."""
    policy: str | None = None
    """Driver of the ego instead of a trained policy: planner (docs/what_if.md), planner:CHECKPOINT, planner@RISK (its
    bound on the risk: planner@0.3), or another name of envs.drivers.ego; needs --env-id and --out."""
    env_id: str | None = None
    """Environment of --policy; a training run has its own. Where a run's imports code ("module:Id"), name it here as
    well, if you trust it: the run's config alone imports nothing."""
    env_kwargs: str | None = None
    """Arguments of the environment as a JSON object, for example '{"config": {"vehicles_density": 2}}'. None takes
    those of the training run; others measure its policy in a changed environment."""
    checkpoint: str | None = None
    """Forecaster of a training run that imports code (own:module:function): name it here, if you trust it; other runs
    have their own."""
    drivers: tuple[str, ...] | None = None
    """Further drivers of the ego, each a line of the table: planner, planner:CHECKPOINT, one action in every step
    (slower, action-4), constant-actions for all of these, or another of envs.drivers.ego. None takes constant-actions
    where actions are discrete; `--drivers none` adds no line beside random and idle. The planner is no default since it
    takes minutes: it simulates and forecasts every plan at every step."""
    episodes: int = 50
    """Number of episodes per policy."""
    seed: int = EVALUATION_SEED
    """Random seed: episode i is reset with seed + i; the default is disjoint from all training seeds."""
    crash_key: str | None = None
    """Key of the infos that says whether the ego has crashed (outcome.collided leads into a nested dict); None takes
    the run's, or the one that is registered with the reader or known; without one, tables say "not reported"."""
    success_key: str | None = None
    """Key of the infos that says whether the ego has succeeded; None likewise, or is_success."""
    out: Path | None = None
    """Folder for summary.json, summary.md and, where pyarrow is installed, episodes.parquet; None takes
    RUN_DIR/evaluation, where that is a folder of yours."""
    films: bool = False
    """Film the trained policy's best, median and worst episode by return: best.mp4, median.mp4, worst.mp4."""
    num_envs: int = os.cpu_count() or 1
    """Number of parallel environments; the results do not depend on it, but for rounding of continuous actions."""
    device: str = "cpu"
    """Device that runs forecaster and policy: cpu, cuda or auto (cuda where there is one)."""
    timeout_s: float = TIMEOUT_S
    """Largest time that one step of an environment may take in a process of its own [s]; one that takes longer hangs,
    which ends the command."""

    def __post_init__(self) -> None:
        """Checks ranges; replaces `device="auto"` by the device that is taken.

        Raises:
            UserError: a value is out of range, or the device is not available.
        """
        check_at_least(self, 1, "episodes", "num_envs")
        check_positive(self, "timeout_s")
        check_count(self.episodes, "episodes")
        check_count(min(self.num_envs, self.episodes), "num_envs", PROCESS_BYTES)
        check_at_most(self, MOST_EPISODES, "episodes")
        if (self.run_dir is None) == (self.policy is None):
            raise UserError("give either --run-dir (a training run) or --policy (a driver such as planner)")
        if self.policy is not None and self.env_id is None:
            raise UserError("--policy and --env-id go together; a training run has its own environment")
        if self.policy is not None and self.out is None:
            raise UserError("--policy has no run folder; say with --out where the results go")
        if self.run_dir is not None and self.out is None and _in_no_folder(self.run_dir):
            raise UserError(f"{self.run_dir} is no run folder; say with --out where the results go")
        if self.policy is not None and self.checkpoint is not None:
            raise UserError("--checkpoint is of a training run; the planner's is part of its name, planner:CHECKPOINT")
        if self.policy == CONSTANT_ACTIONS:
            raise UserError(f"{CONSTANT_ACTIONS} stands for several drivers; give it to --drivers, and one to --policy")
        if self.films and self.policy is not None:
            raise UserError("--films are of a trained policy; leave it out with --policy, or give --run-dir")
        if self.films and self.episodes < len(EXTREMES):
            raise UserError(f"--films needs at least {len(EXTREMES)} --episodes, got {self.episodes}")
        check_at_least(self, 0, "seed")
        arguments_of(self.env_kwargs or "")
        object.__setattr__(self, "device", resolve_device(self.device))


def main() -> None:
    """Runs the command."""
    keep_freed_memory()
    torch.set_num_threads(1)  # small networks; the environments' processes fill the cores
    config = parse(EvaluateConfig, __doc__)
    out = config.out or (config.run_dir or Path()) / "evaluation"
    check_out(out)
    trained = None if config.run_dir is None else _trained(config, config.run_dir)
    evaluation, noted = _of_driver(config) if trained is None else _of_run(config, trained)
    out.mkdir(parents=True, exist_ok=True)
    evaluation.write(out, **noted)
    show(evaluation, Console())
    if config.films and trained is not None:
        evaluation.write(out, **noted, films=_film(trained, evaluation, out))
    Console().print(f"written to {out / 'summary.json'} and {out / 'summary.md'}")


def show(evaluation: Evaluation, console: Console) -> None:
    """Prints the table of an evaluation, the policies that are nearly constant, and notes on what it lacks."""
    console.print(evaluation.table())
    if evaluation.constant_policies:
        console.print(escape(evaluation.constant_policies))
    copy = ENV_IDS.get(evaluation.env_id)
    if copy is not None and begins_alike(copy):
        console.print(f"note: EnvPool's {copy} begins every episode in the same state, so the intervals say nothing")
    if not has_pyarrow():
        console.print(escape(NO_PYARROW))


def _of_driver(config: EvaluateConfig) -> tuple[Evaluation, dict[str, str]]:
    """Evaluates a driver; returns what is noted beside the results, too."""
    assert config.policy is not None and config.env_id is not None
    task = Task(
        config.env_id, "none", device=config.device, timeout_s=config.timeout_s, crash_key=config.crash_key,
        success_key=config.success_key, env_kwargs=config.env_kwargs or "",
    )  # fmt: skip
    task.check()
    checked_drivers(task, (config.policy,))
    drivers = compared_drivers(task, config.drivers)
    evaluation = evaluate_with_progress(
        task, config.policy, config.policy, config.episodes, config.num_envs, config.seed, drivers
    )
    return evaluation, {"driver": config.policy}


def compared_drivers(task: Task, names: Sequence[str] | None = None) -> tuple[str, ...]:
    """Returns the drivers that stand beside a policy and the baselines.

    Args:
        task: task of the policy.
        names: names of drivers; ("none",) for none, None for every constant action where actions are discrete;
            "planner" takes the checkpoint of the task, where it names one.

    Raises:
        UserError: "none" among others, or see `checked_drivers`.
    """
    if names is None:
        return constant_drivers(task)
    if NO_DRIVERS in names and len(names) > 1:
        raise UserError(f"--drivers {NO_DRIVERS} adds no line and stands alone, got {' '.join(names)}")
    if task.checkpoint is not None:
        names = [f"{n}:{task.checkpoint}" if is_planner(n) and not planner_checkpoint(n) else n for n in names]
    return () if NO_DRIVERS in names else checked_drivers(task, names)


def constant_drivers(task: Task) -> tuple[str, ...]:
    """Returns the drivers that take one action in every step; none without an ego or a few discrete actions."""
    if task.is_multiagent:
        return ()
    with closing(task.make(disable_env_checker=True)) as env:
        drivers = tuple(constant_actions(env))
    return drivers if len(drivers) <= MOST_CONSTANTS else ()


def checked_drivers(task: Task, names: Sequence[str]) -> tuple[str, ...]:
    """Returns the drivers that these names stand for, each once; each can drive the ego of the task.

    Raises:
        UserError: one of them cannot.
    """
    if not names:
        return ()
    if task.is_multiagent:
        raise UserError(f"drivers of an ego need an environment with one ego, {task.env_id} has several agents")
    with closing(task.make(disable_env_checker=True)) as env:
        drivers = named_drivers(names, env)
        for name in drivers:
            require_own_view(env, name)
            make_ego_driver(name, env, np.random.default_rng(0))
    return drivers


def _in_no_folder(policy: Path) -> bool:
    """Returns whether a policy is a file, ships with this package, or is on a hub."""
    return is_hub(policy) or policy.is_file() or (not policy.exists() and str(policy) in shipped_policies())


@dataclass(frozen=True)
class _Trained:
    """A trained policy, and what it is measured in."""

    zipped: Path
    algorithm: Algorithm
    task: Task

    def model(self) -> BaseAlgorithm:
        """Loads it."""
        return load_model(self.zipped, self.algorithm, device=self.task.device)


def _trained(config: EvaluateConfig, policy: Path) -> _Trained:
    """Finds a trained policy and its task, with what the command says otherwise."""
    zipped = policy_zip(local_policy(policy, config.trust_pickle))
    if (zipped.parent / CONFIG_FILE).is_file():  # of which nothing is imported that the command does not name
        run = read_config(zipped.parent, "observe", "algorithm")
        algorithm, where = run["algorithm"], str(zipped.parent / CONFIG_FILE)
        task = task_of(run, config.device, config.env_id, config.checkpoint, where)
        require_env_of(zipped, task)
    else:
        algorithm, task = algorithm_of(zipped), task_of_policy(zipped, config.device)
    named = {None, task.checkpoint}
    if task.sizes_of and (is_own(task.sizes_of) or is_remote(task.sizes_of)):  # `task_of` wants it named to trust it
        named.add(task.sizes_of)
    pin = task.note.forecaster if task.checkpoint is None and config.checkpoint is not None else None
    if pin is not None:  # the one that ships for the id
        named.add(pin.checkpoint)
    if config.checkpoint not in named:
        known = task.checkpoint or (pin.checkpoint if pin else None)
        seen = f"was trained on forecaster {known}" if known else "sees no forecaster's forecasts"
        raise UserError(f"policy {policy} {seen}, got --checkpoint {config.checkpoint}; leave it out")
    if config.env_id not in (None, task.env_id):
        raise UserError(f"policy {policy} was trained on {task.env_id}, got --env-id {config.env_id}; leave it out")
    given: dict[str, Any] = {name: getattr(config, name) for name in ("crash_key", "success_key", "env_kwargs")}
    given = {name: value for name, value in given.items() if value is not None}
    return _Trained(zipped, algorithm, replace(task, timeout_s=config.timeout_s, **given))


def _of_run(config: EvaluateConfig, trained: _Trained) -> tuple[Evaluation, dict[str, str]]:
    """Evaluates a trained policy; returns what is noted beside the results, too."""
    task = trained.task
    task.check()
    drivers = compared_drivers(task, config.drivers)
    model = trained.model()
    if read_policy_note(trained.zipped) is None and task.note.forecaster is not None:
        Console(stderr=True).print(NOT_PINNED.format(trained.zipped))
    require_forecaster_of(trained.zipped, task)
    name = f"{trained.algorithm} ({task.observe})"
    evaluation = evaluate_with_progress(task, model, name, config.episodes, config.num_envs, config.seed, drivers)
    return evaluation, {"algorithm": trained.algorithm, "observe": task.observe}


def _film(trained: _Trained, evaluation: Evaluation, out: Path) -> dict[str, dict[str, Any]]:
    """Films episodes of the trained policy, which is the first of the evaluation; returns what the films show."""
    from agents.video import film_extremes  # films alone need a video encoder

    films = film_extremes(trained.task, trained.model(), next(iter(evaluation.results.values())), out)
    names = ", ".join(film["file"] for film in films.values())
    without = "EnvPool's episodes cannot be drawn" if trained.task.env_id in ENV_IDS else "no view of it is registered"
    Console().print(f"films: {names or f'none of {trained.task.env_id}: {without}'}")
    return films


if __name__ == "__main__":
    run_entry_point(main)
