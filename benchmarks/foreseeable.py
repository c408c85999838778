"""Measures how much of the prey's future could be foreseen in simple_tag_v3, and how much of it a checkpoint foresees.

`python -m benchmarks.foreseeable` lets trained predators chase. At each step copies of the simulator show where the
prey goes if every predator repeats its last push, which is what the arm `oracle` shows. A forecast can miss it because
it does not know the pushes, what the prey's driver draws at random, this prey's habits, or how any driver decides. So
other forecasts stand beside those of a checkpoint and of constant velocity: the checkpoint's with the nearest
predator's true path given, those of somebody who knows the driver and its habits, but draws anew, and those of
somebody who knows the driver alone and draws the habits, too.
"""

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from agents.policy import load_policy
from envs.drivers.all_agents import Habits
from envs.parallel import ForecastParallelEnv
from envs.plans.keeping_on import CopyableParallelEnv, all_keeping_on
from envs.seeding import reseed
from envs.simulators.copies import running_copy
from envs.simulators.interventions import simulator_of
from predictor.checkpoint import load_checkpoint
from predictor.online import OnlineForecaster
from predictor.scene import Scene, SceneBatch
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import check_out_file, write_json
from predictor.support.markdown import table
from predictor.support.progress import track
from predictor.support.provenance import provenance
from predictor.what_if import ReactiveForecaster

FIRST_SEED = 2_000_000_000
"""Seed of the first episode, that of the test episodes of policies."""


NAMES = (
    "constant velocity",
    "the checkpoint",
    "the checkpoint, told the nearest predator's path",
    "driver and habits known, one draw",
    "driver and habits known, median of draws",
    "driver known, habits drawn, one draw",
    "driver known, habits drawn, median of draws",
)


@dataclass(frozen=True)
class ForeseeableConfig:
    """Compares forecasts of the prey with where it goes if the predators repeat their last push."""

    policy: str = "simple-tag"
    """Policy of the predators: one that ships, a run folder or a .zip; it must see forecasts."""
    checkpoint: str = "simple-tag"
    """Checkpoint that is measured; need not be the policy's."""
    episodes: int = 20
    """Number of episodes."""
    draws: int = 12
    """Number of copies of each step in which the prey's driver draws anew, and as many with habits of other prey."""
    out: Path | None = None
    """JSON file to write the result to."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        check_at_least(self, 1, "episodes", "draws")
        check_out_file(self.out)


def generators_of(driver: Any) -> Iterator[np.random.Generator]:
    """Yields the random streams that a driver of `envs.drivers.all_agents` holds."""
    if isinstance(driver, np.random.Generator):
        yield driver
    elif isinstance(driver, functools.partial):
        for part in (driver.func, *driver.args, *driver.keywords.values()):
            yield from generators_of(part)
    elif isinstance(driver, Mapping):
        for part in driver.values():
            yield from generators_of(part)


def with_habits(driver: Any, habits: Habits) -> Any:
    """Returns the driver of one agent with other habits."""
    if isinstance(driver, Habits):
        return habits
    if isinstance(driver, functools.partial):
        parts = (with_habits(part, habits) for part in driver.args)
        keywords = {name: with_habits(part, habits) for name, part in driver.keywords.items()}
        return functools.partial(with_habits(driver.func, habits), *parts, **keywords)
    return driver


def redrawn(env: ForecastParallelEnv, rng: np.random.Generator, habits: bool = False) -> Any:
    """Returns a copy of the world inside, with its reader, whose drivers draw other numbers from now on.

    Args:
        env: the environment, which is not changed.
        rng: source of the numbers.
        habits: whether the drivers draw their habits anew, too.
    """
    world: Any = CopyableParallelEnv(env.env)
    copied, reader = running_copy((world, env.reader), simulator_of(env.env))
    for own in generators_of(copied.env._driver):
        reseed(own, rng)
    if habits:
        [drivers] = [part for part in copied.env._driver.args if isinstance(part, dict)]
        drivers.update({agent: with_habits(driver, Habits.draw(rng)) for agent, driver in drivers.items()})
    return copied.env, reader


def told_of_nearest(
    forecaster: ReactiveForecaster,
    online: OnlineForecaster,
    scene: Scene,
    prey: int,
    path_m: Float[np.ndarray, "horizon 2"],
    predator: int,
) -> Float[np.ndarray, "horizon 2"]:
    """Returns the forecast of the prey if a predator's path is given.

    Args:
        forecaster: the forecaster, whose plans are those of agent 0.
        online: its stream, in which the predator stands first.
        scene: the scene, agents in its own order.
        prey: index of the prey.
        path_m: positions of the predator [m].
        predator: its index.
    """
    states = np.repeat(scene.states[predator][None], len(path_m), 0).astype(np.float64)
    before = np.concatenate([scene.states[predator][None, :2], path_m[:-1]])
    states[:, :2], states[:, 2:4] = path_m, (path_m - before) / forecaster.spec.dt_s
    [belief] = online._beliefs
    with torch.inference_mode():
        plan = torch.from_numpy(states.astype(np.float32))[None, None]
        future = forecaster.rollout_plans(belief, plan).states[0, 0, 0]
    found: Float[np.ndarray, "horizon 2"] = future[_first(predator, len(scene.ids)).tolist().index(prey), :, :2].numpy()
    return found


def _first(agent: int, agents: int) -> np.ndarray:
    """Returns the order of agents in which one stands first."""
    return np.array([agent, *(other for other in range(agents) if other != agent)])


def measure(config: ForeseeableConfig) -> dict[str, list[float]]:
    """Plays the episodes; returns the mean displacement [m] of the prey's forecasts at each step, by forecaster.

    Raises:
        UserError: the policy sees no forecasts, or the forecaster's agents do not react to each other.
    """
    policy, env = load_policy(config.policy)
    if not isinstance(env, ForecastParallelEnv):
        raise UserError(f"policy '{config.policy}' must see forecasts of simple_tag_v3")
    forecaster, _ = load_checkpoint(config.checkpoint)
    if not isinstance(forecaster, ReactiveForecaster) or forecaster.spec != env.scene_spec:
        raise UserError(f"checkpoint '{config.checkpoint}' must be a network of simple_tag_v3 whose agents react")
    rng = np.random.default_rng(0)
    found: dict[str, list[float]] = {name: [] for name in NAMES}
    for episode in track(range(config.episodes), "play", total=config.episodes):
        observations, _ = env.reset(seed=FIRST_SEED + episode)
        online = OnlineForecaster(forecaster, 1, env.scene_spec.max_agents)
        last: dict[str, Any] = {}
        while env.agents:
            actions = policy(observations)
            prey, hunter = _chase(env)
            scene = env.scene.scene
            order = _first(hunter, len(scene.ids))
            online.observe(SceneBatch.stack([Scene(scene.states[order], scene.ids[order], scene.valid[order])]))
            if last:  # before, what every agent repeats is not known
                told = scene, observations, last, forecaster.horizon_steps
                truth = all_keeping_on(env.env, env.reader, *told)
                again = [redrawn(env, rng) for _ in range(config.draws)]
                others = [redrawn(env, rng, habits=True) for _ in range(config.draws)]
                drawn, of_others = (
                    [all_keeping_on(copied, reader, *told)[prey] for copied, reader in copies]
                    for copies in (again, others)
                )
                forecasts = (
                    _straight(scene, prey, forecaster),
                    online.forecast().xy[0, 0, order.tolist().index(prey)].numpy(),
                    told_of_nearest(forecaster, online, scene, prey, truth[hunter], hunter),
                    drawn[0],
                    np.median(drawn, axis=0),
                    of_others[0],
                    np.median(of_others, axis=0),
                )
                for name, xy_m in zip(NAMES, forecasts, strict=True):
                    found[name].append(float(np.linalg.norm(xy_m - truth[prey], axis=-1).mean()))
            last = dict(actions)
            observations, *_ = env.step(actions)
    return found


def _chase(env: ForecastParallelEnv) -> tuple[int, int]:
    """Returns the indices of the prey and of the predator that is nearest to it."""
    xy_m, index_of = env.scene.scene.states[:, :2], env.scene.index_of
    [prey] = [index for name, index in index_of.items() if not name.startswith("adversary")]
    hunters = [index for name, index in index_of.items() if name.startswith("adversary")]
    return prey, min(hunters, key=lambda index: float(np.linalg.norm(xy_m[index] - xy_m[prey])))


def _straight(scene: Scene, agent: int, forecaster: ReactiveForecaster) -> Float[np.ndarray, "horizon 2"]:
    times_s = forecaster.spec.dt_s * np.arange(1, forecaster.horizon_steps + 1)[:, None]
    path: Float[np.ndarray, "horizon 2"] = scene.states[agent, :2] + times_s * scene.states[agent, 2:4]
    return path


def main() -> None:
    """Runs the command."""
    config = parse(ForeseeableConfig, __doc__)
    torch.set_num_threads(1)
    found = measure(config)
    steps = len(next(iter(found.values())))
    print(
        table((f"{steps:,} steps", "ADE of the prey [m]"), [(name, f"{np.mean(of):.3f}") for name, of in found.items()])
    )
    if config.out is not None:
        means = {name: float(np.mean(of)) for name, of in found.items()}
        write_json(config.out, {"ade_m": means, "steps": steps, "provenance": provenance(("torch", "mpe2"))})


if __name__ == "__main__":
    run_entry_point(main)
