"""Checks of the names in a PettingZoo environment: each agent that lives is named, and its name stays with it.

A view is cut for the agent that the reader names. A name that is missing gives a view of zeros, and one at another
agent that agent's view; neither raises an error.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from envs.testing.ego import ALIKE, SEEDS, ends_of, extreme_actions, spread
from envs.testing.playing import Episode, OpenReader, begin
from predictor.support.errors import short

MOST_AGENTS = 8
"""Number of agents whose actions are tried, at most."""


def name_problems(episodes: Sequence[Episode]) -> list[str]:
    """Returns a line for an agent that is observed and not named, named and gone, or whose name goes to another id."""
    checks = (_missing, _gone, _unseen, _moved)
    return next((found for check in checks for episode in episodes if (found := check(episode))), [])


def _missing(episode: Episode) -> list[str]:
    for time, (moment, living) in enumerate(zip(episode.moments, episode.living, strict=True)):
        lacks = [agent for agent in living if agent not in moment.named]
        if lacks:
            when = "after the reset" if time == 0 else f"in step {time}"
            return [
                f"index_of must have the index of each agent that lives, but lacks {short(lacks, 100)} {when}; its "
                f"names are {short([*moment.named], 100)}; the view of an agent without one would be zeros"
            ]
    return []


def _gone(episode: Episode) -> list[str]:
    """Finds an agent that has ended before and is still named, or ends now and no longer is."""
    for time, (moment, shown, before) in enumerate(
        zip(episode.moments[1:], episode.shown[1:], episode.living, strict=False), start=1
    ):
        last = [agent for agent in before if agent in shown and agent not in moment.named]
        if last:
            return [
                f"index_of must have each agent that is observed, but lacks {short(last, 90)} in step {time}, its last "
                "one: that observation would be zeros; env.agents no longer has who ends"
            ]
        ended = [agent for agent in moment.named if agent not in shown and agent not in episode.living[time]]
        if ended:
            return [
                f"index_of names {short(ended, 90)} in step {time}, which neither lives nor is observed: leave out who "
                "has gone, in index_of and in the scene"
            ]
    return []


def _unseen(episode: Episode) -> list[str]:
    """Finds an agent that lives and gets no observation, or that acted and gets no reward."""
    for time, living in enumerate(episode.living):
        lacks = [agent for agent in living if agent not in episode.shown[time]]
        if lacks:
            return [f"the environment gives no observation for {short(lacks, 100)}, alive in step {time}; give one"]
        if time:
            lacks = [agent for agent in episode.living[time - 1] if agent not in episode.rewards[time - 1]]
        if lacks:
            return [f"the environment gives no reward for {short(lacks, 100)}, who acted in step {time}; give one"]
    return []


def _moved(episode: Episode) -> list[str]:
    for time, ((first, second), before) in enumerate(zip(episode.pairs(), episode.living, strict=False), start=1):
        for agent in before:
            if agent in first.named and agent in second.named and first.named[agent] != second.named[agent]:
                return [
                    f"agent '{agent}' lives on in step {time}, but its id changes from {first.named[agent]} to "
                    f"{second.named[agent]}; an id must stay with its agent"
                ]
    return []


def obedience_problems(env: Any, opened: OpenReader, seed: int) -> list[str]:
    """Returns a line for an agent whose actions another one obeys; nothing where seeds do not determine an episode."""
    begin(env, opened, seed)
    agents = list(env.agents)[:MOST_AGENTS]
    for agent in agents:
        line = _obeyed_by_another(env, opened, seed, agent)
        if line:
            return [line]
    return []


def _obeyed_by_another(env: Any, opened: OpenReader, seed: int, agent: str) -> str:
    """Returns who obeys the actions of an agent, if it is always the same other one and not the agent itself."""
    others = {name: extreme_actions(env.action_space(name))[0] for name in env.possible_agents}
    acts = [partial(_with, others, agent, action) for action in extreme_actions(env.action_space(agent))]
    votes: list[str] = []
    own = strongest = 0.0
    for number in range(SEEDS):
        begin(env, opened, seed + number)
        first = opened.read(env)
        names, row = {key: name for name, key in first.named.items()}, first.index_of.get(first.named.get(agent, -1))
        ends = ends_of(env, opened, seed + number, acts)
        effect = spread(ends[0], opened.spec) if ends else np.zeros(1)
        if row is None or effect.max() <= ALIKE:
            continue
        obeys = int(effect.argmax())
        key = int(first.ids[obeys])
        votes.append("" if obeys == row else f"'{names[key]}'" if key in names else f"id {key}")
        own, strongest = max(own, effect[row] if row < len(effect) else 0.0), max(strongest, effect.max())
    if len(votes) < 2 or len(set(votes)) > 1 or not votes[0] or own > 0.5 * strongest:
        return ""
    return (
        f"the actions of '{agent}' move what index_of calls {votes[0]}, and not '{agent}': each name must have the "
        "index of its own agent"
    )


def _with(others: Mapping[str, Any], agent: str, action: Any, env: Any) -> dict[str, Any]:
    return {name: action if name == agent else others[name] for name in env.agents}
