"""Shows a trained policy: `python -m agents.watch runs/highway` films an episode with the forecasts drawn in.

The film is an MP4 file. `--window` plays the episode in the environment's own window instead, without forecasts. A
policy's zip holds pickled Python objects, and loading it runs their code: watch only policies whose source you trust.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from tyro.conf import Positional

from agents.policy import load_policy, policy_zip, task_of_policy
from agents.task import EVALUATION_SEED
from envs.sb3 import policy_file
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import check_out
from predictor.support.runtime import keep_freed_memory, resolve_device


@dataclass(frozen=True)
class WatchConfig:
    """Films an episode of a trained policy, or plays it in a window."""

    policy: Positional[Path]
    """Run folder of train_policy.py, or a policy's .zip."""
    out: Path | None = None
    """Film to write, .mp4; None takes watch-SEED.mp4 beside the policy."""
    seed: int = EVALUATION_SEED
    """Random seed of the episode; the default is the first one of an evaluation."""
    window: bool = False
    """Play the episode in a window instead, which needs a screen and shows no forecasts."""
    max_steps: int = 1000
    """Largest number of policy steps in the window."""
    device: str = "cpu"
    """Device that runs forecaster and policy: cpu, cuda or auto (cuda where there is one)."""

    def __post_init__(self) -> None:
        """Checks ranges; replaces `device="auto"` by the device that is taken.

        Raises:
            UserError: a value is out of range or does not fit the others.
        """
        check_at_least(self, 0, "seed")
        check_at_least(self, 1, "max_steps")
        if self.window and self.out is not None:
            raise UserError("--window writes no film; leave out --out or --window")
        if self.out is not None and self.out.suffix != ".mp4":
            raise UserError(f"--out is a film and ends in .mp4, got {self.out}")
        object.__setattr__(self, "device", resolve_device(self.device))


def write_film(config: WatchConfig) -> Path:
    """Films the episode; returns the path of the film.

    Raises:
        UserError: no policy there, or an environment that cannot be drawn.
    """
    from agents.video import film  # films alone need a video encoder

    zipped = policy_zip(config.policy)
    task = task_of_policy(config.policy, config.device)
    out = config.out or zipped.parent / f"watch-{config.seed}.mp4"
    check_out(out.parent)
    model = policy_file.load_policy(zipped, device=config.device)
    shown = film(task, model, out, config.seed)
    if shown is None:
        raise UserError(f"{task.env_id} cannot be drawn: films are of highway-env and PettingZoo; try --window")
    return shown


def play_in_window(config: WatchConfig) -> float:
    """Plays the episode in a window, at the environment's own pace; returns the mean return of the agents.

    Raises:
        UserError: no policy there, or an environment without a window.
    """
    try:
        policy, env = load_policy(config.policy, device=config.device, render_mode="human")
    except TypeError as error:
        raise UserError(f"the environment has no window: {error}") from error
    pace_s = 1 / float((env.metadata or {}).get("render_fps") or 10)
    total: dict[Any, float] = {}
    observation, _ = env.reset(seed=config.seed)
    for _ in range(config.max_steps):
        began = time.monotonic()
        observation, rewards, terminated, truncated, _ = env.step(policy(observation))
        several = isinstance(rewards, dict)
        for agent, reward in (rewards if several else {"": rewards}).items():
            total[agent] = total.get(agent, 0.0) + float(reward)
        if not env.agents if several else (terminated or truncated):
            break
        time.sleep(max(0.0, pace_s - (time.monotonic() - began)))
    env.close()
    return sum(total.values()) / max(1, len(total))


def main() -> None:
    """Runs the command."""
    keep_freed_memory()
    torch.set_num_threads(1)  # small networks
    config = parse(WatchConfig, __doc__)
    if config.window:
        Console().print(f"return: {play_in_window(config):.2f}")
    else:
        Console().print(f"film: {write_film(config)}")


if __name__ == "__main__":
    run_entry_point(main)
