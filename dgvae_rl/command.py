"""The command `dgvae`: one name for the commands of this project, `dgvae collect` for `python -m envs.collect`.

Like `python -m`, it finds modules of the folder that it is called in, so that `--env-id my_module:MyEnv-v0` works.
Unlike there, a folder `envs/` of the user hides nothing of ours (`dgvae_rl.own_packages`).
"""

import contextlib
import difflib
import importlib
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass

from dgvae_rl import __version__
from dgvae_rl.own_packages import OWN


@dataclass(frozen=True)
class Command:
    """Command of this project."""

    module: str
    """Module with a function `main`."""
    does: str
    """What it does, in a line of the help."""
    extra: str
    """Extras of the package that install what it needs, with commas between."""


COMMANDS = {
    "check-env": Command("envs.check", "say what is wrong with an environment or its reader", "envs"),
    "collect": Command("envs.collect", "record episodes of an environment", "envs"),
    "train-predictor": Command("predictor.train", "train a predictor on recorded episodes", ""),
    "evaluate": Command("envs.evaluate", "measure forecasts in running environments", "envs"),
    "train-policy": Command("train_policy", "train a policy that sees forecasts, evaluate and film it", "rl"),
    "evaluate-policy": Command("agents.evaluate", "measure a policy on held-out seeds, beside simple drivers", "rl"),
    "watch": Command("agents.watch", "film an episode of a policy, or play it in a window", "rl"),
    "report": Command("agents.report", "write the report of a run: config, curves, tables, films", "rl"),
    "push": Command("agents.push", "share a checkpoint or a policy on a hub", "hub,rl"),
    "tune": Command("agents.tune", "search hyperparameters of a learning algorithm", "tune"),
    "study": Command("agents.study", "compare what policies are shown, over several seeds", "study"),
}
"""Commands by name, in the order of use."""

USAGE = f"""\
usage: dgvae COMMAND [options]

Shows a reinforcement-learning policy what the other agents are about to do.

{chr(10).join(f"  {name:16} {command.does}" for name, command in COMMANDS.items())}

Examples:
  dgvae train-policy --what-if --num-samples 6 --steps 3000 --out runs/mine
  dgvae watch runs/mine

dgvae COMMAND --help explains every option, dgvae --version prints the version."""


class CommandLineError(Exception):
    """Raised if the command cannot be run; the message says what to do."""


def run(words: Sequence[str]) -> None:
    """Runs a command.

    Args:
        words: name of the command and its options.

    Raises:
        CommandLineError: there is no such command, or a package that it needs is not installed.
    """
    if not words or words[0] in ("-h", "--help", "help"):
        print(USAGE)
        return
    name, *options = words
    if name == "--version":
        print(f"dgvae-rl {__version__}")
        return
    command = COMMANDS.get(name)
    if command is None:
        near = difflib.get_close_matches(name, COMMANDS, n=1)
        meant = f"; did you mean {near[0]}?" if near else f"; there are {', '.join(COMMANDS)}"
        raise CommandLineError(f"dgvae has no command '{name}'{meant}")
    sys.argv = [f"dgvae {name}", *options]

    try:
        main = importlib.import_module(f"dgvae_rl.{command.module}").main
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] in (*OWN, "dgvae_rl"):
            raise
        extra = f"'dgvae-rl[{command.extra}]'" if command.extra else "dgvae-rl"
        raise CommandLineError(f"dgvae {name} needs {error.name}; install it with pip install {extra}") from error
    main()


def main() -> None:
    """Runs the command line of this process."""
    with contextlib.suppress(FileNotFoundError):  # a folder that was deleted
        if not sys.flags.safe_path and os.getcwd() not in sys.path:
            sys.path.insert(0, os.getcwd())
    try:
        # Ctrl-C is one line also while the command is imported
        importlib.import_module("dgvae_rl.predictor.support.errors").run_entry_point(lambda: run(sys.argv[1:]))
    except CommandLineError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
