"""Counts environment steps where Stable-Baselines3 counts the steps of every learner.

SB3 adds the number of its environments at each vector step. In PettingZoo tasks each learner is one of them, so one
step of a copy with three learners counts as three. Here it counts as one, as it does where an environment has one ego:
in budgets, measurements, checkpoints, the progress bar, TensorBoard and schedules alike.
"""

import math
import zipfile
from pathlib import Path

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from envs.sb3.policy_file import read_note
from predictor.support.errors import UserError
from predictor.support.progress import WorkShown

_UNIT = "step_unit"
STEP_UNIT = {_UNIT: "environment"}
"""Content of a checkpoint's note that says what its steps count."""


class CountSteps(BaseCallback):
    """Makes the model's `num_timesteps` count environment steps; must be the first callback.

    Args:
        num_envs: number of parallel environments or copies: environment steps in one vector step.
    """

    def __init__(self, num_envs: int) -> None:
        """Stores the number."""
        super().__init__()
        self._num_envs = num_envs

    def _on_step(self) -> bool:
        self.model.num_timesteps -= self.training_env.num_envs - self._num_envs  # SB3 has just added all learners
        self.num_timesteps = self.model.num_timesteps
        return True


class StepProgress(BaseCallback):
    """Shows how many environment steps are done: a bar on a terminal, plain lines in a file.

    Args:
        steps: number of environment steps of the whole training; on-policy algorithms make whole rollouts.
        num_envs: number of parallel environments or copies.
    """

    def __init__(self, steps: int, num_envs: int) -> None:
        """Stores the numbers."""
        super().__init__()
        self._steps, self._num_envs = steps, num_envs
        self._shown: WorkShown | None = None

    def _on_training_start(self) -> None:
        done = self.model.num_timesteps
        rollout = self.model.n_steps * self._num_envs if isinstance(self.model, OnPolicyAlgorithm) else 1
        to_come = math.ceil((self._steps - done) / rollout) * rollout
        self._shown = WorkShown("train", done + to_come, done)
        self._shown.__enter__()

    def _on_step(self) -> bool:
        assert self._shown is not None
        self._shown.to(self.num_timesteps)
        return True

    def say(self, line: str) -> None:
        """Prints a line that stays."""
        if self._shown is not None:
            self._shown.say(line)

    def close(self) -> None:
        """Gives the terminal back, also after an interrupt."""
        if self._shown is not None:
            self._shown.__exit__(None, None, None)
            self._shown = None


def check_step_unit(checkpoint: Path, is_multiagent: bool) -> None:
    """Checks that the steps of a checkpoint, if there is one, are environment steps.

    Args:
        checkpoint: path of the model from which a training would go on.
        is_multiagent: whether several agents may learn; otherwise there is no difference.

    Raises:
        UserError: it comes from a version that counted the steps of every learner.
    """
    if not is_multiagent or not checkpoint.exists():
        return
    try:
        note = read_note(checkpoint)
    except zipfile.BadZipFile:
        return  # loading it has the message
    if note.get(_UNIT) != STEP_UNIT[_UNIT]:
        raise UserError(
            f"cannot resume {checkpoint.parent}: it counted the steps of every learner, but steps are environment "
            "steps now (one step of a copy is one, however many agents learn); start a new run with another --out"
        )
