"""Shares a checkpoint or a policy on a Hugging Face hub: `python -m agents.push runs/merge owner/name`.

A predictor's checkpoint is safetensors and JSON, and safe to load for others. A policy's zip holds pickled Python
objects: others run its code when they load it, and have to say that they trust it. Log in with `hf auth login` before.
"""

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from tyro.conf import Positional

from agents.hub import push_policy_to_hub
from agents.runs import is_policy
from predictor.hub import push_to_hub
from predictor.support.command_line import parse
from predictor.support.errors import run_entry_point
from predictor.support.hub import PREFIX, hub_name


@dataclass(frozen=True)
class PushConfig:
    """Writes a checkpoint or a policy into a repository of a hub."""

    what: Positional[str]
    """Predictor: shipped name, folder or run folder. Policy: run folder of train_policy.py, or a .zip."""
    repository: Positional[str]
    """Owner and name of the repository, as owner/name; a new one is made if it does not exist."""
    private: bool = False
    """Whether a new repository is private."""

    def __post_init__(self) -> None:
        """Checks the name.

        Raises:
            UserError: it is no owner/name.
        """
        hub_name(f"{PREFIX}{self.repository.removeprefix(PREFIX)}")


def main() -> None:
    """Runs the command."""
    config = parse(PushConfig, __doc__)
    send = push_policy_to_hub if is_policy(Path(config.what)) else push_to_hub
    Console().print(f"pushed to {send(config.what, config.repository, config.private)}", soft_wrap=True)


if __name__ == "__main__":
    run_entry_point(main)
