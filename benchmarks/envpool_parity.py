"""Compares EnvPool's highway environments with highway-env's, step by step from equal states and by whole episodes.

`python -m benchmarks.envpool_parity` copies the states that EnvPool's episodes begin in (positions, speeds, lanes,
routes, target speeds, drivers' exponents and timers) into the highway-env id that EnvPool mirrors, steps both with the
same random actions, and reports by how much vehicles differ in position. Then it compares independent episodes of both
simulators and, with `--policy`, the results of one trained policy in both.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from highway_env.vehicle.behavior import IDMVehicle
from rich.console import Console
from rich.table import Table

from agents.summaries import mean_and_standard_error
from envs.drivers.ego import make_ego_driver
from envs.drivers.trained import kept_policy, sees_forecasts
from envs.readers import reader_for
from envs.registry import make_env
from envs.seeding import driver_rng
from envs.simulators.envpool import ENV_IDS, HIGHWAY_ENV_OF, begins_alike
from envs.simulators.idm_constants import SHIPPED
from envs.wrappers import ForecastObservation
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import check_out_file, write_json
from predictor.support.provenance import provenance

_SAME_M = 1e-6
"""Largest distance of two vehicles that count as being in the same place [m]."""
_CONTINUOUS = "Intersection-v1"
"""Task whose ego steers and accelerates; random actions are drawn from discrete ones here."""


@dataclass(frozen=True)
class ParityConfig:
    """Compares EnvPool's highway environments with highway-env's."""

    task_ids: tuple[str, ...] = ("HighwayFast-v0", "Intersection-v0")
    """EnvPool tasks to compare; they have discrete actions."""
    starts: int = 20
    """Number of copied initial states per task."""
    steps: int = 10
    """Number of policy steps from each initial state."""
    episodes: int = 30
    """Number of episodes per task, simulator and driver; 0 leaves these tables out."""
    driver: tuple[str, ...] = ("random", "idle")
    """Drivers of the ego: random, idle or varied."""
    policy: Path | None = None
    """Policy .zip of Stable-Baselines3 that drives as well, in both simulators."""
    checkpoint: str | None = None
    """Forecaster whose forecasts the policy sees; None takes the checkpoint that ships for the id."""
    seed: int = 0
    """Random seed for environments and actions."""
    out: Path | None = None
    """JSON file to write the results to."""

    def __post_init__(self) -> None:
        """Checks ranges.

        Raises:
            UserError: a value is out of range, or a task cannot be compared.
        """
        check_at_least(self, 1, "starts", "steps")
        check_at_least(self, 0, "episodes", "seed")
        unknown = [t for t in self.task_ids if t not in HIGHWAY_ENV_OF or t.startswith("Racetrack")]
        if unknown:
            raise UserError(f"cannot compare {', '.join(unknown)}: unknown, or without other vehicles")
        if _CONTINUOUS in self.task_ids:
            raise UserError(f"cannot compare {_CONTINUOUS}: its actions are continuous; compare Intersection-v0")
        if self.checkpoint is not None and self.policy is None:
            raise UserError("checkpoint is what a policy sees; give --policy, or leave it out")
        if self.policy is not None and not self.episodes:
            raise UserError("policy has no effect without episodes; leave out --episodes 0")
        check_out_file(self.out)


# --- The same state in both -------------------------------------------------------------------------------------------


def _index(start: str, end: str, lane: int) -> tuple[str, str, int | None]:
    return start, end, None if lane < 0 else lane


def copy_state(state: Any, env: gym.Env) -> list[Any]:
    """Puts EnvPool's vehicles on highway-env's road and returns the copies, in the same order, ego first."""
    inner: Any = env.unwrapped
    road, vehicles = inner.road, []
    for i, source in enumerate(state.vehicles):
        make = inner.action_type.vehicle_class if i == 0 else IDMVehicle
        vehicle = make(road, [source.x, source.y], source.heading, source.speed)
        vehicle.lane_index = (source.lane_from, source.lane_to, source.lane_index)
        vehicle.lane = road.network.get_lane(vehicle.lane_index)
        vehicle.target_lane_index = (source.target_lane_from, source.target_lane_to, source.target_lane_index)
        vehicle.target_speed = source.target_speed
        route = zip(source.route_from, source.route_to, source.route_id, strict=True)
        vehicle.route = [_index(*lane) for lane in route] or None
        vehicle.check_collisions = source.check_collisions
        if i == 0:
            vehicle.speed_index = source.speed_index
        else:
            vehicle.DELTA, vehicle.timer = source.idm_delta, source.timer
            vehicle.enable_lane_change = source.enable_lane_change
        vehicles.append(vehicle)
    road.vehicles, inner.controlled_vehicles = list(vehicles), vehicles[:1]
    if hasattr(road, "steps"):
        road.steps = 3 * state.simulation_frequency  # both have warmed the clock of right of way up by three seconds
    inner.define_spaces()  # observe the new ego
    return vehicles


@contextmanager
def untouched_drivers() -> Iterator[None]:
    """Restores the parameters of IDM drivers, which highway-env's intersection changes for the whole process."""
    kept = {name: getattr(IDMVehicle, name) for name in SHIPPED}
    try:
        yield
    finally:
        for name, value in kept.items():
            setattr(IDMVehicle, name, value)


@dataclass
class Apart:
    """Differences between the two simulators after equal initial states."""

    distance_m: list[list[float]]
    """Distances between the copies of each vehicle [m], by step, all starts together."""
    observation: list[float] = field(default_factory=list)
    """Largest difference of an observation's entries, for each step in which all vehicles still agree."""
    reward: list[float] = field(default_factory=list)
    """Difference of the rewards, for the same steps."""
    ends: list[bool] = field(default_factory=list)
    """Whether terminated and truncated were equal, for the same steps."""


def step_both(task_id: str, config: ParityConfig) -> Apart:
    """Measures the differences over the config's starts and steps."""
    # no arrivals: the two draw different random numbers, and EnvPool 1.2.5 has none
    still = {"spawn_probability": 0.0} if task_id.startswith("Intersection") else None
    settings = {} if still is None or begins_alike(task_id) else still
    pool: Any = make_env(_env_id(task_id), disable_env_checker=True, **settings).unwrapped
    mirrored = make_env(HIGHWAY_ENV_OF[task_id], disable_env_checker=True, config=still)
    rng = np.random.default_rng(config.seed)
    apart = Apart([[] for _ in range(config.steps)])
    for start in range(config.starts):
        pool.reset(seed=config.seed + start)
        mirrored.reset(seed=config.seed + start)
        copies = copy_state(pool.debug_states()[0], mirrored)
        for step in range(config.steps):
            action = int(rng.integers(pool.action_space.n))
            ours, theirs = pool.step(action), mirrored.step(action)
            sources = pool.debug_states()[0].vehicles
            if len(sources) != len(copies):
                break  # one has left EnvPool's list, which does not say which
            present = {id(vehicle) for vehicle in mirrored.unwrapped.road.vehicles}  # type: ignore[attr-defined]
            distances = [
                float(np.hypot(*(np.array([source.x, source.y]) - copy.position)))
                for source, copy in zip(sources, copies, strict=True)
                if id(copy) in present
            ]
            apart.distance_m[step] += distances
            if max(distances) < _SAME_M:
                apart.observation.append(float(np.abs(ours[0] - theirs[0]).max()))
                apart.reward.append(abs(float(ours[1]) - float(theirs[1])))
                apart.ends.append(ours[2:4] == tuple(map(bool, theirs[2:4])))
            if any(ours[2:4]) or any(theirs[2:4]):
                break
    mirrored.close()
    return apart


# --- Episodes of each -------------------------------------------------------------------------------------------------


@dataclass
class Episodes:
    """Statistics of the episodes of one simulator."""

    returns: list[float]
    """Sum of rewards, by episode."""
    lengths: list[float]
    """Number of policy steps, by episode."""
    crashed: list[float]
    """1 if the ego crashed, else 0, by episode."""
    vehicles: list[float]
    """Number of other vehicles on the road, by scene."""
    near: list[float]
    """Number of other vehicles within the perception range of the reader's `SceneSpec`, by scene."""
    nearest_m: list[float]
    """Distance from the ego to the nearest other vehicle [m], by scene."""
    speed_mps: list[float]
    """Speed of the other vehicles [m/s], by scene and vehicle."""
    starts: int
    """Number of different initial scenes."""


def play(env: gym.Env, driver: str, config: ParityConfig) -> Episodes:
    """Plays the episodes of the config's seeds with a driver (a name, or the path of a policy)."""
    reader = reader_for(env)
    seen = Episodes([], [], [], [], [], [], [], 0)
    starts = set()
    for seed in range(config.seed, config.seed + config.episodes):
        obs, _ = env.reset(seed=seed)
        act = make_ego_driver(driver, env, driver_rng(seed))
        reader.reset()
        scene = reader.read_all(env)
        starts.add(scene.states.round(6).tobytes())
        total, length, over = 0.0, 0, False
        info: dict[str, Any] = {}
        while not over:
            obs, reward, terminated, truncated, info = env.step(act(obs))
            total, length, over = total + float(reward), length + 1, terminated or truncated
            _note(seen, reader.read_all(env).states, reader.spec.perception_m)
        seen.returns.append(total)
        seen.lengths.append(length)
        seen.crashed.append(float(info["crashed"]))
    seen.starts = len(starts)
    return seen


def _note(seen: Episodes, states: np.ndarray, perception_m: float) -> None:
    distance_m = np.linalg.norm(states[1:, :2] - states[0, :2], axis=1)
    seen.vehicles.append(len(distance_m))
    seen.near.append(int((distance_m <= perception_m).sum()))
    if len(distance_m):
        seen.nearest_m.append(float(distance_m.min()))
    seen.speed_mps.extend(np.linalg.norm(states[1:, 2:4], axis=1).tolist())


def _env_id(task_id: str) -> str:
    return next(env_id for env_id, task in ENV_IDS.items() if task == task_id)


def _for_policy(env: gym.Env, config: ParityConfig) -> gym.Env:
    """Returns the environment with forecasts if the policy was trained on them."""
    return ForecastObservation(env, config.checkpoint) if sees_forecasts(str(config.policy)) else env


def check_drivers(config: ParityConfig) -> None:
    """Checks, before minutes of work, that each driver drives in each simulator.

    Raises:
        UserError: an unknown driver, or a policy that was not trained on observations such as these.
    """
    for task_id in config.task_ids:
        for env_id in (_env_id(task_id), HIGHWAY_ENV_OF[task_id]):
            env = make_env(env_id, disable_env_checker=True)
            for driver in config.driver:
                make_ego_driver(driver, env, driver_rng(config.seed))
            if config.policy is not None:
                seen, trained = _for_policy(env, config).observation_space, kept_policy(str(config.policy))
                if trained.observation_space != seen:
                    raise UserError(
                        f"{config.policy} sees other observations than {env_id} gives here: those of "
                        "train_policy.py with --observe forecast (one sample, no plans), or none"
                    )
            env.close()


# --- Report -----------------------------------------------------------------------------------------------------------


def distances_table(task_id: str, apart: Apart) -> Table:
    """Returns a table of the differences of position by step; its caption has those of observations and rewards."""
    table = Table(title=f"{task_id} and {HIGHWAY_ENV_OF[task_id]} from the same states, difference of position \\[m]")
    for heading in ("step", "vehicles", "median", "95 %", "max", "within 0.01 m"):
        table.add_column(heading, justify="right")
    for step, distances in enumerate(map(np.array, apart.distance_m), start=1):
        if len(distances):
            numbers = (np.median(distances), np.percentile(distances, 95), distances.max())
            share = f"{100 * (distances < 0.01).mean():.1f} %"
            table.add_row(str(step), str(len(distances)), *(f"{n:.3g}" for n in numbers), share)
    if apart.ends:
        table.caption = (
            f"while all vehicles agree ({len(apart.ends)} steps), observations differ by at most "
            f"{max(apart.observation):.1g}, rewards by {max(apart.reward):.1g}, ends in {apart.ends.count(False)} steps"
        )
    return table


def episodes_table(task_id: str, driver: str, both: Sequence[tuple[str, Episodes]]) -> Table:
    """Returns a table of both simulators' episodes, mean ± standard deviation (returns, crashes: standard error)."""
    table = Table(title=f"{task_id}, driver {driver}, {len(both[0][1].returns)} episodes each")
    heads = (
        "simulator",
        "return",
        "crashed",
        "steps",
        "others",
        "near",
        "nearest \\[m]",
        "their speed \\[m/s]",
        "starts",
    )
    for heading in heads:
        table.add_column(heading, justify="left" if heading == "simulator" else "right")
    for name, seen in both:
        cells = [mean_and_standard_error(list(map(float, v))) for v in (seen.returns, seen.crashed)]
        spread = (seen.lengths, seen.vehicles, seen.near, seen.nearest_m, seen.speed_mps)
        cells += [(float(np.mean(v)), float(np.std(v))) if v else (math.nan, math.nan) for v in spread]
        numbers = [" ± ".join("–" if math.isnan(n) else f"{n:.2f}" for n in cell) for cell in cells]
        table.add_row(name, *numbers, str(seen.starts))
    return table


def main() -> None:
    """Runs the command."""
    config = parse(ParityConfig, __doc__)
    check_drivers(config)
    console = Console(width=140)
    results: dict[str, Any] = {}
    for task_id in config.task_ids:
        with untouched_drivers():
            apart = step_both(task_id, config)
        console.print(distances_table(task_id, apart))
        results[task_id] = {"apart": asdict(apart)}
        drivers = [*config.driver, *([str(config.policy)] if config.policy else [])] if config.episodes else []
        for driver in drivers:
            with untouched_drivers():
                made = [("envpool", _env_id(task_id)), ("highway-env", HIGHWAY_ENV_OF[task_id])]
                envs = [(name, make_env(env_id, disable_env_checker=True)) for name, env_id in made]
                if driver == str(config.policy):
                    envs = [(name, _for_policy(env, config)) for name, env in envs]
                both = [(name, play(env, driver, config)) for name, env in envs]
            console.print(episodes_table(task_id, driver, both))
            results[task_id][driver] = {name: asdict(seen) for name, seen in both}
    if config.out is not None:
        made_with = provenance(("envpool", "highway-env", "gymnasium", "numpy"))
        write_json(config.out, {"config": asdict(config), "results": results, "provenance": made_with})


if __name__ == "__main__":
    run_entry_point(main)
