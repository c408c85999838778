"""Measures how often EnvPool's vehicles keep their identity from step to step, when it is inferred from their motion.

`python -m benchmarks.envpool_identity` drives each task with random actions, hides the order of the vehicles from the
reader by shuffling it at each step, and compares the identities with the true ones: each vehicle keeps its own IDM
exponent for an episode, and vehicles of one exponent keep their order in the simulator's list, from which none of
them may vanish. `--replay` tracks scenes of highway-env as well, where the simulator gives their identity.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
from rich.console import Console
from rich.table import Table

from envs.readers.envpool import PoolIdentity, PoolReader, envpool_spec
from envs.readers.highway import HighwayReader
from envs.registry import make_env
from envs.simulators.envpool import known_tasks, make_pool
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import UserError, run_entry_point

EMPTY = 3
"""Number of episodes without another vehicle after which a replay gives up."""


@dataclass(frozen=True)
class IdentityConfig:
    """Counts kept and lost identities of EnvPool's vehicles."""

    task_ids: tuple[str, ...] = known_tasks()
    """EnvPool tasks to drive, by default all that the installed release has."""
    vehicle_steps: int = 100_000
    """Number of pairs of a vehicle and a step to count per task, without the ego."""
    num_envs: int = 32
    """Number of parallel environments."""
    seed: int = 0
    """Random seed for environments, actions and shuffles."""
    replay: tuple[str, ...] = ()
    """Ids of highway-env whose scenes are tracked as well, for example intersection-v2."""
    replay_vehicle_steps: int = 10_000
    """Number of such pairs per replayed id; highway-env makes about a thousand per second."""

    def __post_init__(self) -> None:
        """Checks ranges.

        Raises:
            UserError: a value is out of range.
        """
        check_at_least(self, 1, "vehicle_steps", "num_envs", "replay_vehicle_steps")
        check_at_least(self, 0, "seed")


@dataclass
class Count:
    """Counts what happened to the identities of vehicles from one step to the next."""

    kept: int = 0
    """Number of vehicle steps after which a vehicle has the same number."""
    split: int = 0
    """Number of vehicle steps after which a vehicle has a new number."""
    wrong: int = 0
    """Number of vehicle steps after which a vehicle has the number of another one."""
    resets: int = 0
    """Number of episodes that ended."""

    @property
    def pairs(self) -> int:
        """Number of vehicle steps."""
        return self.kept + self.split + self.wrong

    def add_named(self, before: Mapping[Any, int], now: Mapping[Any, int]) -> None:
        """Adds the vehicles of one environment, given true name → number before and now."""
        names = [*now, *(name for name in before if name not in now)]
        self.add(*(np.array([known.get(name, -1) for name in names], dtype=np.int64) for known in (before, now)))

    def add(self, before: np.ndarray, now: np.ndarray) -> None:
        """Adds the vehicles of one environment, given their numbers before and now; -1 marks an absent vehicle."""
        there = (before >= 0) & (now >= 0)
        same = there & (before == now)
        taken = (now[:, None] == before[before >= 0]).any(axis=1)
        self.kept += int(same.sum())
        self.split += int((there & ~taken).sum())
        self.wrong += int(((now >= 0) & taken & ~same).sum())


def count_envpool(task_id: str, config: IdentityConfig) -> Count:
    """Drives a task until enough vehicle steps are counted; the count is 0 where the ego is the only vehicle."""
    rng = np.random.default_rng(config.seed)
    pool = make_pool(task_id, [config.seed + i for i in range(config.num_envs)])
    pool.reset()
    reader = PoolReader(envpool_spec(task_id, pool.config), config.num_envs)
    env_indices = np.arange(config.num_envs)
    states, count = pool.debug_states(), Count()
    before = _numbers(reader, states, env_indices, rng)
    while any(before) and count.pairs < config.vehicle_steps:
        clock = [state.elapsed_step for state in states]
        pool.step(_actions(pool.action_space, config.num_envs, rng))
        states = pool.debug_states()
        now = _numbers(reader, states, env_indices, rng)
        for i in env_indices:
            if states[i].elapsed_step <= clock[i]:
                count.resets += 1
                continue
            if any(same for _, same in set(before[i]) ^ set(now[i])):
                raise UserError(
                    f"vehicles of one IDM exponent come or go in {task_id}, so none of them has an identity"
                )
            count.add_named(before[i], now[i])
        before = now
    return count


def _numbers(
    reader: PoolReader, states: Sequence[Any], envs: np.ndarray, rng: np.random.Generator
) -> list[dict[tuple[float, int], int]]:
    """Returns true name → the reader's number for the other vehicles of each environment, whose order is hidden.

    A name is the IDM exponent, and how many vehicles before it in the simulator's list have the same.
    """
    lists, orders = [], [1 + rng.permutation(len(state.vehicles) - 1) for state in states]
    names = list[list[tuple[float, int]]]()
    for state, order in zip(states, orders, strict=True):
        own = state.vehicles
        exponents = [vehicle.idm_delta for vehicle in own]
        names.append([(exponents[k], exponents[1:k].count(exponents[k])) for k in order])
        lists.append(SimpleNamespace(elapsed_step=state.elapsed_step, vehicles=[own[0], *(own[k] for k in order)]))
    found = reader.read_all(lists, envs).ids[:, 1:].tolist()
    return [dict(zip(own, ids, strict=False)) for own, ids in zip(names, found, strict=True)]


def _actions(space: gym.Space, count: int, rng: np.random.Generator) -> np.ndarray:
    if isinstance(space, gym.spaces.Discrete):
        return rng.integers(space.n, size=count)
    assert isinstance(space, gym.spaces.Box)
    return rng.uniform(space.low, space.high, (count, *space.shape)).astype(np.float32)


def count_replay(env_id: str, config: IdentityConfig) -> Count:
    """Counts identities in scenes of highway-env, whose vehicles have known ids, appear and vanish."""
    rng = np.random.default_rng(config.seed)
    env = make_env(env_id, disable_env_checker=True)
    reader, tracker, count = HighwayReader(env), PoolIdentity(1), Count()
    first, passed_s = np.zeros(1, dtype=np.int64), np.array([reader.spec.dt_s])
    ended, episode = True, 0
    numbers: dict[int, int] = {}
    while count.pairs < config.replay_vehicle_steps:
        if ended:
            env.reset(seed=config.seed + episode)
            reader.reset()
            tracker.reset(first)
            numbers, episode = {}, episode + 1
        else:
            _, _, terminated, truncated, _ = env.step(_actions(env.action_space, 1, rng)[0])
        scene = reader.read_all(env)
        order = 1 + rng.permutation(len(scene.ids) - 1)
        states, present = scene.states[None, order], np.ones((1, len(order)), dtype=np.bool_)
        found = tracker.update(states[..., :2], states[..., 2:4], present, first, passed_s)[0]
        now: dict[int, int] = dict(zip(scene.ids[order].tolist(), found.tolist(), strict=True))
        if not ended:
            count.add_named(numbers, now)
        numbers, ended = now, not ended and (terminated or truncated)
        if episode > EMPTY and not count.pairs:
            raise UserError(f"{env_id} had no other vehicle in {EMPTY} episodes; leave it out of --replay")
    count.resets = episode - 1
    env.close()
    return count


def main() -> None:
    """Runs the command."""
    config = parse(IdentityConfig, __doc__)
    table = Table(title=f"identity from motion, random ego, seed {config.seed}")
    for heading in ("env", "vehicle steps", "correct", "id switches", "split", "wrong", "episodes"):
        table.add_column(heading, justify="left" if heading == "env" else "right")
    for env_id in config.replay:  # raises before any is played
        make_env(env_id).close()
    counts = [(f"envpool {task_id}", count_envpool(task_id, config)) for task_id in config.task_ids]
    counts += [(f"highway-env {env_id}", count_replay(env_id, config)) for env_id in config.replay]
    for name, count in counts:
        share = f"{100 * count.kept / count.pairs:.3f} %" if count.pairs else "no other vehicles"
        switches = count.split + count.wrong
        table.add_row(name, *map(str, (count.pairs, share, switches, count.split, count.wrong, count.resets)))
    Console(width=120).print(table)


if __name__ == "__main__":
    run_entry_point(main)
