"""Records the agents of an environment: `python -m envs.collect --env-id roundabout-v1 --out data/roundabout`.

Each episode is a function of its seed and the options alone, so the store is the same for any number of workers. A
recording that is stopped goes on where it stopped when its command is repeated.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from envs.drivers.content import content_of, content_of_module
from envs.readers.highway_labels import ATTRIBUTE_NAMES
from envs.registry import arguments_of
from envs.rollouts.branch_recording import BranchRecording, branch_mix_for
from envs.rollouts.causal_labels import TRIED, settings_for
from envs.rollouts.cluster_pool import episode_pool
from envs.rollouts.kept_world import kept_world
from envs.rollouts.perturbations import check_kinds, mix_for
from envs.rollouts.recording import Recording, record_all
from envs.rollouts.workers import EpisodePool, Failed, OnError
from envs.rollouts.world import World, default_drivers, open_world
from envs.simulators.interventions import Kind
from envs.supervision import TIMEOUT_S
from envs.testing import store_problems
from predictor.data.partial_store import PartialStore, beside, parts_of
from predictor.data.store import Episode, StoreInfo
from predictor.data.store_files import check_new_store
from predictor.support.cluster import check_address
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least, check_at_most, check_choices, check_positive
from predictor.support.errors import UserError, run_entry_point, short
from predictor.support.locks import locked_path
from predictor.support.memory import PROCESS_BYTES, check_count
from predictor.support.progress import WorkShown
from predictor.support.provenance import provenance
from predictor.support.remote import address, is_remote
from predictor.support.stopping import resumable

FREE = ("out", "workers", "cluster", "overwrite", "on_error", "timeout_s")
"""Options that episodes do not depend on."""
MOST_CAUSAL_S = 3600
"""Longest time that copies are played for causal labels [s]."""
MOST_REASONS = 10
"""Largest number of skipped episodes whose reasons are printed; the store has them all."""
PACKAGES = ("highway-env", "mpe2", "pettingzoo", "envpool", "gymnasium", "numpy")


@dataclass(frozen=True)
class CollectConfig:
    """Records episodes of an environment into an episode store."""

    EVERYDAY: ClassVar = (
        "env_id", "out", "episodes", "driver", "seed", "max_steps", "workers", "env_kwargs", "overwrite", "perturb",
        "causal_labels",
    )  # fmt: skip
    """Fields that --help explains."""

    env_id: str
    """Environment to record: gymnasium id (highway-fast-v0, envpool/HighwayFast-v0) or PettingZoo parallel id
    (simple_tag_v3)."""
    out: Path
    """Folder of the new store (Zarr)."""
    episodes: int = 400
    """Number of episodes to record."""
    driver: tuple[str, ...] = ()
    """Driver; several take turns, one per episode. One ego: random, idle, varied, keep-lane, planner, one action in
    every step (slower, action-4), or the path of a policy .zip. Many learners: random, idle, varied, heuristic, mixed.
    Both: own:module:function (docs/wrap_your_env.md). None given: varied random idle, or heuristic mixed varied."""
    seed: int = 0
    """Random seed: episode i is reset with seed + i; keep test seeds apart from training seeds."""
    max_steps: int = 200
    """Largest length of an episode; longer ones are cut there [policy steps]."""
    labels: bool = True
    """Whether to record leaders and followers with their gaps at each step: for training on known edges and for scores,
    never part of an observation. Recorded states do not depend on it; docs/datasets/env.md has its cost in time and
    bytes."""
    workers: int = os.cpu_count() or 1
    """Number of parallel processes; the store does not depend on it. One plays in the command's own process, which
    an environment that hangs or dies takes along, unless --on-error skip."""
    env_kwargs: str = ""
    """Arguments of the environment as a JSON object, for example '{"config": {"vehicles_density": 2}}'; the store notes
    them."""
    cluster: str | None = None
    """Ray cluster that plays the episodes, in place of --workers: auto (the one that runs on this machine) or HOST:PORT
    of its head (docs/scale.md); the store is the same. None plays them here."""
    on_error: OnError = "stop"
    """What an environment that raises, hangs, dies or reports NaN does: it stops the recording (stop), or the episode
    is left out, counted and named in the store (skip)."""
    timeout_s: float = TIMEOUT_S
    """Largest time that one step of an episode may take in a worker [s]; an environment that takes longer hangs."""
    overwrite: bool = False
    """Whether to replace an existing store."""
    perturb: float = 0.0
    """Share of the steps during which one agent is perturbed: at random moments, a random perceived agent brakes,
    accelerates, changes lane or is taken out, for a while (docs/datasets/env.md). 0 records undisturbed episodes."""
    perturb_kinds: tuple[Kind, ...] = ()
    """Kinds of interventions to draw from; none given: all that the environment allows."""
    causal_labels: int = 0
    """Number of steps from one with causal labels to the next; 0 records none. At such a step copies of the simulator
    show whose future changes when an agent brakes or is taken out; docs/datasets/env.md has the cost."""
    causal_horizon_s: float | None = None
    """Time that copies are played for causal labels [s]; None takes 3 s on roads, 1 s in mpe2."""
    causal_threshold_m: float | None = None
    """Shift above which an edge counts as causal [m]; None takes 1 m on roads, 0.05 m in mpe2."""
    causal_senders: int = 8
    """Largest number of agents that are perturbed for the causal labels of one step."""
    branches: int = 0
    """Number of branches recorded of each episode, in place of the episode: at random moments the simulator is copied,
    and in the copy one agent is slower, faster or gone at once. Each is an episode of its own, with causal labels: the
    steps before, and what follows. 0 records whole episodes."""
    branch_history_steps: int = 10
    """Largest number of steps before the moment of a branch."""
    twins: bool = False
    """Whether each branch is followed by its twin: the same moment without the intervention, for training on how far an
    intervention moves agents (`predictor.train --shift-weight`)."""

    def __post_init__(self) -> None:
        """Checks ranges.

        Raises:
            UserError: a value out of range.
        """
        check_choices(self)
        arguments_of(self.env_kwargs)
        check_at_least(self, 1, "episodes", "max_steps", "causal_senders", "workers", "branch_history_steps")
        check_at_least(self, 0, "seed", "causal_labels", "branches")
        check_count(self.episodes, "episodes")
        check_count(min(self.workers, self.episodes), "workers", PROCESS_BYTES)
        check_address(self.cluster)
        check_positive(self, "causal_horizon_s", "causal_threshold_m", "timeout_s")
        check_at_most(self, MOST_CAUSAL_S, "causal_horizon_s")
        if not 0 <= self.perturb <= 1:
            raise UserError(f"perturb must lie between 0 and 1, got {self.perturb:g}")
        if self.perturb_kinds and not self.perturb:
            raise UserError("perturb_kinds needs perturb above 0, got 0; pass --perturb, for example 0.2")
        if self.branches and (self.perturb or self.causal_labels):
            raise UserError("branches are of undisturbed episodes and have causal labels; leave out the other options")
        if self.twins and not self.branches:
            raise UserError("twins needs branches above 0, got 0; pass --branches 4")
        labelled = self.causal_labels or self.branches
        if not labelled and (self.causal_horizon_s is not None or self.causal_threshold_m is not None):
            raise UserError("causal_horizon_s and causal_threshold_m need causal_labels or branches above 0, got 0")
        if not labelled and self.causal_senders != type(self).causal_senders:
            raise UserError("causal_senders needs causal_labels or branches above 0, got 0; leave it out")
        if not self.branches and self.branch_history_steps != type(self).branch_history_steps:
            raise UserError("branch_history_steps needs branches above 0, got 0; leave it out")

    @property
    def drivers(self) -> tuple[str, ...]:
        """Drivers that take turns, one per episode."""
        return self.driver or default_drivers(self.env_id, self.env_kwargs)


def collect(config: CollectConfig) -> Iterator[Episode]:
    """Records the episodes of a config, in the order of their seeds, without those that are skipped.

    Raises:
        UserError: the environment cannot be perturbed or copied, where that is asked for; or it failed.
    """
    return (episode for found in recorded(config) if not isinstance(found, Failed) for episode in found)


def recorded(
    config: CollectConfig, first: int = 0, pool: "EpisodePool[Any] | None" = None
) -> Iterator[list[Episode] | Failed]:
    """Records the episodes of each seed, from that with number `first` on: one, all its branches, or a failure.

    Args:
        config: settings of the recording.
        first: number of the first episode.
        pool: processes that play; None takes this process, or makes them.

    Raises:
        UserError: the environment cannot be perturbed or copied, where that is asked for; or it failed.
    """
    drivers, settings = config.drivers, recording_of(config)
    tasks = [
        _Task(config.env_id, drivers[i % len(drivers)], config.seed + i, settings, config.env_kwargs)
        for i in range(first, config.episodes)
    ]
    if pool is not None:
        yield from pool.play(tasks)
        return
    with open_pool(config) as own:
        yield from map(_record, tasks) if own is None else own.play(tasks)


@contextmanager
def open_pool(config: CollectConfig) -> Iterator["EpisodePool[Any] | None"]:
    """Yields the processes of a recording, and ends them; None if this process plays itself."""
    if config.workers == 1 and config.on_error == "stop" and config.cluster is None:
        yield None
        return
    with episode_pool(_played, config.workers, config.timeout_s, config.on_error, config.cluster) as pool:
        yield pool


def recording_of(config: CollectConfig) -> Recording:
    """Returns what is recorded of each episode.

    Raises:
        UserError: the environment cannot be perturbed or copied, where that is asked for, or labels of branches are of
            a longer time than these are played.
    """
    plain = Recording(config.max_steps, config.labels)
    if not (config.perturb or config.causal_labels or config.branches):
        return plain
    world = _world(config.env_id, config.drivers[0], config.env_kwargs)
    check_kinds(world, config.perturb_kinds)
    given = {"horizon_s": config.causal_horizon_s, "threshold_m": config.causal_threshold_m}
    changes: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    causal = replace(settings_for(world), senders=config.causal_senders, **changes)
    if config.branches:
        mix = branch_mix_for(world)
        if causal.horizon_s > mix.horizon_s:
            raise UserError(
                f"a branch is played for {mix.horizon_s:g} s, got causal_horizon_s {causal.horizon_s:g}; lower it"
            )
        branches = BranchRecording(config.branches, config.branch_history_steps, mix, causal, config.twins)
        return replace(plain, causal=causal, branches=branches)
    return replace(
        plain,
        perturb=config.perturb,
        perturb_kinds=config.perturb_kinds,
        causal_every=config.causal_labels,
        causal=causal if config.causal_labels else None,
    )


class _Task(NamedTuple):
    env_id: str
    driver: str
    seed: int
    recording: Recording
    env_kwargs: str


def _world(env_id: str, driver: str, env_kwargs: str) -> World:
    """Returns the world of this process, with a driver; a new one for another environment or policy."""
    if driver.endswith(".zip"):
        return kept_world((env_id, env_kwargs, driver), lambda: open_world(env_id, driver, env_kwargs=env_kwargs))
    world = kept_world((env_id, env_kwargs), lambda: open_world(env_id, driver, env_kwargs=env_kwargs))
    world.drive(driver)
    return world


def _record(task: _Task) -> list[Episode]:
    return record_all(_world(task.env_id, task.driver, task.env_kwargs), task.seed, task.driver, task.recording)


class _InfoTask(NamedTuple):
    """Asks for content and provenance of the store."""

    env_id: str
    seed: int
    config: CollectConfig


def _played(task: _Task | _InfoTask) -> Any:
    return _record(task) if isinstance(task, _Task) else _info(task.config, task.seed)


def _info_from(config: CollectConfig, pool: "EpisodePool[Any] | None") -> StoreInfo:
    """Returns content and provenance of the store, by the first seed whose environment does not fail.

    Raises:
        UserError: a driver, an environment or settings that do not go together, or the first environments all fail.
    """
    if pool is None:
        return _info(config, config.seed)
    failed = []
    for number in range(min(config.episodes, MOST_REASONS)):
        task = _InfoTask(config.env_id, config.seed + number, config)
        for found in pool.play([task]):
            if isinstance(found, StoreInfo):
                return found
            failed.append(found)
    raise UserError(f"none of the first {len(failed)} seeds can be played: {failed[0].reason}")


def _info(config: CollectConfig, seed: int) -> StoreInfo:
    """Returns content and provenance of the store; makes each driver once, so that a wrong one ends here.

    Raises:
        UserError: a driver, an environment or settings that do not go together.
    """
    for name in reversed(config.drivers):
        world = _world(config.env_id, name, config.env_kwargs)
    world.reset(seed)
    labelled = config.labels and not config.branches and world.labels() is not None
    recording = recording_of(config)
    made = provenance(PACKAGES) | {"seed": config.seed}
    if arguments_of(config.env_kwargs):
        made["env_kwargs"] = config.env_kwargs
    if config.perturb:
        kinds = check_kinds(world, config.perturb_kinds)
        made["perturbations"] = {"share": config.perturb, "kinds": kinds, "mix": asdict(mix_for(world))}
    if recording.causal is not None:
        made["causal_labels"] = {"every": config.causal_labels, "tried": TRIED} | asdict(recording.causal)
    if config.branches:
        made["branches"] = {"of_each": config.branches, "twins": config.twins} | asdict(branch_mix_for(world))
    return StoreInfo(
        world.spec,
        config.env_id,
        made,
        ATTRIBUTE_NAMES if labelled else (),
        causal_threshold_m=None if recording.causal is None else recording.causal.threshold_m,
    )


def _settings(config: CollectConfig, info: StoreInfo) -> dict[str, Any]:
    """Returns all that an episode depends on, for recordings that are taken up again."""
    given = {name: value for name, value in asdict(config).items() if name not in FREE}
    made = {name: info.provenance[name] for name in ("commit", "versions")}
    drivers = {"drivers": config.drivers, "content_of_drivers": list(map(content_of, config.drivers))}
    return given | made | drivers | {"content_of_env": content_of_module(config.env_id), "spec": asdict(info.spec)}


def _kept_before(config: CollectConfig) -> str:
    """Returns what earlier starts of a recording have kept, before it is looked at."""
    if not parts_of(config.out).exists():
        return "no episode is kept yet; the same command begins anew"
    return "what an earlier start kept is still there; the same command goes on"


def _kept(config: CollectConfig, partial: PartialStore) -> str:
    """Returns what a recording that is stopped keeps."""
    if not partial.num_done:
        return "no episode is kept yet; the same command begins anew"
    where = f"in {partial.folder}" if is_remote(config.out) else f"beside {config.out}"
    return f"{partial.num_done} of {config.episodes} episodes are kept {where}; the same command goes on"


def main() -> None:
    """Entry point."""
    config = parse(CollectConfig, __doc__)
    check_new_store(config.out, config.overwrite)
    with resumable(lambda: _kept_before(config)), open_pool(config) as pool:
        info = _info_from(config, pool)
        with locked_path(config.out), locked_path(beside(config.out)):
            check_new_store(config.out, config.overwrite)  # another recording may have ended meanwhile
            partial = PartialStore(config.out, _settings(config, info), discard=config.overwrite)
            done = partial.num_done
            with resumable(lambda: _kept(config, partial)), partial:
                with WorkShown(f"collect {config.env_id}", config.episodes, done) as shown:
                    for found in recorded(config, done, pool):
                        if isinstance(found, Failed):
                            partial.skip(found.seed, found.reason)
                        else:
                            partial.add(info, *found)
                        shown.advance()
                episodes = partial.finish(info, config.overwrite)
    steps = sum(len(e.states) for e in episodes)
    taken = f" ({done} of them from an unfinished recording)" if done else ""
    print(
        f"{address(config.out)}: {len(episodes)} episodes{taken}, {steps} scenes, "
        f"seeds {config.seed}–{config.seed + config.episodes - 1}"
    )
    reasons = list(partial.skipped.values())
    if reasons:
        print(f"skipped: {len(reasons)} of {config.episodes} seeds, whose environment failed")
        for reason in reasons[:MOST_REASONS]:
            print(f"  {short(reason)}")
    for line in warnings_of(config, info, episodes):
        print(f"warning: {line}")


def warnings_of(config: CollectConfig, info: StoreInfo, episodes: Sequence[Episode]) -> list[str]:
    """Returns what looks wrong in recorded episodes, one line for each thing; nothing of disturbed ones.

    Interventions change speeds at once, as wrong ids seem to do.
    """
    if config.perturb or config.branches:
        return []
    found = store_problems(episodes, info.spec)
    advice = f"to find the cause: dgvae check-env {config.env_id}"
    return [*found, advice] if found else []


if __name__ == "__main__":
    run_entry_point(main)
