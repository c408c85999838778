"""Findings in recorded episodes: what scenes alone show, and what the environment's own observations show.

`recorded_problems` needs ids and states at each step, nothing else. So the same findings come of episodes that
`check_reader` plays and of those that `envs.collect` has recorded (`store_problems`).
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from envs.testing.identity import identity_problems
from envs.testing.motion import heading_problems, misfit_problems, motion_problems, scale_problems
from envs.testing.playing import Episode, Moment, frozen
from predictor.data import store
from predictor.scene import SceneSpec

MOST_STATES = 100_000
"""Largest number of agents' states of a recording that is looked at: about a second."""
LEAST_STEPS = 3
"""Least number of steps of an episode in which an observation that never changes is strange."""


def recorded_problems(episodes: Sequence[Episode], spec: SceneSpec) -> list[str]:
    """Returns what is wrong with recorded scenes, one line for each thing; empty if nothing was found.

    Args:
        episodes: ids, states and, where there is one, the ego's heading at each step.
        spec: what the reader says of them.
    """
    problems = _not_finite(episodes)
    if problems:  # what the next ones would find may follow from it
        return problems
    problems = motion_problems(episodes, spec)
    if not problems:
        heading = heading_problems(episodes) if spec.has_ego else []
        problems = (heading + identity_problems(episodes, spec)) or misfit_problems(episodes, spec)
    return problems + scale_problems(episodes, spec)


def store_problems(episodes: Sequence[store.Episode], spec: SceneSpec) -> list[str]:
    """Returns what is wrong with recorded episodes of a store, as `recorded_problems` does; of long ones, a part."""
    found: list[Episode] = []
    states = 0
    for episode in episodes:
        if states >= MOST_STATES:
            break
        states += int(episode.valid.sum())
        found.append(_moments_of(episode))
    return recorded_problems(found, spec) if found else []


def _moments_of(episode: store.Episode) -> Episode:
    pairs = zip(episode.states, episode.valid, strict=True)
    return Episode([Moment(states[there].astype(np.float64), episode.ids[there], 0.0) for states, there in pairs])


def _not_finite(episodes: Sequence[Episode]) -> list[str]:
    for number, episode in enumerate(episodes):
        for time, moment in enumerate(episode.moments):
            wrong = ~np.isfinite(moment.states).all(axis=1)
            if wrong.any():
                return [
                    f"states are not finite: id {moment.ids[wrong][0]} in step {time} of episode {number} has "
                    f"{moment.states[wrong][0].tolist()}; leave an agent out while its state is unknown"
                ]
    return []


def observation_problems(episodes: Sequence[Episode]) -> list[str]:
    """Returns what is wrong with the environment's own observations and rewards, which a policy learns from."""
    for what in ("shown", "rewards"):
        for episode in episodes:
            for time, seen in enumerate(getattr(episode, what), start=int(what == "rewards")):
                whose = next(_not_finite_in(seen), None)
                if whose is not None:
                    kind = "observation" if what == "shown" else "reward"
                    return [
                        f"the environment's own {kind}{whose} is not finite in step {time}: no policy learns from it"
                    ]
    return _constant(episodes)


def _not_finite_in(seen: Any, name: str = "") -> Iterator[str]:
    """Yields where numbers that are not finite are, such as " of 'agent_0'"."""
    if isinstance(seen, Mapping):
        for key, value in seen.items():
            yield from _not_finite_in(value, f"{name} of '{key}'" if key else name)
    elif isinstance(seen, tuple | list):
        for value in seen:
            yield from _not_finite_in(value, name)
    else:
        array = np.asarray(seen)
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            yield name


def _constant(episodes: Sequence[Episode]) -> list[str]:
    """Finds an agent whose observation is the same at each step of every episode, while something moves."""
    moving = [e for e in episodes if len(e.shown) > LEAST_STEPS and _moves(e)]
    for agent in {name: None for episode in moving for name in episode.shown[0]}:
        seen = [[frozen(shown[agent]) for shown in episode.shown if agent in shown] for episode in moving]
        seen = [values for values in seen if len(values) > LEAST_STEPS]
        if seen and all(value == values[0] for values in seen for value in values):
            whose = f" of '{agent}'" if agent else ""
            return [
                f"the environment's own observation{whose} never changes within an episode, although agents move; is "
                "it an old array, or one that the environment forgets to fill?"
            ]
    return []


def _moves(episode: Episode) -> bool:
    return any(
        first.states.shape != second.states.shape or not np.array_equal(first.states, second.states)
        for first, second in episode.pairs()
    )
