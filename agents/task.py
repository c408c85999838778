"""Task of a policy (environment, observation, forecaster, drivers), shared by training, evaluation and video."""

import importlib.util
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium as gym
import numpy as np

from envs.drivers.all_agents import DRIVER_NAMES, make_driver
from envs.parallel import ForecastParallelEnv
from envs.registry import (
    checkpoint_for,
    envpool_task_of,
    is_multiagent_id,
    make_env,
    make_multiagent_env,
)
from envs.sb3.agents_as_rows import ParallelVecEnv
from envs.sb3.padded_spaces import learners_named
from envs.sb3.policy_file import PolicyNote, pin_forecaster
from envs.wrappers import ForecastObservation
from predictor.checkpoint import CONSTANT_VELOCITY
from predictor.scene import SceneSpec
from predictor.support.config_checks import check_choice, check_choices
from predictor.support.errors import UserError
from predictor.support.runtime import resolve_device

EVALUATION_SEED = 2_000_000_000
"""First seed of the final evaluation; training seeds are below 1e9, those of model selection between 1e9 and 2e9."""

SELECTION_SEED = 1_000_000_000
"""First seed of model selection; training seeds are below it, those of the final evaluation start at 2e9."""

Observe = Literal["forecast", "none", "constant-velocity"]
Backend = Literal["gymnasium", "envpool"]


@dataclass(frozen=True)
class Task:
    """Describes the environment, what the policy sees of it and who drives the agents that do not learn."""

    env_id: str
    """Gymnasium id (highway-fast-v0) or PettingZoo parallel id (simple_tag_v3)."""
    observe: Observe = "forecast"
    """What the policy sees: learned forecasts, the env's own observation alone, or constant-velocity forecasts."""
    checkpoint: str | None = None
    """Forecaster for `observe="forecast"`: shipped name or path; None takes the one that ships for the id."""
    device: str = "cpu"
    """Device that runs the forecaster: cpu, cuda or auto."""
    backend: Backend = "gymnasium"
    """Simulator in training: the gymnasium environment itself, or EnvPool's copy of it in C++."""
    learners: tuple[str, ...] = ()
    """PettingZoo: agents or roles ("adversary") that learn; () takes all agents."""
    driver: str = "heuristic"
    """PettingZoo: driver of the agents that do not learn (`envs.drivers.all_agents`)."""

    def __post_init__(self) -> None:
        """Checks choices, and that the fields fit together; replaces `device="auto"` by the device that is taken."""
        check_choices(self)
        if self.is_multiagent and self.backend != "gymnasium":
            raise UserError(f"backend {self.backend} has no {self.env_id}; leave it out")
        if self.learners and not self.is_multiagent:
            raise UserError(f"learners are for PettingZoo environments, {self.env_id} has one ego; leave them out")
        check_choice("driver", self.driver, DRIVER_NAMES)
        if self.backend == "envpool":
            envpool_task_of(self.env_id)
            if importlib.util.find_spec("envpool") is None:
                raise UserError("backend envpool needs the envpool package; pip install 'dgvae-rl[envpool]'")
        if self.checkpoint is not None and self.observe != "forecast":
            raise UserError(f"checkpoint '{self.checkpoint}' has no effect with observe={self.observe}; leave one out")
        object.__setattr__(self, "device", resolve_device(self.device))

    @property
    def is_multiagent(self) -> bool:
        """Whether this is a PettingZoo environment, with several learners."""
        return is_multiagent_id(self.env_id)

    @property
    def forecaster(self) -> str | None:
        """Value for the argument `checkpoint` of the wrappers."""
        return CONSTANT_VELOCITY if self.observe == CONSTANT_VELOCITY else self.checkpoint

    @property
    def scene_spec(self) -> SceneSpec | None:
        """Layout of the scenes behind the forecasts; None if the policy sees no forecasts.

        Raises:
            UserError: unknown env, missing checkpoint, or a checkpoint that does not fit the env.
        """
        return None if self.observe == "none" else self._forecasts()[1]

    @property
    def note(self) -> PolicyNote:
        """Note of a policy of this task: its forecaster, learners and driver.

        Raises:
            UserError: see `scene_spec`.
        """
        pin = None
        if self.observe != "none":
            pin = pin_forecaster(self.forecaster or checkpoint_for(self.env_id), *self._forecasts())
        return PolicyNote(pin, self.learners, self.driver)

    def _forecasts(self) -> tuple[gym.spaces.Dict, SceneSpec]:
        """Returns an observation space with forecasts, and the layout of the scenes behind them."""
        space: Any
        if self.is_multiagent:
            many = ForecastParallelEnv(make_multiagent_env(self.env_id), self.forecaster, device=self.device)
            space, spec = many.observation_space(many.possible_agents[0]), many.scene_spec
            many.close()
            return space, spec
        env = ForecastObservation(make_env(self.env_id), self.forecaster, device=self.device)
        space, spec = env.observation_space, env.get_wrapper_attr("scene_spec")
        env.close()
        return space, spec

    def check(self) -> gym.Space:
        """Makes the environment, with its forecaster, and returns its action space.

        Raises:
            UserError: see `scene_spec`; unknown learners, or a driver that cannot drive the other agents.
        """
        if self.is_multiagent:
            return self._check_multiagent()
        env = make_env(self.env_id)
        env.close()
        _ = self.scene_spec
        return env.action_space

    def _check_multiagent(self) -> gym.Space:
        env = make_multiagent_env(self.env_id)
        if self.observe != "none":
            env = ForecastParallelEnv(env, self.forecaster, device=self.device)
        learners = learners_named(env.possible_agents, self.learners, self.env_id)
        has_others = len(learners) < len(env.possible_agents)
        if has_others:
            make_driver(self.driver, env, np.random.default_rng(0))
        space = ParallelVecEnv([lambda: env], agents=learners, partner="random" if has_others else None).action_space
        env.close()
        return space
