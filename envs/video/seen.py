"""Draws what a policy sees: the entries of one observation with forecasts, and nothing else, in the ego's frame."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from numpy.typing import NDArray
from PIL import Image

from envs.entries import FORECAST_KEYS, PATH_KEYS
from envs.video.drawing import MIN_OPACITY
from predictor.reports.looks import BLACK, BLUE, GREY, ORANGE, PINK, SKY, STYLE
from predictor.support.errors import UserError

_EDGE_WIDTH_PT = 5.0  # of an edge of probability 1
_ARROW_WIDTH = 0.002  # of the map
_TEXT_PT = 8.0
_MAP_MARGIN = 0.05  # on each side, of the width
_MAP_ASPECT = 3.0  # width by height


@rc_context(STYLE)
def draw_observation(observation: Mapping[str, Any], *, y_down: bool = False) -> Image.Image:
    """Draws an observation with forecasts: where the others are and go, edges, smallest gaps, and what-if risks.

        >>> from envs import ForecastObservation, draw_observation, make_env
        >>> env = ForecastObservation(make_env("highway-fast-v0"), "highway", num_samples=3)
        >>> observation, info = env.reset(seed=0)
        >>> draw_observation(observation, y_down=True).size
        (1100, 700)

    Agents carry the number of their row in the entries. The picture holds the added entries alone, so that a look at it
    answers whether a policy can know something. Not drawn are the environment's own observation, and features of agents
    beyond position and velocity.

    Args:
        observation: entries of one observation, as `ForecastObservation` gives them; with `flatten=True`, what
            `unflatten` makes of it.
        y_down: draw y downwards, as the pictures of highway-env do.

    Returns:
        A picture, which notebooks show and `save("seen.png")` writes.

    Raises:
        UserError: an entry is missing, or these are the observations of many environments.
    """
    entries = _entries_of_one(observation)
    shown = np.flatnonzero(entries["valid"])
    what_if = "what_if_risk" in entries
    figure = Figure(figsize=(11, 7), dpi=100, layout="constrained")
    figure.suptitle(f"{len(shown)} agents, {len(entries['valid']) - len(shown)} rows of padding", fontsize=_TEXT_PT + 1)
    places = figure.add_gridspec(2, 1, height_ratios=(3, 2))
    plot_scene(figure.add_subplot(places[0]), entries, y_down)
    if len(shown):
        below = places[1].subgridspec(1, 2 + what_if)
        _plot_each_agent([figure.add_subplot(below[i]) for i in range(2 + what_if)], entries, shown)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")


def _plot_each_agent(panels: Sequence[Axes], entries: Mapping[str, NDArray[Any]], shown: NDArray[Any]) -> None:
    """Draws what has a row for each agent, below the map."""
    plot_closest(panels[0], entries)
    _plot_rows(panels[1], entries["edge_features"][shown], shown, "edge feature", "value")
    panels[1].set_title("edge features: agent → ego, then ego → agent", fontsize=_TEXT_PT + 1)
    if len(panels) > 2:
        _plot_rows(panels[2], entries["what_if_risk"][shown], shown, "plan of the ego", "risk", (0.0, 1.0))
        _write_gaps(panels[2], entries["what_if_gap"][shown], entries["what_if_risk"][shown])


def plot_scene(ax: Axes, entries: Mapping[str, NDArray[Any]], y_down: bool = False) -> Axes:
    """Draws the agents with their futures and edges around the ego, which is at the origin and looks along x [m].

    Edges are as wide as they are likely, each along the half that ends at the agent it acts on.

    Args:
        ax: axis to draw on.
        entries: entries of one observation; agents whose `valid` is 0 are not drawn.
        y_down: draw y downwards.
    """
    forecast = np.asarray(entries["forecast"])
    futures = forecast if forecast.ndim == 4 else forecast[:, None]
    probs = np.asarray(entries.get("mode_probs", np.ones(futures.shape[:2]))).reshape(futures.shape[:2])
    scale = entries.get("xy_scale")
    scales = None if scale is None else np.asarray(scale).reshape(futures.shape)
    path = np.vstack([np.zeros((1, 2)), entries["ego_path"]])
    for row in np.flatnonzero(entries["valid"]):
        here: Any = entries["agents"][row, :2]
        to_ego, from_ego = np.split(entries["edge_probs"][row], 2)
        for prob, end, color in ((to_ego.sum(), 0 * here, PINK), (from_ego.sum(), here, SKY)):
            ax.plot(*np.stack([here / 2, end], 1), color=color, lw=_EDGE_WIDTH_PT * prob, alpha=0.6, zorder=1)
        for k, (future, prob) in enumerate(zip(futures[row], probs[row], strict=True)):
            line = np.vstack([here, future])
            opacity = MIN_OPACITY + (1 - MIN_OPACITY) * float(prob)
            ax.plot(*line.T, color=ORANGE, ls="--", marker=".", ms=3, lw=1.2, alpha=opacity, zorder=3)
            if scales is not None:
                ax.add_patch(Ellipse(future[-1], *2 * scales[row, k, -1], color=ORANGE, alpha=0.2 * opacity, lw=0))
        ax.plot(*here, "o", color=BLUE, ms=6, zorder=4)
        speed = entries["agents"][row, 2:4]
        ax.quiver(*here, *speed, angles="xy", scale_units="xy", scale=1, width=_ARROW_WIDTH, color=BLACK, zorder=4)
        ax.annotate(str(row), here, (0, 6), textcoords="offset points", ha="center", fontsize=_TEXT_PT, zorder=5)
    ax.plot(*path.T, color=GREY, marker=".", ms=3, zorder=2)
    ax.plot(0, 0, ">", color=BLACK, ms=8, zorder=4)
    _label_scene(ax, scales is not None)
    _frame(ax, entries, futures, path, y_down)
    return ax


def plot_closest(ax: Axes, entries: Mapping[str, NDArray[Any]]) -> Axes:
    """Draws how close each agent's forecast comes to the ego's path at constant velocity [m], and when."""
    shown = np.flatnonzero(entries["valid"])
    gap_m, share = entries["closest"][shown].T
    places = np.arange(len(shown))
    ax.barh(places, gap_m, color=BLUE)
    for place, (gap, when) in enumerate(zip(gap_m, share, strict=True)):
        ax.text(gap, place, f" {gap:.1f} m at {100 * when:.0f} %", va="center", fontsize=_TEXT_PT)
    ax.set_yticks(places, [str(row) for row in shown])
    ax.invert_yaxis()
    ax.set_xlim(right=1.35 * max(gap_m.max(initial=0.0), 1.0))
    ax.set_xlabel("smallest distance to the ego's path [m]")
    ax.set_ylabel("agent")
    ax.set_title("closest: distance, and when in the horizon", fontsize=_TEXT_PT + 1)
    return ax


def _entries_of_one(observation: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    if not isinstance(observation, Mapping):
        raise UserError(
            f"draw_observation needs the entries of an observation (a dict), got {type(observation).__name__}; "
            "unflatten(env, observation) makes them of a flat one"
        )
    missing = [key for key in (*FORECAST_KEYS, *PATH_KEYS) if key not in observation]
    if missing:
        raise UserError(
            f"draw_observation needs an observation of a wrapper with forecasts, but {', '.join(missing)} "
            f"{'is' if len(missing) == 1 else 'are'} missing; got {', '.join(map(str, observation)) or 'no entries'}; "
            "of a PettingZoo environment take one agent's, observations[agent]"
        )
    entries = {key: np.asarray(value) for key, value in observation.items()}
    if entries["valid"].ndim != 1:
        raise UserError(
            f"draw_observation draws one observation, got those of {len(entries['valid'])} environments; take one: "
            "{key: value[0] for key, value in observations.items()}"
        )
    return entries


def _label_scene(ax: Axes, scaled: bool) -> None:
    ax.plot([], [], ">", color=BLACK, label="ego")
    ax.plot([], [], color=GREY, marker=".", label="its path at constant velocity")
    ax.plot([], [], color=ORANGE, ls="--", marker=".", label="forecast" + (", 1 σ at its end" if scaled else ""))
    ax.plot([], [], color=BLACK, lw=1, label="relative velocity, of 1 s")
    ax.plot([], [], color=PINK, lw=_EDGE_WIDTH_PT / 2, alpha=0.6, label="edge to the ego")
    ax.plot([], [], color=SKY, lw=_EDGE_WIDTH_PT / 2, alpha=0.6, label="edge from the ego")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=6, fontsize=_TEXT_PT)
    ax.set(xlabel="x, along the ego's heading if it has one [m]", ylabel="y [m]")


def _frame(
    ax: Axes,
    entries: Mapping[str, NDArray[Any]],
    futures: Float[np.ndarray, "others samples horizon 2"],
    path: Float[np.ndarray, "points 2"],
    y_down: bool,
) -> None:
    """Sets limits around everything that is drawn; the map has always the same shape, and one scale on both axes."""
    valid = np.asarray(entries["valid"]) > 0
    points = np.vstack([path, entries["agents"][valid, :2], futures[valid].reshape(-1, 2)])
    middle, sides = (points.min(0) + points.max(0)) / 2, np.ptp(points, axis=0)
    width = (1 + 2 * _MAP_MARGIN) * max(float(sides[0]), _MAP_ASPECT * float(sides[1]), 1.0)
    ax.set_xlim(middle[0] - width / 2, middle[0] + width / 2)
    ax.set_ylim(middle[1] - width / _MAP_ASPECT / 2, middle[1] + width / _MAP_ASPECT / 2)
    ax.set_aspect("equal")
    if y_down:
        ax.invert_yaxis()


def _plot_rows(
    ax: Axes, values: Float[np.ndarray, "agents columns"], rows: NDArray[Any], name: str, unit: str,
    limits: tuple[float, float] | None = None,
) -> None:  # fmt: skip
    """Draws one row of colours for each agent."""
    largest = float(np.abs(values).max(initial=1e-6))
    low, high = limits or (-largest, largest)
    image = ax.imshow(
        values, aspect="auto", cmap="cividis" if limits else "RdBu_r", vmin=low, vmax=high, interpolation="nearest"
    )
    ax.set_yticks(np.arange(len(rows)), [str(row) for row in rows])
    ax.set(xlabel=name, ylabel="agent")
    ax.grid(False)
    ax.figure.colorbar(image, ax=ax, label=unit)


def _write_gaps(ax: Axes, gap_m: Float[np.ndarray, "agents plans"], risk: Float[np.ndarray, "agents plans"]) -> None:
    """Writes the smallest gap of each agent in each plan into the rows of risks, readable on either colour."""
    for (row, plan), gap in np.ndenumerate(gap_m):
        color = "0.8" if risk[row, plan] < 0.5 else BLACK
        ax.text(plan, row, f"{gap:.0f}", ha="center", va="center", fontsize=_TEXT_PT - 1, color=color)
    ax.set_title("what-if: risk of a contact, and smallest gap [m]", fontsize=_TEXT_PT + 1)
