"""Counts environment steps where Stable-Baselines3 counts the steps of every learner.

SB3 adds the number of its environments at each vector step. In PettingZoo tasks each learner is one of them, so one
step of a copy with three learners counts as three. Here it counts as one, as it does where an environment has one ego:
in budgets, measurements, checkpoints, the progress bar, TensorBoard and schedules alike.
"""

import math

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from predictor.support.progress import WorkShown


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
        on_policy = isinstance(self.model, OnPolicyAlgorithm)
        each: int = self.model.n_steps if on_policy else self.model.train_freq.frequency  # type: ignore[attr-defined]
        rollout = each * self._num_envs
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
