"""Checks an environment and its reader: `dgvae check-env my_module:MyEnv-v0`, or `python -m envs.check --env-id ID`.

Plays episodes with random actions and prints a line for each thing that is wrong, and what to do: steps of another
length than dt_s, units, mirrored or swapped axes, ids that are row numbers, change hands, jump or come back, an ego
that is not the first agent, numbers that are not finite, observations that never change. Exit status 1 if something is
wrong.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass

from envs.readers import MakeReader
from envs.registry import arguments_of, make_any_env
from envs.testing import Examined, examine_reader
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import UserError, one_line, run_entry_point
from predictor.support.importing import load_named
from predictor.support.memory import check_count


@dataclass(frozen=True)
class CheckConfig:
    """Plays random episodes of an environment and says what is wrong with it or with its reader."""

    env_id: str
    """Environment: Gymnasium or PettingZoo id, module:Id, or module:function of a function (or class) that makes one;
    the name of the option can be left out."""
    reader: str | None = None
    """Reader, as module:name of what reader= takes; None takes the one that is registered or built in."""
    env_kwargs: str = ""
    """Arguments of the environment as a JSON object, for example '{"config": {"vehicles_density": 2}}'."""
    episodes: int = 5
    """Number of episodes; what never happens in them cannot be found."""
    max_steps: int = 100
    """Largest length of an episode; longer ones are cut there [policy steps]."""
    seed: int = 0
    """Random seed: episode i is reset with seed + i."""

    def __post_init__(self) -> None:
        """Checks ranges.

        Raises:
            UserError: a value out of range.
        """
        check_at_least(self, 1, "episodes", "max_steps")
        check_at_least(self, 0, "seed")
        check_count(self.episodes * self.max_steps, "episodes times max_steps")


def examined(config: CheckConfig) -> Examined:
    """Returns what is wrong, and how many ids last from step to step.

    Raises:
        UserError: no such environment, or no reader knows it.
    """
    make_reader: MakeReader | None = None if config.reader is None else load_named(config.reader)
    env = make_any_env(config.env_id, **arguments_of(config.env_kwargs))
    try:
        return examine_reader(env, make_reader, episodes=config.episodes, max_steps=config.max_steps, seed=config.seed)
    finally:
        env.close()


def with_option(words: Sequence[str]) -> list[str]:
    """Returns the words of a command line, in which the environment may come first without --env-id."""
    return ["--env-id", *words] if words and not words[0].startswith("-") else list(words)


def main() -> None:
    """Runs the command."""
    sys.argv[1:] = with_option(sys.argv[1:])
    config = parse(CheckConfig, __doc__)
    found = examined(config)
    for line in found.problems:
        print(one_line(UserError(line)))
    if found.problems:
        sys.exit(1)
    lasting = f"{found.lasting:.0%} of the others' ids last from step to step" if found.lasting is not None else ""
    print(
        f"nothing found in {config.episodes} episodes; {lasting or 'of other agents too little was seen to say more'}"
    )


if __name__ == "__main__":
    run_entry_point(main)
