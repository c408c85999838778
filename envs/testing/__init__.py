"""Checks a reader of one's own: `check_reader(env, reader)` raises one line for each thing that is wrong.

It plays random episodes and looks at what no type shows: steps of another length, other units, mirrored or swapped
axes, ids that are row numbers, change hands or come back, an ego that is not the first agent, reading that changes the
environment, observations that never change. None of these raises an error by itself: a wrong id only makes forecasts
worse, since memory follows ids. `recorded_problems` is the part that needs scenes alone.
"""

from dataclasses import dataclass
from typing import Any

from envs.readers.base import MakeReader
from envs.testing.asking import ReaderProblem, check_reset
from envs.testing.ego import ego_problems, replay_problems
from envs.testing.motion import lasting_share
from envs.testing.names import name_problems, obedience_problems
from envs.testing.playing import open_reader, play, shown_spaces, space_problems
from envs.testing.recorded import observation_problems, recorded_problems, store_problems
from predictor.support.config_checks import is_whole
from predictor.support.errors import UserError, short

__all__ = ["Examined", "check_reader", "examine_reader", "reader_problems", "recorded_problems", "store_problems"]


def check_reader(
    env: Any, reader: MakeReader | None = None, *, episodes: int = 5, max_steps: int = 100, seed: int = 0
) -> None:
    """Plays random episodes of an environment and checks what its reader reports.

        >>> from envs import make_env
        >>> check_reader(make_env("highway-fast-v0"), episodes=2)

    Args:
        env: a Gymnasium environment with one ego, or a PettingZoo parallel environment, without our wrappers.
        reader: function or class that makes a reader for the env; None takes the one that is registered or built in.
        episodes: number of episodes; what never happens in them cannot be found.
        max_steps: largest number of steps of an episode.
        seed: seed of the first episode and of the random actions.

    Raises:
        UserError: no reader knows the env, or something is wrong; one line for each thing.
    """
    problems = reader_problems(env, reader, episodes=episodes, max_steps=max_steps, seed=seed)
    if problems:
        raise UserError("\n".join(problems))


def reader_problems(
    env: Any, reader: MakeReader | None = None, *, episodes: int = 5, max_steps: int = 100, seed: int = 0
) -> list[str]:
    """Returns what is wrong with a reader, one line for each thing; empty if nothing was found.

    The arguments are those of `check_reader`.

    Raises:
        UserError: no reader knows the env.
    """
    return examine_reader(env, reader, episodes=episodes, max_steps=max_steps, seed=seed).problems


@dataclass(frozen=True)
class Examined:
    """What was found in episodes with a reader."""

    problems: list[str]
    """One line for each thing that is wrong."""
    lasting: float | None = None
    """Share of the others' ids that are there after a step, too; None of too few steps to say."""


def examine_reader(
    env: Any, reader: MakeReader | None = None, *, episodes: int = 5, max_steps: int = 100, seed: int = 0
) -> Examined:
    """Returns what `reader_problems` does, and how many ids last from step to step.

    The arguments are those of `check_reader`.

    Raises:
        UserError: no reader knows the env, or there is not one episode of a step.
    """
    for name, number in (("episodes", episodes), ("max_steps", max_steps)):
        if not is_whole(number) or number < 1:
            raise UserError(f"{name} must be a whole number from 1 on, got {short(repr(number), 60)}")
    opened = open_reader(env, reader)
    problems: list[str] = []
    try:
        check_reset(env)
        played = [play(env, opened, seed + number, max_steps) for number in range(episodes)]
        problems += space_problems(env) + recorded_problems(played, opened.spec)
        problems += observation_problems(played, shown_spaces(env))
        if opened.spec.has_ego:
            problems += ego_problems(env, opened, seed)
        else:
            problems += name_problems(played) + obedience_problems(env, opened, seed)
        problems += replay_problems(env, opened, seed)
    except ReaderProblem as error:
        return Examined([*problems, str(error)])
    return Examined(problems, lasting_share(played, opened.spec))
