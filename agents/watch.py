"""Shows a trained policy: `python -m agents.watch runs/highway` films an episode with the forecasts drawn in.

The film is an MP4 file. `--window` shows it in a window instead, which needs a screen. A policy's zip holds pickled
Python objects, and loading it runs their code: watch only policies whose source you trust.
"""

import time
from dataclasses import dataclass
from pathlib import Path

import torch
from rich.console import Console
from tyro.conf import Positional

from agents.hub import local_policy
from agents.policy import load_policy, require_as_trained, task_of_policy
from agents.runs import SHIPPED, policy_zip
from agents.task import EVALUATION_SEED
from envs.parallel import living
from envs.sb3 import policy_file
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import check_out
from predictor.support.hub import is_hub
from predictor.support.runtime import keep_freed_memory, resolve_device


@dataclass(frozen=True)
class WatchConfig:
    """Films an episode of a trained policy, or plays it in a window."""

    policy: Positional[Path]
    """Run folder of train_policy.py, a policy's .zip, one that ships (highway-fast), or hub:owner/name with
    --trust-pickle."""
    out: Path | None = None
    """Film to write, .mp4; None takes watch-SEED.mp4 beside the policy, or here for one that ships or is of a hub."""
    seed: int = EVALUATION_SEED
    """Random seed of the episode; the default is the first one of an evaluation."""
    window: bool = False
    """Show the episode in a window instead, which needs a screen; Escape ends it."""
    max_steps: int = 200
    """Largest number of policy steps."""
    device: str = "cpu"
    """Device that runs forecaster and policy: cpu, cuda or auto (cuda where there is one)."""
    trust_pickle: bool = False
    """Load a policy of a hub, which runs code of everyone who can write to its repository."""

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

    path = local_policy(config.policy, config.trust_pickle)
    zipped = policy_zip(path)
    task = task_of_policy(path, config.device)
    beside = Path() if is_hub(config.policy) or zipped.parent == SHIPPED else zipped.parent
    out = config.out or beside / f"watch-{config.seed}.mp4"
    check_out(out.parent)
    model = policy_file.load_policy(zipped, device=config.device)
    require_as_trained(zipped, model, task)
    shown = film(task, model, out, config.seed, config.max_steps)
    if shown is None:
        raise UserError(
            f"{task.env_id} cannot be drawn: films are of highway-env, of PettingZoo environments with a reader, and "
            "of those with register_view (docs/trained_policies.md); try --window"
        )
    return shown


def play_in_window(config: WatchConfig) -> int:
    """Plays the episode and shows it in a window with the forecasts drawn in; returns the number of pictures shown.

    An environment that nothing here draws is shown in its own window, at its own pace.

    Raises:
        UserError: no policy there, no screen, or an environment without a window.
    """
    from agents.video import recorded  # films alone need a video encoder
    from envs.video.window import play

    path = local_policy(config.policy, config.trust_pickle)
    task = task_of_policy(path, config.device)
    zipped = policy_zip(path)
    model = policy_file.load_policy(zipped, device=config.device)
    require_as_trained(zipped, model, task)
    recording = recorded(task, model, config.seed, config.max_steps)
    if recording is None:
        return _play_in_own_window(config, path)
    title = f"{task.env_id}, seed {config.seed}"
    return play((recording.draw(index) for index in range(len(recording))), recording.fps, title)


def _play_in_own_window(config: WatchConfig, path: Path) -> int:
    """Plays the episode in the environment's own window, without forecasts; returns the number of steps."""
    try:
        policy, env = load_policy(path, device=config.device, render_mode="human")
    except TypeError as error:
        raise UserError(f"the environment has no window: {error}") from error
    pace_s = 1 / float((env.metadata or {}).get("render_fps") or 10)
    observation, _ = env.reset(seed=config.seed)
    steps, ended = 0, False
    while not ended and steps < config.max_steps:
        began = time.monotonic()
        observation, rewards, terminated, truncated, _ = env.step(policy(observation))
        steps += 1
        ended = not living(env, terminated, truncated) if isinstance(rewards, dict) else bool(terminated or truncated)
        time.sleep(max(0.0, pace_s - (time.monotonic() - began)))
    env.close()
    return steps


def main() -> None:
    """Runs the command."""
    keep_freed_memory()
    torch.set_num_threads(1)  # small networks
    config = parse(WatchConfig, __doc__)
    if config.window:
        play_in_window(config)
    else:
        Console().print(f"film: {write_film(config)}")


if __name__ == "__main__":
    run_entry_point(main)
