"""Draws the pictures of live traffic in README.md and docs/: `python -m docs.draw_pictures [--only NAME ...]`.

Each picture is a moment of an episode of a fixed seed with a shipped checkpoint, so it changes with the checkpoint.
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib import pyplot as plt
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch, Rectangle

from envs import ForecastObservation, draw_observation, make_env
from envs.drivers.planner import Planner
from envs.rollouts.branches import Branch, branch
from envs.rollouts.causal_labels import causal_labels, settings_for
from envs.rollouts.side_forecasts import SideForecaster
from envs.rollouts.world import World, open_world
from envs.simulators.interventions import Intervention
from envs.video.highway import record_episode
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.checkpoint import PRETRAINED, load_checkpoint, shipped
from predictor.evaluation.in_env_record import read_record
from predictor.reports.looks import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, STYLE, looks_of
from predictor.reports.plots import save_figure
from predictor.scene import Scene
from predictor.support.command_line import parse
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import new_file

DOCS = Path(__file__).resolve().parent
ROAD = "highway-fast-v0"
FUTURES = 6
"""Number of futures that are drawn of each agent."""
MANY_FUTURES = 20
"""The same, where the picture is about how they spread."""
LANES_M = (-2.0, 2.0, 6.0, 10.0)
"""Borders of the three lanes."""
CAR_M = (5.0, 2.0)


@dataclass(frozen=True)
class Moment:
    """Step of an episode."""

    seed: int
    """Seed of the episode."""
    step: int
    """Step within it."""


FILMED = Moment(900_021, 6)
PLANNED = Moment(900_015, 8)
BRAKING = Moment(900_014, 6)
GRAPH = Moment(900_010, 5)
FORKS = {"roundabout-v1": Moment(900_000, 3), "intersection-v2": Moment(900_002, 5)}


@dataclass(frozen=True)
class DrawConfig:
    """Draws the pictures of live traffic in README.md and docs/."""

    only: tuple[str, ...] = ()
    """Names of pictures (highway, what_if, seen, braking_leader, causal_graph, calibration, fans_…);
    none given draws all."""

    def __post_init__(self) -> None:
        """Checks the names.

        Raises:
            UserError: an unknown name.
        """
        unknown = sorted(set(self.only) - set(PICTURES))
        if unknown:
            raise UserError(f"only must be among {', '.join(PICTURES)}, got {', '.join(unknown)}")


def draw_film(env_id: str, moment: Moment, futures: int, path: Path) -> None:
    """Draws a frame of the film of an episode that the planner drives."""
    env = ForecastObservation(make_env(env_id, render_mode="rgb_array"))
    played = record_episode(
        env, Planner(env, env.forecaster), seed=moment.seed, max_steps=moment.step + 6, num_samples=futures
    )
    played.write_frame(path, played.frame_of_step(moment.step))
    env.close()


def draw_what_if(path: Path) -> None:
    """Draws a frame of such a film with the plans of the ego, and the others' forecasts for each."""
    env = ForecastObservation(make_env(ROAD, render_mode="rgb_array"), what_if=True, num_samples=FUTURES)
    played = record_episode(env, Planner(env, env.forecaster), seed=PLANNED.seed, max_steps=PLANNED.step + 6)
    played.write_frame(path, played.frame_of_step(PLANNED.step))
    env.close()


def draw_seen(path: Path) -> None:
    """Draws the observation of the moment of the README's picture, with plans."""
    env = ForecastObservation(make_env(ROAD), what_if=True, num_samples=FUTURES)
    planner = Planner(env, env.forecaster)
    observation, _ = env.reset(seed=FILMED.seed)
    for _ in range(FILMED.step):
        observation, *_ = env.step(planner(observation))
    with new_file(path) as partial:
        draw_observation(observation, y_down=True).save(partial, format="PNG")
    env.close()


@rc_context(STYLE)
def draw_braking_leader(path: Path) -> None:
    """Draws what a leader's braking changes: what happens, what is forecast, and what constant velocity says."""
    world, forecasters = _at(BRAKING, is_seen=False)  # each branch shows its own present
    leader, follower = _leader_and_follower(world)
    found = branch(world, Intervention(leader, "brake", 0, change_mps=8.0, at_once=True), 5)
    figure, (road, ahead) = plt.subplots(2, 1, figsize=(10, 5), layout="constrained", height_ratios=(1, 1.6))
    _plot_scene(road, found.plain.perceived[0], {leader: ORANGE, follower: BLUE})
    road.set_title("orange: the leader, blue: its follower, green: the ego", fontsize=10, loc="left")
    road.set_xlabel("x [m]")
    for one, marker, what in (
        (found.plain, "o", "the leader keeps its speed"),
        (found.perturbed, "s", "the leader is 8 m/s slower, at once"),
    ):
        _plot_ahead(ahead, one, forecasters, found.ids.tolist(), follower, marker, what)
    ahead.axhline(0, color=GREY, lw=1.2, label="constant velocity, in both cases")
    ahead.set(xlabel="time ahead [s]", ylabel="follower ahead of\nconstant velocity [m]")
    ahead.legend(fontsize=9, loc="lower left")
    save_figure(figure, path, 130)


def draw_causal_graph(path: Path) -> None:
    """Draws the causal labels of a scene beside the edges that are inferred."""
    world, forecasters = _at(GRAPH)
    scene, settings = world.perceived(), settings_for(world)
    labels = causal_labels(world, settings)
    probs = 1 - forecasters["highway"].forecast().edge_probs[0, ..., 0].cpu().numpy()
    seen = {int(agent): i for i, agent in enumerate(scene.ids) if scene.valid[i]}
    figure, axes = plt.subplots(2, 1, figsize=(10, 4.4), layout="constrained", sharex=True)
    known = [
        (seen[a], seen[b], float(labels.shift_m[i, j]))
        for i, a in enumerate(labels.ids)
        for j, b in enumerate(labels.ids)
        if a in seen and b in seen and np.isfinite(labels.shift_m[i, j])
    ]
    causes = [(receiver, sender, 1.0) for receiver, sender, shift_m in known if shift_m > settings.threshold_m]
    inferred = [(receiver, sender, float(probs[receiver, sender])) for receiver, sender, _ in known]
    for ax, edges, title in (
        (axes[0], causes, f"simulator: moves by more than {settings.threshold_m:g} m if the other brakes or vanishes"),
        (axes[1], inferred, "inferred: an arrow is as wide as the edge is likely"),
    ):
        _plot_scene(ax, scene)
        _plot_edges(ax, scene, edges)
        ax.set_title(title, fontsize=10, loc="left")
    axes[1].set_xlabel("x [m]")
    save_figure(figure, path, 130)


BEFORE = {
    "highway-fast-v0": (26, 36), "highway-mixed-v0": (11, 21), "merge-v1": (8, 8), "roundabout-v1": (1, 1),
    "intersection-v2": (7, 9), "simple_tag_v3": (1, 5), "exit-v1": (29, 33), "two-way-v0": (6, 6),
    "merge-generic-v1": (0, 0), "roundabout-generic-v1": (5, 5), "u-turn-v1": (7, 7), "simple_spread_v3": (7, 7),
}  # fmt: skip
"""Least and largest share, by step, of checkpoints without modes in these episodes [%], docs/checkpoint_history.md."""


@rc_context(STYLE)
def draw_calibration(path: Path) -> None:
    """Draws what share of truths the central 90 % of the samples hold, from the records beside the checkpoints."""
    records = [one for name in shipped() for one in read_record(PRETRAINED / name) if one.coverage and one.controls]
    measured = {one.env_id: (one.coverage or (0.0, 0.0), one.controls or {}) for one in records}
    names = list(dict.fromkeys(name for _, controls in measured.values() for name in controls))
    looks = dict(zip(names, looks_of(names), strict=True)) | {"model + Gaussian noise": {"color": ORANGE}}
    figure, ax = plt.subplots(figsize=(9, 1.4 + 0.25 * len(measured)), layout="constrained")
    ax.axvline(90, color=BLACK, lw=0.8, ls=":", label="calibrated: 90 %")
    for place, (spread, controls) in enumerate(measured.values()):
        shares = {name: controls[name].coverage for name in names if name in controls}
        ax.plot(
            100 * np.array(spread), [place, place], color=BLUE, lw=5, solid_capstyle="butt",
            label=None if place else "plural dG-VAE",
        )  # fmt: skip
        for (name, share), marker in zip(shares.items(), "sD^", strict=False):
            ax.plot(
                np.nan if share is None else 100 * share, place, ls="", marker=marker, ms=6,
                color=looks[name]["color"], label=None if place else name,
            )  # fmt: skip
    for place, env_id in enumerate(measured):
        if env_id in BEFORE:
            least, most = BEFORE[env_id]
            label = "dG-VAE without modes" if env_id == next(iter(BEFORE)) else None
            ax.plot([least, max(most, least + 0.5)], [place, place], color=BLACK, lw=5, label=label)
    ax.set_yticks(range(len(measured)), list(measured))
    ax.set(
        xlabel="truths within the central 90 % of 20 samples [%]: dG-VAE least to most of the steps, others all steps",
        xlim=(-1, 100),
    )
    ax.invert_yaxis()
    figure.legend(loc="outside lower center", ncols=3, fontsize=9)
    save_figure(figure, path, 130)


def _at(moment: Moment, is_seen: bool = True) -> tuple[World, dict[str, SideForecaster]]:
    """Returns the world at a moment, and forecasters that have seen it up to then, or up to the step before."""
    model, info = load_checkpoint("highway")
    world = open_world(ROAD, "idle", perceived_as=info.spec)
    world.reset(moment.seed)
    forecasters = {
        "highway": SideForecaster(model, world.spec, 5),
        "constant velocity": SideForecaster(ConstantVelocity(world.spec), world.spec, 5),
    }
    for step in range(moment.step):
        is_last = step == moment.step - 1
        if is_seen or not is_last:
            for forecaster in forecasters.values():
                forecaster.observe(world.perceived())
        if not is_last:
            world.step()
    return world, forecasters


def _leader_and_follower(world: World) -> tuple[int, int]:
    """Returns the pair with the smallest gap on one lane, without the ego."""
    scene = world.perceived()
    pairs = [
        (scene.states[a, 0] - scene.states[b, 0], int(scene.ids[a]), int(scene.ids[b]))
        for a in np.flatnonzero(scene.valid)[1:]
        for b in np.flatnonzero(scene.valid)[1:]
        if abs(scene.states[a, 1] - scene.states[b, 1]) < 1.0 and scene.states[a, 0] > scene.states[b, 0] + 5.0
    ]
    _, leader, follower = min(pairs)
    return leader, follower


def _plot_ahead(
    ax: Axes,
    found: Branch,
    forecasters: dict[str, SideForecaster],
    ids: Sequence[int],
    follower: int,
    marker: str,
    what: str,
) -> None:
    """Plots how far the follower gets, relative to its present speed: truth solid, forecast dashed."""
    scene = found.perceived[0]
    place = scene.ids.tolist().index(follower)
    forecaster, straight = copy.deepcopy(forecasters["highway"]), copy.deepcopy(forecasters["constant velocity"])
    lines = []
    for one in (forecaster, straight):
        one.observe(scene)
        lines.append(one.forecast().xy[0, 0, place, :, 0].cpu().numpy() + scene.states[0, 0])
    truth = found.states[1:, ids.index(follower), 0]
    time_s = np.arange(len(truth) + 1)
    for x_m, color, style, who in ((truth, BLACK, "-", "truth"), (lines[0], BLUE, "--", "forecast")):
        ax.plot(time_s, [0.0, *(x_m - lines[1])], color=color, ls=style, marker=marker, ms=5, label=f"{who}: {what}")


def _plot_scene(ax: Axes, scene: Scene, colors: dict[int, str] | None = None) -> None:
    """Plots lanes and vehicles; the ego is green."""
    states = scene.states[scene.valid]
    low, high = states[:, 0].min() - 15.0, states[:, 0].max() + 15.0
    for border in LANES_M:
        outer = border in (LANES_M[0], LANES_M[-1])
        ax.plot([low, high + 150.0], [border, border], color="0.4", lw=1.0, ls="-" if outer else (0, (6, 6)), zorder=0)
    for agent, state in zip(scene.ids[scene.valid].tolist(), states, strict=True):
        color = (colors or {}).get(agent, GREEN if agent == int(scene.ids[0]) else "0.75")
        corner = state[:2] - np.array(CAR_M) / 2
        ax.add_patch(Rectangle((float(corner[0]), float(corner[1])), *CAR_M, color=color, zorder=1))
    ax.set(xlim=(low, high), ylim=(LANES_M[-1] + 1.0, LANES_M[0] - 2.5), yticks=[])
    ax.grid(False)


def _plot_edges(ax: Axes, scene: Scene, edges: Sequence[tuple[int, int, float]]) -> None:
    """Plots arrows from sender to receiver, as wide as they are likely."""
    for receiver, sender, prob in edges:
        if prob < 0.05:
            continue
        places: list[Float[np.ndarray, "2"]] = [scene.states[agent, :2] for agent in (sender, receiver)]
        ax.add_patch(
            FancyArrowPatch(
                tuple(places[0]), tuple(places[1]), connectionstyle="arc3,rad=0.12", arrowstyle="-|>",
                mutation_scale=9 + 5 * prob, lw=0.4 + 2.6 * prob, color=PURPLE, alpha=0.25 + 0.65 * prob,
            )
        )  # fmt: skip


PICTURES: dict[str, Callable[[Path], None]] = {
    "highway": partial(draw_film, ROAD, FILMED, FUTURES),
    "what_if": draw_what_if,
    "seen": draw_seen,
    "braking_leader": draw_braking_leader,
    "causal_graph": draw_causal_graph,
    "calibration": draw_calibration,
    **{
        f"fans_{env_id.partition('-')[0]}": partial(draw_film, env_id, moment, MANY_FUTURES)
        for env_id, moment in FORKS.items()
    },
}


def main() -> None:
    """Entry point."""
    matplotlib.use("Agg")
    config = parse(DrawConfig, __doc__)
    for name in config.only or PICTURES:
        PICTURES[name](DOCS / f"{name}.png")
        print(DOCS / f"{name}.png")


if __name__ == "__main__":
    run_entry_point(main)
