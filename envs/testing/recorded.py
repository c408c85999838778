"""Findings in recorded episodes: what scenes alone show, and what the environment's own observations show.

`recorded_problems` needs ids and states at each step, nothing else. So the same findings come of episodes that
`check_reader` plays and of those that `envs.collect` has recorded (`store_problems`).
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from envs.own_observation import as_numbers
from envs.testing.identity import identity_problems
from envs.testing.motion import heading_problems, misfit_problems, motion_problems, scale_problems
from envs.testing.playing import Episode, Moment, frozen
from predictor.data import store
from predictor.scene import SceneSpec
from predictor.scene_checks import check_resolution
from predictor.support.errors import UserError, short

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
    problems = _rounded(episodes, spec)
    if problems:
        return problems
    problems = motion_problems(episodes, spec)
    if not problems:
        heading = heading_problems(episodes) if spec.has_ego else []
        problems = (heading + identity_problems(episodes, spec)) or misfit_problems(episodes, spec)
    return problems + (scale_problems(episodes, spec) or _unseen(episodes, spec))


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


def _rounded(episodes: Sequence[Episode], spec: SceneSpec) -> list[str]:
    """Finds positions so far from zero that recordings, which are float32, do not keep them well enough."""
    states = [moment.states for episode in episodes for moment in episode.moments]
    try:
        check_resolution(np.concatenate(states), spec, "recordings of states")
    except UserError as error:
        return [str(error)]
    return []


def _unseen(episodes: Sequence[Episode], spec: SceneSpec) -> list[str]:
    """Finds environments in which the ego never sees anybody, though others are there."""
    if not spec.has_ego:
        return []
    axes = spec.position_dim
    apart_m = [
        np.linalg.norm(m.states[1:, :axes] - m.states[:1, :axes], axis=-1).min()
        for episode in episodes
        for m in episode.moments
        if len(m.states) > 1
    ]
    if not apart_m or min(apart_m) <= spec.perception_m:
        return []
    return [
        f"no other agent is ever within perception_m={spec.perception_m:g} m of the ego, the nearest is "
        f"{min(apart_m):.0f} m away: it sees nobody; raise perception_m"
    ]


def observation_problems(episodes: Sequence[Episode], spaces: Mapping[str, Any]) -> list[str]:
    """Returns what is wrong with the environment's own observations and rewards, which a policy learns from.

    Args:
        episodes: what was shown and rewarded.
        spaces: space of each agent's observations, by its name; of an ego, whose name is empty.
    """
    for what in ("shown", "rewards"):
        for episode in episodes:
            for time, seen in enumerate(getattr(episode, what), start=int(what == "rewards")):
                whose = next(_not_finite_in(seen), None)
                if whose is not None:
                    kind = "observation" if what == "shown" else "reward"
                    return [
                        f"the environment's own {kind}{whose} is not finite in step {time}: no policy learns from it"
                    ]
    return _no_numbers(episodes) or _outside(episodes, spaces) or _constant(episodes)


def _no_numbers(episodes: Sequence[Episode]) -> list[str]:
    """Finds a reward that is no number."""
    for time, agent, reward in (
        (time, agent, reward)
        for episode in episodes
        for time, rewards in enumerate(episode.rewards, start=1)
        for agent, reward in rewards.items()
    ):
        found = as_numbers(reward)
        if found is None or np.ndim(reward):
            whose = f" of '{agent}'" if agent != "" else ""
            return [
                f"the environment's own reward{whose} must be one number, got {short(repr(reward), 60)} in step {time}"
            ]
    return []


def _outside(episodes: Sequence[Episode], spaces: Mapping[str, Any]) -> list[str]:
    """Finds an observation that is not in its space; another type of number is no mistake if it can be converted."""
    for episode in episodes:
        for time, shown in enumerate(episode.shown):
            for agent, seen in shown.items():
                why = _misfit(seen, spaces[agent]) if agent in spaces else f" has no space, named are {list(spaces)}"
                if why:
                    whose = f" of '{agent}'" if agent != "" else ""
                    return [
                        f"the environment's own observation{whose}{why}, in step {time}: its observation_space must "
                        "hold all that it shows"
                    ]
    return []


def _misfit(seen: Any, space: Any) -> str:
    """Returns what is wrong with a value of a space; empty if nothing is, or it is not known."""
    if isinstance(space, gym.spaces.Dict):
        if not isinstance(seen, Mapping) or seen.keys() != space.spaces.keys():
            got = list(seen) if isinstance(seen, Mapping) else type(seen).__name__
            return f" must be a dict with {list(space.spaces)}, got {got}"
        return next((f"['{key}']{why}" for key, value in seen.items() if (why := _misfit(value, space[key]))), "")
    if isinstance(space, gym.spaces.Box):
        if as_numbers(seen) is None:
            return f" is a {type(seen).__name__} and no array of numbers, its space {short(space, 60)}"
        if np.shape(seen) != space.shape:
            return f" has the shape {np.shape(seen)}, its space {space.shape}"
        if np.issubdtype(space.dtype, np.integer) and np.asarray(seen).dtype.kind == "f":
            return f" has numbers of type {np.asarray(seen).dtype}, its space {space.dtype}, which would cut them"
        values, low, high = (np.asarray(part, dtype=np.float64) for part in (seen, space.low, space.high))
        slack = 1e-5 * (1 + np.abs(values))
        out = (values < low - slack) | (values > high + slack)
        if out.any():
            where = tuple(int(i) for i in np.argwhere(out)[0])
            return f" has {values[where]:.4g} at {list(where)}, its space is from {low[where]:.4g} to {high[where]:.4g}"
        return ""
    if isinstance(space, gym.spaces.Discrete | gym.spaces.MultiDiscrete | gym.spaces.MultiBinary):
        inside = space.contains(seen) or space.contains(np.asarray(seen))
        inside = inside or (np.size(seen) == 1 and space.contains(np.asarray(seen).item()))
        return "" if inside else f" is {short(repr(seen), 60)}, its space {space}"
    return ""


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
