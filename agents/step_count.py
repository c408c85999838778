"""Counts environment steps where Stable-Baselines3 counts the steps of every learner.

SB3 adds the number of its environments at each vector step. In PettingZoo tasks each learner is one of them, so one
step of a copy with three learners counts as three. Here it counts as one, as it does where an environment has one ego:
in budgets, measurements, checkpoints, the progress bar, TensorBoard and schedules alike.
"""

import zipfile
from pathlib import Path

from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback

from envs.sb3.policy_file import read_note
from predictor.support.errors import UserError

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


class StepProgress(ProgressBarCallback):
    """Shows SB3's progress bar over environment steps.

    Args:
        num_envs: number of parallel environments or copies.
    """

    def __init__(self, num_envs: int) -> None:
        """Stores the number."""
        super().__init__()
        self._num_envs = num_envs

    def _on_step(self) -> bool:
        self.pbar.update(self._num_envs)
        return True

    def close(self) -> None:
        """Gives the terminal back, also after an interrupt."""
        if hasattr(self, "pbar"):
            self.pbar.close()


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
