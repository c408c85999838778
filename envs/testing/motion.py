"""Checks of motion: positions change as velocities and `dt_s` say, along each axis, in plausible units."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from envs.testing.playing import Episode
from predictor.scene import SceneSpec

STEP_TOLERANCE = 0.15
"""Largest relative difference between `dt_s` and the step that motion shows."""
FIT = 0.3
"""Largest median error of positions, as a share of the distance moved, where velocities are said to fit."""
LEAST_PAIRS = 8
LASTING = 0.2
"""Least share of the others' ids that are there after a step, too; where agents are re-identified, some are lost."""
SMALL = 1e-3
"""Distance of a step, in scales of positions, that is not told from standing still."""
HINTS = {
    1 / 3.6: "velocities in km/h", 1 / 2.237: "velocities in mph", 100.0: "positions in cm", 1000.0: "positions in mm",
    0.01: "velocities in cm/s", 0.3048: "velocities in feet/s", 3.281: "positions in feet",
}  # fmt: skip
"""Ratio of motion to velocity × dt_s → the units that give it."""


@dataclass(frozen=True)
class Steps:
    """Steps of agents that were there before and after."""

    moved: Float[np.ndarray, "steps axes"]
    """Change of position."""
    before: Float[np.ndarray, "steps axes"]
    """Velocity before the step."""
    after: Float[np.ndarray, "steps axes"]
    """Velocity after the step."""
    is_ego: Float[np.ndarray, " steps"]
    """1 for steps of the agent at index 0."""

    @classmethod
    def of(cls, episodes: Sequence[Episode], axes: int) -> "Steps":
        """Collects the steps of all agents."""
        lines = []
        for first, second in (pair for episode in episodes for pair in episode.pairs()):
            rows = second.index_of
            for row, number in enumerate(first.ids.tolist()):
                if number in rows:
                    old, new = first.states[row], second.states[rows[number]]
                    moved = new[:axes] - old[:axes]
                    lines.append([*moved, *old[axes : 2 * axes], *new[axes : 2 * axes], float(row == 0)])
        table = np.array(lines, dtype=np.float64).reshape(-1, 3 * axes + 1)
        return cls(table[:, :axes], table[:, axes : 2 * axes], table[:, 2 * axes : 3 * axes], table[:, -1])

    def fast(self) -> "Steps":
        """Returns the steps of agents that move; those that stand say nothing of dt_s."""
        speed = np.linalg.norm(self.before + self.after, axis=1)
        length = np.linalg.norm(self.moved, axis=1)
        keep = (speed > 0.1 * np.quantile(speed, 0.9)) | (length > 0.1 * np.quantile(length, 0.9))
        return self.part(keep)

    def part(self, keep: Bool[np.ndarray, " steps"]) -> "Steps":
        """Returns some of the steps."""
        return Steps(self.moved[keep], self.before[keep], self.after[keep], self.is_ego[keep])

    def velocity(self) -> Float[np.ndarray, "steps axes"]:
        """Returns the velocity that fits the motion best: that before the step, after it, or their mean."""
        return min((self.before, self.after, (self.before + self.after) / 2), key=lambda v: misfit(self.moved, v))


def misfit(moved: Float[np.ndarray, "steps axes"], velocity: Float[np.ndarray, "steps axes"]) -> float:
    """Returns the median error of velocity × the best step length, as a share of the distance moved."""
    error = np.linalg.norm(moved - velocity * step_length(moved, velocity), axis=1)
    return float(np.median(error) / max(np.median(np.linalg.norm(moved, axis=1)), 1e-12))


def step_length(moved: Float[np.ndarray, "steps axes"], velocity: Float[np.ndarray, "steps axes"]) -> float:
    """Returns the step length [s] that motion shows: the median over steps, so that a few jumps change nothing."""
    squared = np.square(velocity).sum(axis=1)
    along = (moved * velocity).sum(axis=1)
    return float(np.median(along[squared > 0] / squared[squared > 0])) if (squared > 0).any() else 0.0


def motion_problems(episodes: Sequence[Episode], spec: SceneSpec) -> list[str]:
    """Returns what is wrong with positions against velocities, the most telling thing alone."""
    steps = Steps.of(episodes, spec.position_dim)
    if not len(steps.moved):
        return ["no agent is there in two scenes that follow each other: ids must stay with an agent"]
    share = lasting_share(episodes, spec)
    if share is not None and share < LASTING:
        return [
            f"{share:.0%} of the others' ids are there after a step, too; an id must stay with its agent: give the "
            "simulator's numbers, or raise gate_m where agents are re-identified (EntityRowsReader, IdentityTracker)"
        ]
    if not np.abs(steps.moved).max() > 0:
        return ["no position ever changes while the environment steps; does the reader return an old scene?"]
    whole, steps = steps, steps.fast()
    if not np.abs(steps.before).max(initial=0) > 0:
        return ["all velocities are zero, although positions change; give velocities in m/s"]
    if len(steps.moved) < LEAST_PAIRS:
        return []
    if spec.has_ego and (found := _relative(steps)):
        return [found]
    return _axes(steps, spec) or _step(steps, spec) or _parts(whole, spec) or _ghosts(episodes, spec)


def _parts(steps: Steps, spec: SceneSpec) -> list[str]:
    """Finds what is wrong with the ego alone or with the others alone, which a median over all agents hides."""
    if not spec.has_ego:
        return []
    ego = steps.part(steps.is_ego > 0)
    moves = np.linalg.norm(ego.moved, axis=1) > SMALL * min(spec.feature_scales[: spec.position_dim])
    if moves.sum() >= LEAST_PAIRS and not ego.before.any() and not ego.after.any():
        return ["the ego moves, but its velocity is always zero; give it in m/s, as that of the others"]
    for whose, part in (("the ego's ", ego), ("the others' ", steps.part(steps.is_ego == 0))):
        fast = part.fast() if len(part.moved) else part
        if len(fast.moved) >= LEAST_PAIRS and (found := _step(fast, spec, tolerance=1.0, whose=whose)):
            return found
    return []


def _ghosts(episodes: Sequence[Episode], spec: SceneSpec) -> list[str]:
    """Finds an agent that never moves, although it has a velocity in each step."""
    axes, least_m = spec.position_dim, SMALL * min(spec.feature_scales[: spec.position_dim])
    for episode in episodes:
        states: dict[int, list[Float[np.ndarray, " state"]]] = {}
        for moment in episode.moments:
            first = int(spec.has_ego)
            for number, state in zip(moment.ids[first:].tolist(), moment.states[first:], strict=True):
                states.setdefault(number, []).append(state)
        for number, found in states.items():
            path = np.array(found)
            speed = np.linalg.norm(path[:, axes : 2 * axes], axis=1)
            if (
                len(path) > LEAST_PAIRS
                and (path[:, :axes] == path[0, :axes]).all()
                and speed.min() * spec.dt_s > least_m
            ):
                return [
                    f"id {number} never moves, although it has a velocity ({speed[0]:.3g} m/s): what stands has "
                    "velocity zero, and what is not there is left out"
                ]
    return []


def lasting_share(episodes: Sequence[Episode], spec: SceneSpec) -> float | None:
    """Returns the share of the others' ids that are there after a step, too; None of too few steps to say.

    Others are all agents but the ego. As many as the smaller scene has could have stayed.
    """
    first = int(spec.has_ego)
    stayed = could = 0
    for one, other in (pair for episode in episodes for pair in episode.pairs()):
        stayed += len(set(one.ids[first:].tolist()) & set(other.ids[first:].tolist()))
        could += max(min(len(one.ids), len(other.ids)) - first, 0)
    return stayed / could if could >= LEAST_PAIRS else None


def _relative(steps: Steps) -> str:
    ego = steps.is_ego > 0
    stands = ego.any() and np.abs(steps.moved[ego]).max() == 0
    if stands and np.abs(steps.before[ego]).max() > 0 and np.abs(steps.moved[~ego]).max(initial=0) > 0:
        return (
            "the ego never changes its position, although it has a velocity: positions must be in the world frame, not "
            "relative to the ego"
        )
    return ""


def _axes(steps: Steps, spec: SceneSpec) -> list[str]:
    """Finds axes that are mirrored or swapped between positions and velocities."""
    moved, velocity, axes = steps.moved, steps.velocity(), spec.position_dim
    for one in range(axes):
        for other in range(one + 1, axes):
            order = list(range(axes))
            order[one], order[other] = other, one
            swapped = [v[:, order] for v in (steps.before, steps.after)]
            if misfit(moved, velocity) > FIT and min(misfit(moved, v) for v in swapped) < FIT / 3:
                return [
                    f"velocities along {'xyz'[one]} and {'xyz'[other]} are swapped: they fit the other axis's motion"
                ]
    for axis, letter in enumerate("xyz"[:axes]):
        clear = np.abs(moved[:, axis]) > 0.2 * np.quantile(np.abs(moved[:, axis]), 0.9)
        against = moved[clear, axis] * velocity[clear, axis] < 0
        if clear.sum() >= LEAST_PAIRS and against.mean() > 0.8:
            return [f"positions along {letter} change against their velocity: one of the two is mirrored"]
    return []


def _step(steps: Steps, spec: SceneSpec, tolerance: float = STEP_TOLERANCE, whose: str = "") -> list[str]:
    moved, velocity = steps.moved, steps.velocity()
    share, found_s = misfit(moved, velocity), step_length(moved, velocity)
    if share > FIT:
        return []
    ratio = found_s / spec.dt_s
    if 1 / (1 + tolerance) <= ratio <= 1 + tolerance:
        return []
    hint = next((f" ({text}?)" for known, text in HINTS.items() if abs(ratio / known - 1) < 0.05), "")
    return [
        f"{whose}positions change by {ratio:.3g} × velocity × dt_s: either a step lasts {found_s:.3g} s, not dt_s="
        f"{spec.dt_s:g}, or positions and velocities are in different units{hint}"
    ]


def misfit_problems(episodes: Sequence[Episode], spec: SceneSpec) -> list[str]:
    """Returns whether positions change in a way that no step length explains; of use where nothing else was found."""
    steps = Steps.of(episodes, spec.position_dim).fast()
    share = misfit(steps.moved, steps.velocity()) if len(steps.moved) >= LEAST_PAIRS else 0.0
    if share <= FIT:
        return []
    return [
        f"positions do not change as velocities say: half of the steps miss by more than {share:.0%} of the way; are "
        "velocities those of the same step, and do ids stay with their agents?"
    ]


def scale_problems(episodes: Sequence[Episode], spec: SceneSpec) -> list[str]:
    """Returns whether numbers are of another order than `feature_scales` say, which a network sees as noise or zero."""
    moments = [moment for episode in episodes for moment in episode.moments]
    axes, problems = spec.position_dim, []
    offsets = np.concatenate([m.states[:, :axes] - m.states[:1, :axes] for m in moments])
    speeds = np.concatenate([m.states[:, axes : 2 * axes] for m in moments])
    for what, unit, values, scales in (
        ("distances between agents", "m", offsets, spec.feature_scales[:axes]),
        ("velocities", "m/s", speeds, spec.feature_scales[axes : 2 * axes]),
    ):
        size = np.abs(values).max(axis=1)
        size = size[size > 0]
        if not len(size):
            continue
        typical, scale = float(np.median(size)), max(scales)
        if not 0.01 < typical / scale < 20:
            problems.append(
                f"{what} are about {typical:.3g} {unit}, but feature_scales say {scale:g}: give SI units, and "
                "feature_scales near the spread of your data"
            )
    return problems


def heading_problems(episodes: Sequence[Episode]) -> list[str]:
    """Returns whether `heading_rad` turns another way than the ego moves."""
    moments = [moment for episode in episodes for moment in episode.moments if len(moment.states)]
    heading = np.array([moment.heading_rad for moment in moments])
    velocity = np.array([moment.states[0, 2:4] for moment in moments])
    if _in_body_frame(episodes):
        return [
            "the ego moves along its velocity turned by heading_rad: velocities are in the frame of each agent; turn "
            "them into the world frame"
        ]
    speed = np.linalg.norm(velocity, axis=1)
    keep = speed > 0.2 * max(np.quantile(speed, 0.9), 1e-9)
    if not heading.any() or keep.sum() < LEAST_PAIRS:
        return []
    course, heading = np.arctan2(velocity[keep, 1], velocity[keep, 0]), heading[keep]
    if _apart(heading, course) < 0.3:
        return []
    meant = {
        "heading_rad is in degrees; give radians": np.deg2rad(heading)
        if np.abs(heading).max() > 2 * np.pi
        else heading,
        "heading_rad is mirrored: it must grow from x to y": -heading,
        "heading_rad is counted from the y axis; it is 0 along x and grows towards y": np.pi / 2 - heading,
    }
    return [text for text, angle in meant.items() if _apart(angle, course) < 0.15][:1]


def _in_body_frame(episodes: Sequence[Episode]) -> bool:
    """Returns whether the ego moves along its velocity turned by its heading, and not along its velocity."""
    found = []
    for first, second in (pair for episode in episodes for pair in episode.pairs()):
        if len(first.ids) and len(second.ids) and first.ids[0] == second.ids[0]:
            found.append([*(second.states[0, :2] - first.states[0, :2]), *first.states[0, 2:4], first.heading_rad])
    table = np.array(found).reshape(-1, 5)
    length = np.linalg.norm(table[:, :2], axis=1)
    table = table[length > 0.2 * max(np.quantile(length, 0.9) if len(length) else 0.0, 1e-9)]
    if len(table) < LEAST_PAIRS:
        return False
    moved, course = np.arctan2(table[:, 1], table[:, 0]), np.arctan2(table[:, 3], table[:, 2])
    return _apart(course, moved) > 0.5 and _apart(course + table[:, 4], moved) < 0.3


def _apart(one: Float[np.ndarray, " moments"], other: Float[np.ndarray, " moments"]) -> float:
    return float(np.quantile(np.abs(np.angle(np.exp(1j * (one - other)))), 0.8))
