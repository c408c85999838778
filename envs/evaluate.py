"""Measures forecasts in running environments: `python -m envs.evaluate --env-ids roundabout-v1 --out runs/accuracy`.

Drives the environment through the deployed wrapper and compares each step's forecast with the true future positions of
its agents, perceived again or not (`envs.rollouts.episode`). Constant velocity forecasts the same scenes, and, given
recorded data, so does a memoryless nearest-neighbour forecaster. Counted are all agents but an ego, whose future is
the policy's choice, and landmarks. Several checkpoints make a transfer matrix: trained on A, measured on B.

`--reactions` measures instead how forecasts react when an agent brakes or is taken out, `--graph` the inferred edges
against causal labels (docs/reactions.md), `--plans` what-if forecasts for plans of the ego (docs/what_if.md).
"""

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

from rich.console import Console

from envs.registry import CHECKPOINTS, MULTIAGENT_CHECKPOINTS, arguments_of, checkpoint_for, name_with
from envs.rollouts import graph_report, plan_report, reaction_report, report
from envs.rollouts.branches import check_can_branch
from envs.rollouts.cause_run import CauseRun
from envs.rollouts.cluster_pool import PACKAGES, episode_pool
from envs.rollouts.episode import Case, Episode, EpisodeTask, play
from envs.rollouts.foreseen import check_can_foresee
from envs.rollouts.graph_run import measure_graph
from envs.rollouts.plan_run import PlanRun, check_has_plans, measure_plans
from envs.rollouts.reaction_run import ReactionRun, measure_reactions
from envs.rollouts.report import EnvAccuracy
from envs.rollouts.summary import summarise_episodes
from envs.rollouts.world import default_drivers, open_to_look, open_world
from envs.supervision import TIMEOUT_S, EnvironmentFailedError
from predictor.checkpoint import CONSTANT_VELOCITY, load_forecaster, names_of, require_known, resolve
from predictor.data.store import read_info_of, read_store
from predictor.own_forecasters import is_own
from predictor.reports.tables import accuracy_table
from predictor.support.cluster import check_address
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least, check_positive
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import check_out, finite, write_json, write_text
from predictor.support.memory import PROCESS_BYTES, check_count
from predictor.support.progress import track
from predictor.support.provenance import provenance
from predictor.support.runtime import keep_freed_memory

GALLERY_CASES = 6
"""Number of worst forecasts that are drawn, at most one per episode."""

USED_BY = {
    **dict.fromkeys(("num_samples", "memory_steps", "edge_ablations", "miss_m"), {"accuracy"}),
    **dict.fromkeys(("perturbations", "most_episodes"), {"reactions"}),
    "hidden_draws": {"reactions", "plans"},
    "episodes": {"accuracy", "graph", "plans"},
    "data": {"accuracy", "reactions"},
    "horizon_steps": {"accuracy", "reactions", "plans"},
}
"""Options that only some measurements use."""


@dataclass(frozen=True)
class EvaluateConfig:
    """Measures forecasts in running environments, through the deployed wrapper, beside constant velocity."""

    EVERYDAY: ClassVar = (
        "env_ids", "env_kwargs", "checkpoint", "episodes", "driver", "seed", "num_samples", "horizon_steps", "data",
        "workers", "out", "reactions", "graph", "plans",
    )  # fmt: skip
    """Fields that --help explains."""

    env_ids: tuple[str, ...] = (*CHECKPOINTS, *MULTIAGENT_CHECKPOINTS)
    """Environments to measure in, gymnasium or PettingZoo parallel; by default all ids with a shipped checkpoint."""
    env_kwargs: str = ""
    """Arguments of the environment as a JSON object, for example '{"config": {"vehicles_density": 2}}'; with one of
    --env-ids alone."""
    checkpoint: tuple[str, ...] = ()
    """Checkpoints to measure: shipped names, folders or run folders, or forecasters of your own, as
    own:module:function (docs/own_forecaster.md); none given, the one that ships for each id. Several make a transfer
    matrix."""
    episodes: int = 50
    """Number of episodes in each environment."""
    driver: str | None = None
    """Driver. One ego: random, idle, varied (default), keep-lane, planner (docs/what_if.md), one action in every step
    (slower, action-4), or the path of a policy .zip (which gets the forecasts that it was trained on). Many learners:
    random, idle, varied, heuristic (default), mixed. Both: own:module:function (docs/wrap_your_env.md)."""
    seed: int = 900_000
    """Random seed: episode i is reset with seed + i; shipped checkpoints were trained on seeds from 100,000 on."""
    num_samples: int = 20
    """Number of forecasts (K) of the best-of-K error; K = 1, the single forecast, is always measured, too."""
    horizon_steps: int | None = None
    """Number of steps to forecast; None takes each checkpoint's."""
    memory_steps: tuple[int, ...] = ()
    """Numbers of steps to which the model's memory is limited, each measured as well: the value of its memory."""
    edge_ablations: bool = False
    """Whether to measure as well the model with every receiver's edges averaged over its senders, and with all edges
    cut: the value of its graph."""
    data: tuple[Path, ...] = ()
    """Recorded data to which the controls are fitted (constant velocity with noise, the model's single forecast with
    noise, nearest neighbours): stores, or folders of stores named by env id; stores of other environments are left
    out."""
    miss_m: float | None = None
    """Final displacement above which a forecast misses [m]; None: 2 m on roads, a tenth of a small arena's scale."""
    max_steps: int = 200
    """Largest length of an episode; longer ones are cut there [policy steps]."""
    workers: int = os.cpu_count() or 1
    """Number of parallel processes; the results do not depend on it."""
    cluster: str | None = None
    """Ray cluster that plays the episodes, in place of --workers: auto (the one that runs on this machine) or HOST:PORT
    of its head (docs/scale.md); the results are the same. None plays them here."""
    timeout_s: float = TIMEOUT_S
    """Largest time that one step of an episode may take [s]; an environment that hangs for longer ends the command."""
    out: Path | None = None
    """Folder for accuracy.json, accuracy.md, and per environment a figure by horizon and a gallery of worst cases."""
    reactions: bool = False
    """Whether to measure, instead of accuracy, how forecasts react when a leader, the ego or a bystander brakes at
    once, or an agent is taken out, beside what then happens in a copy of the simulator: reactions.json, reactions.md
    and a figure per environment under --out."""
    perturbations: int = 100
    """Number of perturbations of each kind for --reactions."""
    most_episodes: int = 400
    """Largest number of episodes that --reactions plays in each environment to find so many."""
    hidden_draws: int = 0
    """Number of copies of each moment in which what no scene shows is drawn anew (docs/reactions.md); 0 for none."""
    graph: bool = False
    """Whether to measure, instead of accuracy, the inferred edges against causal labels (whose future changes when an
    agent brakes or is taken out), beside distance, "the leader", the commoner answer and trees on geometry (with
    scikit-learn), in --episodes episodes: graph.json, graph.md and a figure per environment under --out."""
    plans: bool = False
    """Whether to measure, instead of accuracy, what-if forecasts: each plan of the ego is played in copies of the
    simulator at every fifth step of --episodes episodes. plans.json, plans.md and a figure per environment under
    --out."""

    def __post_init__(self) -> None:
        """Checks ranges.

        Raises:
            UserError: a value out of range, or two checkpoints of one name.
        """
        if not self.env_ids:
            raise UserError("give at least one of --env-ids")
        check_at_least(self, 1, "episodes", "num_samples", "max_steps", "workers", "horizon_steps", "memory_steps")
        check_at_least(self, 1, "perturbations", "most_episodes")
        check_at_least(self, 0, "seed", "hidden_draws")
        for name in ("episodes", "num_samples", "hidden_draws"):
            check_count(getattr(self, name), name)
        check_count(self.num_samples * (self.horizon_steps or 1), "horizon_steps times num_samples")
        processes = min(self.workers, self.most_episodes if self.reactions else self.episodes)
        check_count(processes, "workers", PROCESS_BYTES)
        check_address(self.cluster)
        check_positive(self, "miss_m", "timeout_s")
        if arguments_of(self.env_kwargs) and len(self.env_ids) != 1:
            raise UserError(f"env_kwargs are of one environment; give one of --env-ids, got {len(self.env_ids)}")
        if len(set(self.env_ids)) < len(self.env_ids):
            raise UserError(f"each of --env-ids is given once, got {', '.join(self.env_ids)}; leave one out")
        names_of(self.checkpoint)
        asked = {name for name in ("reactions", "graph", "plans") if getattr(self, name)} or {"accuracy"}
        for name, measurements in USED_BY.items():
            if getattr(self, name) != getattr(type(self), name) and not asked & measurements:
                raise UserError(f"{name} has no effect on {' and '.join(sorted(asked))}; leave it out")

    def driver_of(self, env_id: str) -> str:
        """Returns the driver in an environment: the given one, or the first of its own."""
        return self.driver or default_drivers(env_id, self.env_kwargs)[0]


def evaluate_env(config: EvaluateConfig, env_id: str, checkpoint: str | None = None) -> tuple[EnvAccuracy, list[Case]]:
    """Plays the episodes of one environment and summarises them.

    Args:
        config: settings of the evaluation.
        env_id: id of the environment.
        checkpoint: shipped name or folder; None takes the one that ships for the id.

    Returns:
        The accuracy, and the worst forecasts.

    Raises:
        UserError: unknown env or checkpoint, or episodes shorter than the horizon.
    """
    chosen = checkpoint if checkpoint is not None else checkpoint_for(env_id)
    if chosen != CONSTANT_VELOCITY and not is_own(chosen):
        chosen = str(resolve(chosen))
    driver = config.driver_of(env_id)
    world = open_world(env_id, driver, chosen, horizon_steps=config.horizon_steps, env_kwargs=config.env_kwargs)
    spec = world.spec
    world.close()
    horizon = config.horizon_steps or load_forecaster(chosen, spec, f"env '{env_id}'").horizon_steps
    episodes = _play_all(config, env_id, chosen, driver, horizon)
    result = summarise_episodes(
        env_id, chosen, driver, spec, episodes, config.memory_steps, config.miss_m,
        None if checkpoint is None else names_of(config.checkpoint).get(checkpoint), config.env_kwargs,
    )  # fmt: skip
    if not result.model.agents:
        if config.max_steps < horizon:
            raise UserError(
                f"{env_id}: no forecast has {horizon} steps of truth, as --max-steps {config.max_steps} ends them "
                "before; raise it, or lower --horizon-steps"
            )
        raise UserError(
            f"{env_id}: no forecast has {horizon} steps of truth; lower --horizon-steps, add episodes, or raise "
            f"perception_m={spec.perception_m:g} if the ego sees nobody"
        )
    cases = sorted((e.worst for e in episodes if e.worst is not None), key=lambda case: -case.error_m)
    return result, cases[:GALLERY_CASES]


def _play_all(config: EvaluateConfig, env_id: str, checkpoint: str, driver: str, horizon: int) -> list[Episode]:
    stores = _stores_of(config, env_id)
    tasks = [
        EpisodeTask(
            env_id, checkpoint, driver, config.seed + i, config.num_samples, horizon, config.max_steps,
            stores, config.memory_steps, config.edge_ablations, config.env_kwargs,
        )
        for i in range(config.episodes)
    ]  # fmt: skip
    with episode_pool(play, config.workers, config.timeout_s, cluster=config.cluster) as pool:
        return list(track(pool.results(tasks), f"evaluate {env_id}", total=len(tasks)))


def _stores_of(config: EvaluateConfig, env_id: str) -> tuple[str, ...]:
    """Returns the stores that were recorded in this environment, with these arguments."""
    found = []
    for root in config.data:
        store = root / env_id if (root / env_id).is_dir() else root
        if store == root and not (root / "zarr.json").exists() and any(root.glob("*/zarr.json")):
            continue  # a folder of other environments' stores
        info = read_info_of(store)
        recorded = arguments_of(str(info.provenance.get("env_kwargs", "")))
        if info.source == env_id and recorded == arguments_of(config.env_kwargs):
            found.append(str(store))
    if config.data and not found:
        raise UserError(
            f"data: no store of {name_with(env_id, config.env_kwargs)} in {', '.join(map(str, config.data))}; record "
            "one with python -m envs.collect"
        )
    return tuple(found)


def _check_unseen(stores: Sequence[str], seed: int, episodes: int) -> None:
    """Raises a `UserError` if a store has an episode of a seed that is evaluated."""
    for store in stores:
        if both := {e.seed for e in read_store(Path(store)).episodes} & set(range(seed, seed + episodes)):
            raise UserError(
                f"data: {store} has episodes of {len(both)} of the seeds that are evaluated (the first: {min(both)}); "
                "its controls would know the answers; give another --seed, or another store"
            )


def evaluate(config: EvaluateConfig, console: Console) -> tuple[list[EnvAccuracy], dict[tuple[str, str], str]]:
    """Evaluates all checkpoints in all environments; writes each one's files under `config.out`.

    Returns:
        The results, and the reason for each (env, checkpoint) that was not measured.
    """
    results: list[EnvAccuracy] = []
    misfits: dict[tuple[str, str], str] = {}
    for env_id in config.env_ids:  # an error for all checkpoints, before hours of work
        _check_unseen(_stores_of(config, env_id), config.seed, config.episodes)
    for env_id in config.env_ids:
        for checkpoint in config.checkpoint or (None,):
            try:
                result, cases = evaluate_env(config, env_id, checkpoint)
            except EnvironmentFailedError:
                raise
            except UserError as error:
                if len(config.env_ids) * len(config.checkpoint or (None,)) == 1:
                    raise
                name = names_of(config.checkpoint)[checkpoint] if checkpoint else checkpoint_for(env_id)
                misfits[env_id, name] = str(error)
                continue
            results.append(result)
            console.print(accuracy_table(result.lines, result.dt_s, report.title(result)))
            console.print(report.remarks(result), markup=False)
            if config.out is not None:
                report.write_pictures(config.out, result, cases)
                _write(config.out, config, results, misfits)
    return results, misfits


def _write(
    out: Path, config: EvaluateConfig, results: Sequence[EnvAccuracy], misfits: dict[tuple[str, str], str]
) -> None:
    """Writes accuracy.json and accuracy.md of what is measured so far: the next may fail."""
    content: dict[str, Any] = {"config": asdict(config), "results": [asdict(result) for result in results]}
    misfit = [{"env_id": e, "checkpoint": c, "why": why} for (e, c), why in misfits.items()]
    write_json(out / "accuracy.json", finite(content | {"misfits": misfit, "provenance": provenance(PACKAGES)}))
    write_text(out / "accuracy.md", report.markdown(results, misfits))


def evaluate_causes(config: EvaluateConfig, console: Console) -> None:
    """Measures reactions, inferred edges and plans, as asked, of all checkpoints in all environments.

    Results are written under `config.out`.

    Raises:
        UserError: an environment cannot be perturbed or copied, or no checkpoint fits it.
    """
    drivers = {env_id: config.driver_of(env_id) for env_id in config.env_ids}
    for env_id, driver in drivers.items():  # raises before hours of work
        if config.reactions or config.graph:
            check_can_branch(env_id, driver, config.env_kwargs)
        if config.hidden_draws:
            check_can_foresee(env_id, driver, config.env_kwargs)
        if config.plans:
            check_has_plans(env_id, driver, config.env_kwargs)
    shared = [_settings(config, env_id, driver) for env_id, driver in drivers.items()]
    if config.reactions:
        for env_id in drivers:
            _check_unseen(_stores_of(config, env_id), config.seed, config.most_episodes)
        runs = [
            ReactionRun(
                **settings | {"episodes": config.most_episodes},
                perturbations=config.perturbations,
                horizon_steps=config.horizon_steps,
                stores=_stores_of(config, settings["env_id"]),
            )
            for settings in shared
        ]
        _measure_all(config, console, "reactions", runs, measure_reactions, reaction_report)
    if config.graph:
        edges = [CauseRun(**settings) for settings in shared]
        _measure_all(config, console, "graph", edges, measure_graph, graph_report)
    if config.plans:
        plans = [PlanRun(**settings, horizon_steps=config.horizon_steps) for settings in shared]
        _measure_all(config, console, "plans", plans, measure_plans, plan_report)


def _settings(config: EvaluateConfig, env_id: str, driver: str) -> dict[str, Any]:
    """Returns what all these measurements share."""
    return {
        "env_id": env_id, "driver": driver, "checkpoints": config.checkpoint or (checkpoint_for(env_id),),
        "episodes": config.episodes, "seed": config.seed, "max_steps": config.max_steps, "workers": config.workers,
        "timeout_s": config.timeout_s, "cluster": config.cluster, "env_kwargs": config.env_kwargs,
        "hidden_draws": config.hidden_draws,
    }  # fmt: skip


def _measure_all(
    config: EvaluateConfig, console: Console, name: str, runs: Sequence[Any], measure: Any, reports: Any
) -> None:
    """Measures each run, prints it, and writes NAME.json, NAME.md and figures, anew after each run: the next may fail.

    Args:
        config: settings of the command.
        console: terminal.
        name: name of the files.
        runs: settings of the measurement in each environment.
        measure: function from such settings to a result.
        reports: module that shows a result.
    """
    results = []
    for run in runs:
        results.append(measure(run))
        console.print(reports.shown(results[-1]))
        for remark in reports.remarks(results[-1]):
            console.print(remark, markup=False)
        if config.out is None:
            continue
        reports.write_picture(config.out, results[-1])
        content = {"config": asdict(config), "results": [asdict(result) for result in results]}
        write_json(config.out / f"{name}.json", finite(content | {"provenance": provenance(PACKAGES)}))
        write_text(config.out / f"{name}.md", reports.markdown(results))


def main() -> None:
    """Entry point."""
    keep_freed_memory()
    config = parse(EvaluateConfig, __doc__)
    causes = config.reactions or config.graph or config.plans
    console = Console(width=200 if causes else None)
    if config.out is not None:
        check_out(config.out)
    for env_id in config.env_ids:  # unknown ids and drivers raise before hours of work
        world = open_to_look(env_id, config.driver_of(env_id), config.env_kwargs)
        world.close()
        # what does not fit is an error; of several, it is noted
        if len(config.checkpoint) < 2 and (config.checkpoint or not causes):
            chosen = config.checkpoint[0] if config.checkpoint else checkpoint_for(env_id)
            load_forecaster(chosen, world.spec, f"env '{env_id}'")
    for checkpoint in config.checkpoint:
        require_known(checkpoint)
    if causes:
        evaluate_causes(config, console)
        return
    results, misfits = evaluate(config, console)
    if not results:
        raise UserError("nothing was measured: " + "; ".join(misfits.values()))
    console.print(report.overview(results))
    if len(config.checkpoint) > 1:
        console.print(report.transfer(results, misfits))
    if config.out is not None:
        _write(config.out, config, results, misfits)  # misfits after the last result, too
    if misfits and len(config.checkpoint) < 2:
        kept = f"; all else is in {config.out}" if config.out is not None else ""
        raise UserError(f"not measured: {'; '.join(misfits.values())}{kept}")


if __name__ == "__main__":
    run_entry_point(main)
