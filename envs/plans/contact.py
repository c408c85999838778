"""Contacts between an ego that follows plans and the forecast of other agents: gaps, times and probabilities.

Every agent is a rectangle along its direction of motion, all of one size. Between two steps agents move straight,
and are compared at several instants; where they move so fast that two instants could lie before and after a contact,
the least gap of the whole step is taken. The gap of two rectangles is the largest separation along an axis of one of
them: at most their distance, and negative exactly where they overlap.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from predictor.scene import Forecast, SceneBatch

INSTANTS = 5
"""Number of instants at which agents are compared in each step."""
LEAST_SPEED_MPS = 0.1
"""Lowest speed that has a direction [m/s]; slower agents keep their heading."""
FAR_M = 1000.0
"""Largest gap [m], so that a far agent does not become infinite."""


class Contacts(NamedTuple):
    """Contacts of the ego with every other agent, for each plan and sample."""

    gap_m: Float[np.ndarray, "batch plans samples others"]
    """Smallest gap over the horizon [m]; `FAR_M` for absent agents."""
    share: Float[np.ndarray, "batch plans samples others"]
    """Time of the first contact as a share of the horizon; 1 without a contact."""
    by_step: Bool[np.ndarray, "batch plans samples others horizon"]
    """Whether there was a contact by each step."""
    probs: Float[np.ndarray, "batch samples others"]
    """Probability of each sample for each agent."""
    enumerated: bool
    """Whether samples are modes of each agent; else each is a draw of the whole scene."""

    def risk(self) -> Float[np.ndarray, "batch plans others"]:
        """Returns the probability of a contact with each agent within the horizon."""
        return np.einsum("bka,bpka->bpa", self.probs, self.by_step[..., -1].astype(np.float64))

    def survival(self) -> Float[np.ndarray, "batch plans horizon"]:
        """Returns the probability of no contact by each step.

        Draws are counted as whole scenes. Modes of different agents are combined as independent.
        """
        if not self.enumerated:
            return 1.0 - self.by_step.any(axis=3).mean(axis=2)
        by_agent = np.einsum("bka,bpkah->bpah", self.probs, self.by_step.astype(np.float64))
        survival: Float[np.ndarray, "batch plans horizon"] = (1.0 - by_agent).clip(0.0, 1.0).prod(axis=2)
        return survival


def contacts(
    forecast: Forecast,
    scenes: SceneBatch,
    size_m: tuple[float, float] | Float[np.ndarray, "batch 2"],
    dt_s: float,
) -> Contacts:
    """Computes the contacts of the ego with the other agents of each scene.

    Args:
        forecast: forecast with an axis of plans, agents as in `scenes`.
        scenes: observed scenes, which give where and how agents move now.
        size_m: length and width of every agent [m], of all scenes or of each. Which way another agent faces is known
            from its motion alone: one that stands still, and is forecast to, is taken to face along x.
        dt_s: time between two steps [s].
    """
    xy = forecast.xy.cpu().numpy().astype(np.float64)
    batch, plans, samples, agents, horizon = xy.shape[:5]
    now_m = (scenes.states[..., :2] - scenes.states[:, :1, :2])[:, None, None, :, None]
    path = np.concatenate([np.broadcast_to(now_m, (*xy.shape[:4], 1, 2)), xy], axis=-2)
    heading_rad = np.arctan2(scenes.states[..., 3], scenes.states[..., 2])
    slow = np.hypot(scenes.states[..., 2], scenes.states[..., 3]) < LEAST_SPEED_MPS
    heading_rad[:, 0] = np.where(slow[:, 0], scenes.heading_rad, heading_rad[:, 0])
    headings = _headings(path, np.broadcast_to(heading_rad[:, None, None], xy.shape[:4]), LEAST_SPEED_MPS * dt_s)
    sizes = np.broadcast_to(np.asarray(size_m, np.float64), (batch, 2)).T.reshape(2, batch, 1, 1, 1, 1)
    there = scenes.valid[:, None, None, 1:, None]
    gap = _gaps(path[:, :, :, :1], path[:, :, :, 1:], headings[:, :, :, :1], headings[:, :, :, 1:], sizes, there)
    gap = np.where(there[..., None], gap, FAR_M).clip(max=FAR_M)
    touching = ~(gap > 0)  # what is not a number counts as a contact, not as a free way
    touched = touching.reshape(batch, plans, samples, agents - 1, horizon * INSTANTS)
    ever = touched.any(-1)
    share = np.where(ever, (1 + touched.argmax(-1)) / (horizon * INSTANTS), 1.0)
    by_step = np.logical_or.accumulate(touching.any(-1), axis=-1)
    # the probabilities of agents do not depend on the plan
    probs = forecast.sample_probs().cpu().numpy()[:, 0, :, 1:].astype(np.float64)
    return Contacts(gap.min((-2, -1)), share, by_step, probs, forecast.mode_probs is not None)


def _headings(
    path: Float[np.ndarray, "*batch points 2"], now_rad: Float[np.ndarray, "*batch"], least_m: float
) -> Float[np.ndarray, "*batch steps"]:
    """Returns the direction of each move along a path [rad]; the one before where a move is shorter than `least_m`."""
    moves = np.diff(path, axis=-2)
    directions = np.arctan2(moves[..., 1], moves[..., 0])
    moving = np.hypot(moves[..., 0], moves[..., 1]) >= least_m
    found, before = [], now_rad
    for step in range(moves.shape[-2]):
        before = np.where(moving[..., step], directions[..., step], before)
        found.append(before)
    return np.stack(found, axis=-1)


def _gaps(
    ego: Float[np.ndarray, "*#batch points 2"],
    others: Float[np.ndarray, "*batch points 2"],
    ego_rad: Float[np.ndarray, "*#batch steps"],
    others_rad: Float[np.ndarray, "*batch steps"],
    size_m: Float[np.ndarray, "2 ..."],
    there: Bool[np.ndarray, "..."],
) -> Float[np.ndarray, "*batch steps instants"]:
    """Computes the gap of two rectangles at the instants of each step [m].

    The instant with the smallest gap has the least one of its step where agents move more than twice the smaller side
    against each other from one instant to the next.
    """
    between, (length_m, width_m) = others - ego, size_m
    start, move = between[..., :-1, :], np.diff(between, axis=-2)
    when = np.arange(1, INSTANTS + 1)[:, None] / INSTANTS
    offset = start[..., None, :] + when * move[..., None, :]
    cos, sin = np.abs(np.cos(others_rad - ego_rad)), np.abs(np.sin(others_rad - ego_rad))
    reach_along = (length_m + length_m * cos + width_m * sin) / 2
    reach_across = (width_m + length_m * sin + width_m * cos) / 2
    gap = np.full(offset.shape[:-1], -np.inf)
    for heading in (ego_rad, others_rad):
        along, across = np.cos(heading)[..., None], np.sin(heading)[..., None]
        x, y = offset[..., 0], offset[..., 1]
        gap = np.maximum(gap, np.abs(x * along + y * across) - reach_along[..., None])
        gap = np.maximum(gap, np.abs(y * along - x * across) - reach_across[..., None])
    # absent agents are left out to save time: `contacts` sets their gaps
    fast = (np.hypot(move[..., 0], move[..., 1]) > 2 * INSTANTS * np.minimum(length_m, width_m)) & there
    if fast.any():
        ego_rad = np.broadcast_to(ego_rad, fast.shape)
        reaches = (reach_along[fast], reach_across[fast])
        least = _least_gap(start[fast], move[fast], (ego_rad[fast], others_rad[fast]), reaches)
        found, rows = gap[fast], np.arange(len(least))
        nearest = found.argmin(-1)
        found[rows, nearest] = np.minimum(found[rows, nearest], least)
        gap[fast] = found
    return gap


def _least_gap(
    start: Float[np.ndarray, "some 2"],
    move: Float[np.ndarray, "some 2"],
    headings_rad: Sequence[Float[np.ndarray, " some"]],
    reaches_m: Sequence[Float[np.ndarray, " some"]],
) -> Float[np.ndarray, " some"]:
    """Computes the least gap within a step, exactly [m].

    As a function of time the gap is the largest of eight straight lines: the separation along each of four axes, in
    both directions. So it is least at an end of the step or where two of them cross.

    Args:
        start: offset of the other's centre from the ego's at the step's beginning [m].
        move: change of the offset in the step [m].
        headings_rad: direction of the ego and of the other.
        reaches_m: half of what both reach along and across a heading.
    """
    values, slopes = [], []
    for heading in headings_rad:
        cos, sin = np.cos(heading), np.sin(heading)
        for x, y, reach in ((cos, sin, reaches_m[0]), (-sin, cos, reaches_m[1])):
            value, slope = x * start[:, 0] + y * start[:, 1], x * move[:, 0] + y * move[:, 1]
            values += [value - reach, -value - reach]
            slopes += [slope, -slope]
    value, slope = np.stack(values, -1), np.stack(slopes, -1)
    one, other = np.triu_indices(value.shape[1], k=1)
    faster = slope[:, one] - slope[:, other]
    behind = value[:, other] - value[:, one]
    # parallel lines give the beginning; lines that cross before or after the step give its ends
    when = np.divide(behind, faster, out=np.zeros_like(behind), where=faster != 0).clip(0.0, 1.0)
    gaps: Float[np.ndarray, "some times"] = (value[:, None] + when[..., None] * slope[:, None]).max(-1)
    least: Float[np.ndarray, " some"] = gaps.min(-1)
    return least
