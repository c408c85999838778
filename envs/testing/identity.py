"""Checks of identity: an id stays with its agent, moves as its agent does, and never goes to another one."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from envs.testing.motion import Steps, step_length
from envs.testing.playing import Episode, Moment
from predictor.scene import SceneSpec

FAR = 10.0
"""Error of a predicted position, in typical errors, from which an agent is said to be elsewhere than it should."""

FEWEST, COMMON = 3, 1e-3
"""Number of ids that seem to change hands, and their share of all ids at all steps, from which it is no coincidence: an
agent that stops just where another one starts. One that is farther off than a fast agent moves in a step never is."""

NEAR = 1e-3
"""Distance, in scales of positions, that is not told from standing still: parked cars sink into their springs."""


@dataclass(frozen=True)
class _Rule:
    """How far from where its velocity leads an agent may be after a step."""

    step_s: float
    """Length of a step that motion shows."""
    typical_m: float
    """Median error of constant velocity."""
    reach_m: float
    """Distance that a fast agent moves in a step."""
    axes: int
    floor_m: float = 0.0
    """Distance that is none at the scale of the scene."""

    @classmethod
    def of(cls, episodes: Sequence[Episode], spec: SceneSpec) -> "_Rule":
        steps, floor_m = Steps.of(episodes, spec.position_dim), NEAR * min(spec.feature_scales[: spec.position_dim])
        if not len(steps.moved):
            return cls(spec.dt_s, 0.0, 0.0, spec.position_dim, floor_m)
        moving = steps.fast()
        length = step_length(moving.moved, moving.velocity()) if len(moving.moved) else spec.dt_s
        error = np.linalg.norm(steps.moved - steps.before * length, axis=1)
        reach = np.quantile(np.linalg.norm(steps.before, axis=1), 0.9) * abs(length)
        return cls(length, float(np.median(error)), float(reach), spec.position_dim, floor_m)

    def led_to(self, state: Float[np.ndarray, " state"], steps: int = 1) -> Float[np.ndarray, " axes"]:
        return state[: self.axes] + state[self.axes : 2 * self.axes] * self.step_s * steps

    def error(self, old: Float[np.ndarray, " state"], new: Float[np.ndarray, " state"], steps: int = 1) -> float:
        return float(np.linalg.norm(new[: self.axes] - self.led_to(old, steps)))

    @property
    def handed_m(self) -> float:
        """Least error of an id that is said to have another agent now."""
        return max(FAR * self.typical_m + 0.05 * self.reach_m, self.floor_m)

    @property
    def jump_m(self) -> float:
        """Least error of an agent that is said to have jumped: further than by braking and turning at once."""
        return max(FAR * self.typical_m + 3 * self.reach_m, self.floor_m)


def identity_problems(episodes: Sequence[Episode], spec: SceneSpec) -> list[str]:
    """Returns what is wrong with the ids, one line for each kind of mistake."""
    rule = _Rule.of(episodes, spec)
    problems: list[str] = []
    handed = [found for episode in episodes for found in _handed(episode, rule)]
    ids = sum(len(moment.ids) for episode in episodes for moment in episode.moments)
    if len(handed) >= max(FEWEST, COMMON * ids) or any(error > rule.reach_m for error, _ in handed):
        problems += [handed[0][1]]
    for check in (_jumped, _returned):
        lines = [line for episode in episodes if (line := next(check(episode, rule), ""))]
        problems += lines[:1]
    if spec.has_ego:
        problems += _ego_keeps_its_id(episodes)
    if problems and _row_numbers(episodes):
        problems[0] += "; the ids are the row numbers 0, 1, 2, … of every scene, but rows change hands"
    return problems


def _row_numbers(episodes: Sequence[Episode]) -> bool:
    moments = [moment for episode in episodes for moment in episode.moments]
    return all(np.array_equal(moment.ids, np.arange(len(moment.ids))) for moment in moments)


def _handed(episode: Episode, rule: _Rule) -> Iterator[tuple[float, str]]:
    """Finds ids that are, after a step, where another id's agent should be, while that one's id is elsewhere.

    Yields how far off its course an id is, and the line that says so.
    """
    for number, (first, second) in enumerate(episode.pairs()):
        rows = second.index_of
        for row, agent in enumerate(first.ids.tolist()):
            if agent not in rows:
                continue
            new = second.states[rows[agent]]
            error = rule.error(first.states[row], new)
            if error <= rule.handed_m:
                continue
            other = _better(first, second, row, new, error, rule)
            if other is not None:
                yield (
                    error,
                    f"ids change hands: in step {number + 1} id {agent} is {error:.3g} m off its course, "
                    f"there where id {other} should be; an id must stay with its agent",
                )


def _better(
    first: Moment, second: Moment, row: int, new: Float[np.ndarray, " state"], error: float, rule: _Rule
) -> int | None:
    """Returns the id whose agent should be there and as fast, if it is not there itself.

    An agent that ran into a slower one is where that one should be, too, and pushed it away; it is faster, or the other
    one is not far off its own course.
    """
    rows = second.index_of
    for other, number in enumerate(first.ids.tolist()):
        if other == row or rule.error(first.states[other], new) > max(0.1 * error, 2 * rule.typical_m):
            continue
        least = max(rule.handed_m, 0.75 * error)
        elsewhere = number not in rows or rule.error(first.states[other], second.states[rows[number]]) > least
        axes = slice(rule.axes, 2 * rule.axes)
        changes = [float(np.linalg.norm(new[axes] - first.states[each][axes])) for each in (other, row)]
        if elsewhere and changes[0] <= max(0.5 * changes[1], 2 * rule.typical_m / abs(rule.step_s)):
            return number
    return None


def _jumped(episode: Episode, rule: _Rule) -> Iterator[str]:
    for number, (first, second) in enumerate(episode.pairs()):
        rows = second.index_of
        for row, agent in enumerate(first.ids.tolist()):
            if agent in rows:
                old, new = first.states[row], second.states[rows[agent]]
                error = rule.error(old, new)
                if error > rule.jump_m and _better(first, second, row, new, error, rule) is None:
                    yield (
                        f"an id jumps: in step {number + 1} id {agent} is {error:.3g} m from where its velocity leads; "
                        "an agent that appears elsewhere needs a new id"
                    )


def _returned(episode: Episode, rule: _Rule) -> Iterator[str]:
    """Finds an id that was gone and comes back elsewhere than its motion would have led."""
    last: dict[int, tuple[int, Float[np.ndarray, " state"]]] = {}
    for time, moment in enumerate(episode.moments):
        for row, agent in enumerate(moment.ids.tolist()):
            seen, state = last.get(agent, (time, moment.states[row]))
            gap = time - seen
            error = rule.error(state, moment.states[row], gap) if gap > 1 else 0.0
            if error > rule.jump_m + 0.5 * rule.reach_m * gap:
                yield (
                    f"an id returns: id {agent} was gone after step {seen} and came back in step {time}, {error:.3g} m "
                    "from where its motion led; a new agent needs a new id, and so does one that comes back elsewhere"
                )
            last[agent] = (time, moment.states[row])


def _ego_keeps_its_id(episodes: Sequence[Episode]) -> list[str]:
    for episode in episodes:
        first = [int(moment.ids[0]) for moment in episode.moments]
        changed = next((time for time, number in enumerate(first) if number != first[0]), None)
        if changed is not None:
            return [
                f"the first agent has id {first[0]} and, from step {changed} on, id {first[changed]}: the ego must be "
                "the first agent of every scene, with one id"
            ]
    return []
