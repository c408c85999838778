"""Evaluates a policy in closed loop on held-out seeds: `python -m agents.evaluate --run-dir runs/highway`.

Every policy drives the same seeds; the table compares the trained policy with random and idle drivers, and with others
that `--drivers` names, such as every constant action. `--policy planner --env-id highway-fast-v0 --out results`
evaluates a driver without a training run. Evaluation seeds are disjoint from those of training and of model selection
(`agents.task`).
"""

import math
import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from stable_baselines3.common.base_class import BaseAlgorithm

from agents.arena import EgoArena, open_arena
from agents.runs import POLICY_FILE, load_model, read_config
from agents.task import EVALUATION_SEED, Task, task_of
from agents.vec_envs import EpisodeResult
from envs.drivers.ego import CONSTANT_ACTIONS, make_ego_driver, named_drivers
from envs.sb3.policy_file import read_policy_note
from predictor.support import markdown
from predictor.support.command_line import Renamed, parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import finite, write_json, write_text
from predictor.support.provenance import provenance
from predictor.support.runtime import keep_freed_memory, resolve_device

NEARLY_CONSTANT = 0.95
"""Least share of one action from which on a policy is called nearly constant."""
_WILSON_Z = 1.959963984540054  # two-sided 95 %
NOT_PINNED = "note: {} does not say which forecaster it was trained on; it gets the one of its run's config"
PACKAGES = ("stable-baselines3", "gymnasium", "pettingzoo", "highway-env", "mpe2", "envpool", "torch", "numpy")


@dataclass(frozen=True)
class PolicySummary:
    """Results of one policy over all episodes: a line of the table."""

    policy: str
    """Name of the policy or driver."""
    episodes: int
    """Number of episodes."""
    return_mean: float
    """Mean undiscounted return."""
    return_se: float
    """Standard error of `return_mean`; NaN for a single episode."""
    length_mean: float
    """Mean length [policy steps]."""
    length_se: float
    """Standard error of `length_mean`; NaN for a single episode."""
    crash_rate: float | None
    """Share of episodes with a crash; None if the env does not report crashes."""
    crash_low: float | None
    """Lower end of the 95 % Wilson interval of `crash_rate`."""
    crash_high: float | None
    """Upper end of the 95 % Wilson interval of `crash_rate`."""
    mean_speed_mps: float
    """Mean over episodes of the mean speed [m/s]; NaN if the env does not report speeds."""
    role_returns: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Mean return of the learners of each role, with its standard error; empty if there is one role."""
    action_shares: dict[str, float] = field(default_factory=dict)
    """Share of each action among the steps of all episodes, the commonest first; empty if actions are not discrete."""


@dataclass(frozen=True)
class Evaluation:
    """Results of several policies on the same seeds."""

    env_id: str
    """Gymnasium or PettingZoo id."""
    first_seed: int
    """Seed of the first episode; episode i was reset with first_seed + i."""
    results: dict[str, list[EpisodeResult]]
    """Results of the episodes, by policy."""
    has_ego: bool = True
    """Whether one agent is driven: the table then has its crash rate and speed, "–" if the env does not report them."""

    @property
    def summaries(self) -> list[PolicySummary]:
        """Summaries, one per policy."""
        return [summarize(policy, episodes) for policy, episodes in self.results.items()]

    @property
    def constant_policies(self) -> str:
        """A line on the policies that (nearly) always take one action, but for drivers that are named after it."""
        found = []
        for summary in self.summaries:
            action, share = next(iter(summary.action_shares.items()), ("", 0.0))
            if share >= NEARLY_CONSTANT and summary.policy not in (action, "idle"):
                found.append(f"{summary.policy} takes {action} in {100 * share:.1f} % of its steps")
        return f"(Nearly) constant: {'; '.join(found)}." if found else ""

    def write(self, folder: Path, **extra: Any) -> None:
        """Writes ``summary.json`` (with every episode and the provenance) and ``summary.md``."""
        content = {
            "env_id": self.env_id,
            "first_seed": self.first_seed,
            **extra,
            "policies": [asdict(summary) for summary in self.summaries],
            "episodes": {name: [asdict(e) for e in found] for name, found in self.results.items()},
            "provenance": provenance(PACKAGES),
        }
        write_json(folder / "summary.json", finite(content))
        write_text(folder / "summary.md", self.markdown())

    def markdown(self) -> str:
        """Returns the table as Markdown."""
        header, cells = self._cells()
        paragraphs = [markdown.table(header, cells), f"{self.env_id}: {self._caption()}", self.constant_policies]
        return "\n\n".join(filter(None, paragraphs)) + "\n"

    def table(self) -> Table:
        """Returns the table for a terminal."""
        header, lines = self._cells()
        table = Table(title=self.env_id, caption=self._caption())
        for i, name in enumerate(header):
            table.add_column(escape(name), justify="right" if i else "left")
        for line in lines:
            table.add_row(*line)
        return table

    def _cells(self) -> tuple[list[str], list[list[str]]]:
        """Returns the header and the cells of each line; without an ego there are no columns of crashes and speed."""
        summaries = self.summaries
        roles = list(dict.fromkeys(role for summary in summaries for role in summary.role_returns))
        header = ["policy", "return", *(f"return of {role}" for role in roles), "length"]
        header += ["crash rate (95 %)", "speed [m/s]"] if self.has_ego else []
        return header, [_cells_of(summary, roles, self.has_ego) for summary in summaries]

    def _caption(self) -> str:
        count = max(len(found) for found in self.results.values())
        caption = (
            f"{count} episodes each, the same seeds from {self.first_seed} on; mean ± standard error, length in policy "
            "steps"
        )
        if not self.has_ego:
            return f"{caption}; return: mean over the learners."
        if all(summary.crash_rate is None for summary in self.summaries):
            return f"{caption}; the environment reports no crashes."
        return f"{caption}, crash rate with its 95 % Wilson interval."


def wilson_interval(successes: int, trials: int, z: float = _WILSON_Z) -> tuple[float, float]:
    """Computes the Wilson score interval of a rate, which lies within [0, 1] and never has zero width.

    Args:
        successes: number of events.
        trials: number of trials; at least 1.
        z: normal quantile; the default gives 95 %.

    Raises:
        UserError: `successes` or `trials` is out of range.
    """
    if not 0 <= successes <= trials or trials < 1:
        raise UserError(f"need 0 <= successes <= trials and trials >= 1, got {successes} of {trials}")
    rate = successes / trials
    centre = (rate + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z / (1 + z**2 / trials) * math.sqrt(rate * (1 - rate) / trials + z**2 / (4 * trials**2))
    low = 0.0 if successes == 0 else centre - half  # exact at the ends, where rounding would leave 1e-17
    high = 1.0 if successes == trials else centre + half
    return low, high


def mean_and_standard_error(values: Sequence[float]) -> tuple[float, float]:
    """Returns the mean and its standard error (sample standard deviation / √n; NaN for a single value)."""
    array = np.asarray(values, dtype=np.float64)
    error = float(array.std(ddof=1) / math.sqrt(len(array))) if len(array) > 1 else math.nan
    return float(array.mean()), error


def summarize(policy: str, episodes: Sequence[EpisodeResult]) -> PolicySummary:
    """Computes the summary of one policy's episodes."""
    return_mean, return_se = mean_and_standard_error([e.episode_return for e in episodes])
    length_mean, length_se = mean_and_standard_error([float(e.length) for e in episodes])
    crashes = [e.crashed for e in episodes if e.crashed is not None]
    interval = wilson_interval(sum(crashes), len(crashes)) if crashes else (None, None)
    roles = list(dict.fromkeys(role for e in episodes for role in e.returns_by_role))
    actions = sum((Counter(e.action_counts) for e in episodes), Counter())
    return PolicySummary(
        policy,
        len(episodes),
        return_mean,
        return_se,
        length_mean,
        length_se,
        sum(crashes) / len(crashes) if crashes else None,
        interval[0],
        interval[1],
        float(np.mean([e.mean_speed_mps for e in episodes])),
        {role: mean_and_standard_error([e.returns_by_role[role] for e in episodes]) for role in roles},
        {action: count / actions.total() for action, count in actions.most_common()},
    )


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
        num_envs: number of parallel environments; the results do not depend on it.
        first_seed: seed of the first episode; episode i is reset with first_seed + i.
        on_episode: called after each episode.
        drivers: names of drivers that are compared beside the arena's baselines ("planner").
    """
    seeds = range(first_seed, first_seed + num_episodes)
    arena = open_arena(task, min(num_envs, num_episodes))
    try:
        results = {name: arena.play(model, seeds, on_episode)}
        for baseline in dict.fromkeys((*drivers, *arena.baselines)):
            if baseline not in results:
                results[baseline] = arena.play(baseline, seeds, on_episode)
    finally:
        arena.close()
    return Evaluation(task.env_id, first_seed, results, has_ego=not task.is_multiagent)


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
    columns = (TextColumn(f"evaluate {task.env_id}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns) as progress:
        policies = {name, *drivers, *EgoArena.baselines}  # an arena without an ego has as many baselines
        bar = progress.add_task("", total=num_episodes * len(policies))
        return evaluate_policy_on_seeds(
            task, model, name, num_episodes, num_envs, first_seed, lambda: progress.advance(bar), drivers
        )


def _cells_of(summary: PolicySummary, roles: Sequence[str], has_ego: bool) -> list[str]:
    cells = [summary.policy, f"{summary.return_mean:.2f}{_plus_minus(summary.return_se, 2)}"]
    for role in roles:
        mean, error = summary.role_returns.get(role, (math.nan, math.nan))
        cells.append(f"{mean:.2f}{_plus_minus(error, 2)}")
    cells.append(f"{summary.length_mean:.1f}{_plus_minus(summary.length_se, 1)}")
    if has_ego:
        cells.append(_crashes(summary))
        cells.append("–" if math.isnan(summary.mean_speed_mps) else f"{summary.mean_speed_mps:.1f}")
    return cells


def _crashes(summary: PolicySummary) -> str:
    if summary.crash_rate is None or summary.crash_low is None or summary.crash_high is None:
        return "–"
    return f"{100 * summary.crash_rate:.0f} % ({100 * summary.crash_low:.0f}–{100 * summary.crash_high:.0f} %)"


def _plus_minus(error: float, digits: int) -> str:
    return "" if math.isnan(error) else f" ± {error:.{digits}f}"


@dataclass(frozen=True)
class EvaluateConfig:
    """Evaluates the policy of a training run on held-out seeds, beside random and idle drivers."""

    run_dir: Path | None = None
    """Folder of the training run, as train_policy.py wrote it; leave it out with --policy."""
    policy: str | None = None
    """Driver of the ego instead of a trained policy: planner (docs/what_if.md), planner:CHECKPOINT, or another name of
    envs.drivers.ego; needs --env-id and --out."""
    env_id: str | None = None
    """Environment of --policy; a training run has its own."""
    drivers: tuple[str, ...] = ()
    """Further drivers of the ego, each a line of the table: planner, planner:CHECKPOINT, one action in every step
    (slower, action-4), constant-actions for all of these, or another of envs.drivers.ego."""
    episodes: int = 50
    """Number of episodes per policy."""
    seed: int = EVALUATION_SEED
    """Random seed: episode i is reset with seed + i; the default is disjoint from all training seeds."""
    out: Path | None = None
    """Folder for summary.json and summary.md; None takes RUN_DIR/evaluation."""
    num_envs: Annotated[int, Renamed("workers")] = os.cpu_count() or 1
    """Number of parallel environments; the results do not depend on it."""
    device: str = "cpu"
    """Device that runs forecaster and policy: cpu, cuda or auto (cuda where there is one)."""

    def __post_init__(self) -> None:
        """Checks ranges; replaces `device="auto"` by the device that is taken.

        Raises:
            UserError: a value is out of range, or the device is not available.
        """
        check_at_least(self, 1, "episodes", "num_envs")
        if (self.run_dir is None) == (self.policy is None):
            raise UserError("give either --run-dir (a training run) or --policy (a driver such as planner)")
        if (self.policy is None) != (self.env_id is None):
            raise UserError("--policy and --env-id go together; a training run has its own environment")
        if self.policy is not None and self.out is None:
            raise UserError("--policy has no run folder; say with --out where the results go")
        if self.policy == CONSTANT_ACTIONS:
            raise UserError(f"{CONSTANT_ACTIONS} stands for several drivers; give it to --drivers, and one to --policy")
        check_at_least(self, 0, "seed")
        object.__setattr__(self, "device", resolve_device(self.device))


def main() -> None:
    """Runs the command."""
    keep_freed_memory()
    torch.set_num_threads(1)  # small networks; the environments' processes fill the cores
    config = parse(EvaluateConfig, __doc__)
    out = config.out or (config.run_dir or Path()) / "evaluation"
    if out.is_file():
        raise UserError(f"{out} is a file; choose another --out")
    evaluation, noted = _of_driver(config) if config.run_dir is None else _of_run(config, config.run_dir)
    out.mkdir(parents=True, exist_ok=True)
    evaluation.write(out, **noted)
    Console().print(evaluation.table())
    if evaluation.constant_policies:
        Console().print(escape(evaluation.constant_policies))
    Console().print(f"written to {out / 'summary.json'} and {out / 'summary.md'}")


def _of_driver(config: EvaluateConfig) -> tuple[Evaluation, dict[str, str]]:
    """Evaluates a driver; returns what is noted beside the results, too."""
    assert config.policy is not None and config.env_id is not None
    task = Task(config.env_id, "none", device=config.device)
    task.check()
    _, *drivers = checked_drivers(task, (config.policy, *config.drivers))
    evaluation = evaluate_with_progress(
        task, config.policy, config.policy, config.episodes, config.num_envs, config.seed, drivers
    )
    return evaluation, {"driver": config.policy}


def checked_drivers(task: Task, names: Sequence[str]) -> tuple[str, ...]:
    """Returns the drivers that these names stand for, each once; each can drive the ego of the task.

    Raises:
        UserError: one of them cannot.
    """
    if not names:
        return ()
    if task.is_multiagent:
        raise UserError(f"drivers of an ego need an environment with one ego, {task.env_id} has several agents")
    env = task.make(disable_env_checker=True)
    drivers = named_drivers(names, env)
    for name in drivers:
        make_ego_driver(name, env, np.random.default_rng(0))
    env.close()
    return drivers


def _of_run(config: EvaluateConfig, run_dir: Path) -> tuple[Evaluation, dict[str, str]]:
    """Evaluates the policy of a training run; returns what is noted beside the results, too."""
    run = read_config(run_dir)
    task = task_of(run, config.device)
    task.check()
    drivers = checked_drivers(task, config.drivers)
    policy = run_dir / POLICY_FILE
    model = load_model(policy, run["algorithm"])
    note, now = read_policy_note(policy), task.note
    if note is None:
        if now.forecaster is not None:
            Console(stderr=True).print(NOT_PINNED.format(policy))
    elif note.forecaster is not None and now.forecaster is not None:
        note.forecaster.check(now.forecaster, f"policy {policy}")
    name = f"{run['algorithm']} ({run['observe']})"
    evaluation = evaluate_with_progress(task, model, name, config.episodes, config.num_envs, config.seed, drivers)
    return evaluation, {"algorithm": run["algorithm"], "observe": run["observe"]}


if __name__ == "__main__":
    run_entry_point(main)
