"""Accuracy where it is deployed: `python -m envs.evaluate --env-ids roundabout-v1 --episodes 50`.

Drives the live environment through `ForecastObservation`, reads each step's forecast out of the policy's observation,
and compares it with what then happened to those agents, seen by the ego or not. Constant velocity forecasts the same
scenes. The ego itself is not counted: its future is the policy's choice.
"""

import multiprocessing
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from jaxtyping import Float
from rich.console import Console
from rich.progress import track
from rich.table import Table

from envs.egos import make_ego, require_view, sees_forecasts
from envs.observation import into_ego_axes, others_by_distance
from envs.readers import HighwayReader, reader_for
from envs.registry import CHECKPOINTS, checkpoint_for, make_env
from envs.wrappers import ForecastObservation
from predictor.accuracy import Accuracy, Outcome, fitted_std_m, summarise
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.checkpoint import CONSTANT_VELOCITY, load_forecaster, read_info, resolve
from predictor.errors import UserError, run_entry_point
from predictor.evaluate import accuracy_table, markdown_table
from predictor.metrics import min_ade
from predictor.online import OnlineForecaster
from predictor.provenance import provenance, write_json
from predictor.scene import Scene, SceneBatch


@dataclass(frozen=True)
class EvaluateConfig:
    """Measure forecasts inside live environments, through the deployed wrapper, beside constant velocity."""

    env_ids: tuple[str, ...] = tuple(CHECKPOINTS)
    """Environments; all ids with a shipped checkpoint by default."""
    checkpoint: str | None = None
    """Shipped name or folder; None takes the one that ships for each id."""
    episodes: int = 50
    """Episodes per environment."""
    ego: str = "varied"
    """Who drives: random, idle, varied, keep-lane, or the path of a policy .zip (which gets the measured forecasts)."""
    seed: int = 900_000
    """Episode i is seeded with seed + i; the shipped checkpoints were trained on seeds from 100,000 on."""
    samples: int = 20
    """K of the second row; the first is K = 1, the most likely forecast."""
    horizon_steps: int | None = None
    """Steps to forecast; None takes each checkpoint's."""
    max_steps: int = 200
    """Cut longer episodes here [policy steps]."""
    workers: int = os.cpu_count() or 1
    """Parallel processes."""
    out: Path | None = None
    """Folder for accuracy.json and accuracy.md."""

    def check(self) -> None:
        """Check ranges.

        Raises:
            UserError: a value that makes no sense. (In `__post_init__`, tyro would turn it into a box of lines.)
        """
        for name in ("episodes", "samples", "max_steps", "workers"):
            if getattr(self, name) < 1:
                raise UserError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.horizon_steps is not None and self.horizon_steps < 1:
            raise UserError(f"horizon_steps must be at least 1, got {self.horizon_steps}")
        if self.seed < 0:
            raise UserError(f"seed must not be negative, got {self.seed}")


@dataclass(frozen=True)
class EnvAccuracy:
    """Accuracy in one environment."""

    env_id: str
    """The environment."""
    checkpoint: str
    """The forecaster's name or folder."""
    dt_s: float
    """Time step [s]."""
    model: Accuracy
    """K = 1, the most likely forecast."""
    model_samples: Accuracy
    """Best of K."""
    constant_velocity: Accuracy
    """The baseline on the same scenes."""
    reduction: float
    """1 − minADE(K = 1) / ADE of constant velocity."""
    reduction_interval: tuple[float, float]
    """95 % bootstrap interval of the reduction over episodes."""


@dataclass(frozen=True)
class _Task:
    env_id: str
    checkpoint: str
    ego: str
    seed: int
    samples: int
    horizon_steps: int
    max_steps: int


def evaluate_env(config: EvaluateConfig, env_id: str) -> EnvAccuracy:
    """Run the episodes of one environment and summarise them.

    Raises:
        UserError: unknown env or checkpoint, or episodes too short to compare anything.
    """
    checkpoint = config.checkpoint if config.checkpoint is not None else checkpoint_for(env_id)
    if checkpoint != CONSTANT_VELOCITY:
        checkpoint = str(resolve(checkpoint))
    env = make_env(env_id)
    spec = reader_for(env).spec
    forecaster = load_forecaster(checkpoint, spec, f"env '{env_id}'")
    horizon = config.horizon_steps or forecaster.horizon_steps
    measured = ForecastObservation(env, checkpoint, horizon_steps=horizon)
    require_view(measured if sees_forecasts(config.ego) else env, config.ego)
    make_ego(config.ego, env, np.random.default_rng(0))
    tasks = [
        _Task(env_id, checkpoint, config.ego, config.seed + i, config.samples, horizon, config.max_steps)
        for i in range(config.episodes)
    ]
    results: list[tuple[Outcome, Outcome]] = []
    context = multiprocessing.get_context("spawn")
    with context.Pool(min(config.workers, len(tasks)), initializer=torch.set_num_threads, initargs=(1,)) as pool:
        results.extend(track(pool.imap(_episode, tasks, chunksize=2), f"evaluate {env_id}", total=len(tasks)))
    model = [m for m, _ in results]
    baseline = [b for _, b in results]
    first = [Outcome(m.forecast[:, :1], m.future, m.valid) for m in model]
    std_m = () if checkpoint == CONSTANT_VELOCITY else read_info(Path(checkpoint)).std_m
    rows = (
        summarise("dG-VAE", first, std_m),
        summarise("dG-VAE", model, std_m),
        # Its spread is fitted on these very errors, in its favour: it has no training data of its own.
        summarise("constant velocity", baseline, fitted_std_m(baseline)),
    )
    if not rows[0].agents:
        raise UserError(f"{env_id}: no forecast has {horizon} steps of truth; lower --horizon-steps or add episodes")
    reduction, interval = _reduction(first, baseline)
    name = Path(checkpoint).name
    return EnvAccuracy(env_id, name, spec.dt_s, *rows, reduction, interval)


def _episode(task: _Task) -> tuple[Outcome, Outcome]:
    env = ForecastObservation(
        make_env(task.env_id, disable_env_checker=True),
        task.checkpoint,
        horizon_steps=task.horizon_steps,
        num_samples=max(2, task.samples),  # keeps the samples axis; sample 0 is the most likely
    )
    reader: HighwayReader = env.get_wrapper_attr("reader")
    obs, _ = env.reset(seed=task.seed)
    ego = make_ego(task.ego, env, np.random.default_rng(task.seed))
    baseline = OnlineForecaster(ConstantVelocity(reader.spec, task.horizon_steps), 1, reader.spec.max_agents)
    scenes, truths, forecasts, straight = [], [], [], []
    for step in range(task.max_steps + 1):
        scene = env.scene
        scenes.append(scene)
        truths.append(reader.read_all(env))
        forecasts.append(_world_forecast(obs, scene)[: task.samples])
        baseline.observe(SceneBatch.stack([scene]))
        straight.append(baseline.forecast().xy[0])
        if step == task.max_steps:
            break
        seen = {**obs, "forecast": obs["forecast"][:, 0]} if sees_forecasts(task.ego) else obs["observation"]
        obs, _, terminated, truncated, _ = env.step(ego(seen))
        if terminated or truncated:
            truths.append(reader.read_all(env))
            break
    env.close()
    future, valid = _futures(scenes, truths, task.horizon_steps)
    return Outcome(torch.stack(forecasts), future, valid), Outcome(torch.stack(straight), future, valid)


def _world_forecast(obs: dict[str, Any], scene: Scene) -> torch.Tensor:
    """The observation's forecast, back in the rows of the scene and world axes, relative to the ego: (K, A, H, 2)."""
    batch = SceneBatch.stack([scene])
    rotation = into_ego_axes(batch.heading_rad)[0]
    world = obs["forecast"].astype(np.float64) @ rotation
    samples, horizon = world.shape[1], world.shape[2]
    rows = np.zeros((samples, len(scene.ids), horizon, 2))
    rows[:, 1 + others_by_distance(batch)[0]] = world.swapaxes(0, 1)
    return torch.from_numpy(rows).float()


def _futures(scenes: Sequence[Scene], truths: Sequence[Scene], horizon_steps: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Where the agents of each scene then were, relative to the ego at the scene's instant, and whether they were."""
    agents = len(scenes[0].ids)
    future = np.zeros((len(scenes), agents, horizon_steps, 2))
    valid = np.zeros((len(scenes), agents, horizon_steps), dtype=np.bool_)
    positions = [dict(zip(t.ids.tolist(), t.states[:, :2], strict=True)) for t in truths]
    for now, scene in enumerate(scenes):
        for row in range(1, agents):
            for ahead in range(horizon_steps):
                later = now + ahead + 1
                if not scene.valid[row] or later >= len(positions):
                    continue
                position = positions[later].get(int(scene.ids[row]))
                if position is not None:
                    future[now, row, ahead] = position - scene.states[0, :2]
                    valid[now, row, ahead] = True
    return torch.from_numpy(future).float(), torch.from_numpy(valid)


def _reduction(model: Sequence[Outcome], baseline: Sequence[Outcome]) -> tuple[float, tuple[float, float]]:
    """Relative reduction of ADE and its 95 % interval: bootstrap over episodes, the same for both."""
    sums = np.zeros((len(model), 2))
    for i, outcomes in enumerate(zip(model, baseline, strict=True)):
        for j, outcome in enumerate(outcomes):
            error, _ = min_ade(outcome.forecast, outcome.future, outcome.valid)
            sums[i, j] = float(error[outcome.valid.all(-1)].sum())
    draws = np.random.default_rng(0).integers(len(sums), size=(2000, len(sums)))
    totals = sums[draws].sum(axis=1)
    low, high = np.percentile(_relative(totals), [2.5, 97.5])
    return float(_relative(sums.sum(axis=0))), (float(low), float(high))


def _relative(totals: Float[np.ndarray, "*draws 2"]) -> Float[np.ndarray, "*draws"]:
    """1 − first / second; nothing to improve on is no improvement."""
    first, second = totals[..., 0], totals[..., 1]
    return np.where(second > 0, 1 - first / np.where(second > 0, second, 1.0), 0.0)


def overview(rows: Sequence[EnvAccuracy]) -> Table:
    """One line per environment."""
    table = Table(title="in-env accuracy, held-out seeds")
    for heading in ("env", "checkpoint", r"dt \[s]", "steps"):
        table.add_column(heading)
    for heading in ("minADE₁", "minFDE₁", "minADE_K", "CV ADE", "CV FDE", "ADE below CV", "95 %", "forecasts"):
        table.add_column(heading, justify="right")
    for row in rows:
        table.add_row(*_overview_cells(row))
    return table


def overview_markdown(rows: Sequence[EnvAccuracy]) -> str:
    """The same as Markdown."""
    heads = ["env", "checkpoint", "dt [s]", "steps", "minADE₁ [m]", "minFDE₁ [m]", "minADE_K [m]", "CV ADE [m]",
             "CV FDE [m]", "ADE below CV", "95 % interval", "forecasts"]  # fmt: skip
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    return "\n".join(lines + ["| " + " | ".join(_overview_cells(r)) + " |" for r in rows]) + "\n"


def _overview_cells(row: EnvAccuracy) -> list[str]:
    low, high = row.reduction_interval
    one, many, straight = row.model, row.model_samples, row.constant_velocity
    return [
        row.env_id, row.checkpoint, f"{row.dt_s:g}", str(len(one.by_step_m)),
        f"{one.min_ade_m:.2f}", f"{one.min_fde_m:.2f}", f"{many.min_ade_m:.2f}",
        f"{straight.min_ade_m:.2f}", f"{straight.min_fde_m:.2f}",
        f"{100 * row.reduction:.0f} %", f"{100 * low:.0f} to {100 * high:.0f} %", str(one.agents),
    ]  # fmt: skip


def main() -> None:
    """Entry point."""
    config = tyro.cli(EvaluateConfig, description=__doc__)
    config.check()
    console = Console(width=170)
    for env_id in config.env_ids:
        make_env(env_id).close()  # complain about any unknown id before hours of work
    results = []
    for env_id in config.env_ids:
        result = evaluate_env(config, env_id)
        results.append(result)
        rows = (result.model, result.model_samples, result.constant_velocity)
        console.print(accuracy_table(rows, result.dt_s, f"{env_id}, checkpoint {result.checkpoint}"))
    console.print(overview(results))
    if config.out is not None:
        config.out.mkdir(parents=True, exist_ok=True)
        made = provenance(("highway-env", "gymnasium", "torch", "numpy"))
        content = {"config": asdict(config), "results": [asdict(r) for r in results], "provenance": made}
        write_json(config.out / "accuracy.json", content)
        sections = [
            f"### {r.env_id}\n\n" + markdown_table((r.model, r.model_samples, r.constant_velocity), r.dt_s)
            for r in results
        ]
        (config.out / "accuracy.md").write_text(overview_markdown(results) + "\n" + "\n".join(sections))


if __name__ == "__main__":
    run_entry_point(main)
