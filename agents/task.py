"""Task of a policy (environment, observation, forecaster, drivers), shared by training, evaluation and video."""

import functools
import importlib.util
import math
import re
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any, Literal, get_type_hints

import gymnasium as gym
import numpy as np

from envs.arms import ARMS, Arm, EntryBank, EntryLayout
from envs.drivers.all_agents import DRIVER_NAMES, make_driver
from envs.entry_bank import record_bank
from envs.own_observation import check_unwrapped
from envs.parallel import ForecastParallelEnv
from envs.registry import (
    arguments_of,
    checkpoint_for,
    entry_for,
    envpool_task_of,
    is_multiagent_id,
    make_env,
    make_multiagent_env,
    require_multiagent,
)
from envs.sb3.agents_as_rows import ParallelVecEnv
from envs.sb3.padded_spaces import learners_named
from envs.sb3.policy_file import PolicyNote, pin_forecaster
from envs.supervision import TIMEOUT_S
from envs.wrappers import ForecastObservation
from predictor.checkpoint import CONSTANT_VELOCITY, load_checkpoint, weights_stamp
from predictor.forecaster import Forecaster
from predictor.own_forecasters import is_own
from predictor.scene import SceneSpec
from predictor.support.config_checks import check_at_least, check_at_most, check_choice, check_fields, check_positive
from predictor.support.errors import UserError, short
from predictor.support.memory import check_count
from predictor.support.remote import is_remote
from predictor.support.runtime import resolve_device
from predictor.support.typed_values import converted

EVALUATION_SEED = 2_000_000_000
"""First seed of the final evaluation; training seeds are below 1e9, those of model selection and tuning in between."""

SELECTION_SEED = 1_000_000_000
"""First seed of model selection; training seeds are below it, those of the final evaluation start at 2e9."""

TUNING_SEED = 1_500_000_000
"""First seed that measures hyperparameters (`agents.tune`); model selection takes those from 1e9 on."""

MOST_FUTURES = 10_000
"""Largest number of samples, and of forecast steps."""

Observe = Literal[
    "forecast", "none", "constant-velocity", "zeros", "shuffled", "single", "no-edges", "edges-only", "modes",
    "what-if", "oracle", "oracle-what-if",
]  # fmt: skip
"""What a policy sees: an arm of `envs.arms`, constant-velocity forecasts, or the env's own observation alone."""

NO_CHECKPOINT: tuple[Observe, ...] = ("none", "constant-velocity")
"""What a policy sees without a checkpoint."""
_NO_FORECAST: tuple[Observe, ...] = ("zeros", "oracle", "oracle-what-if")
"""What a policy sees of no checkpoint, though one sets the sizes."""
Backend = Literal["gymnasium", "envpool"]


@dataclass(frozen=True)
class Task:
    """Describes the environment, what the policy sees of it and who drives the agents that do not learn."""

    env_id: str
    """Gymnasium id (highway-fast-v0) or PettingZoo parallel id (simple_tag_v3)."""
    observe: Observe = "forecast"
    """What the policy sees beside the env's own observation: an arm of `envs.arms`, or constant-velocity forecasts;
    "none" shows no forecasts."""
    checkpoint: str | None = None
    """Forecaster behind every arm but none and constant-velocity: shipped name, path, or own:module:function
    (docs/own_forecaster.md); None takes the one that ships for the id."""
    device: str = "cpu"
    """Device that runs the forecaster: cpu, cuda or auto."""
    backend: Backend = "gymnasium"
    """Simulator in training: the gymnasium environment itself, or EnvPool's copy of it in C++."""
    learners: tuple[str, ...] = ()
    """PettingZoo: agents or roles ("adversary") that learn; () takes all agents."""
    driver: str = "heuristic"
    """PettingZoo: driver of the agents that do not learn (`envs.drivers.all_agents`)."""
    num_samples: int = 1
    """Number of futures per agent that the observation has room for."""
    horizon_steps: int | None = None
    """Number of steps to forecast; None takes what the checkpoint was trained for."""
    perception_m: float | None = None
    """Distance up to which the policy sees other agents, now and forecast [m]; None takes the checkpoint's."""
    what_if: bool = False
    """Whether the observation has room for what the others do in each candidate plan of the ego."""
    env_kwargs: str = ""
    """Arguments of the environment, as the text of a JSON object."""
    timeout_s: float = TIMEOUT_S
    """Largest time that one step of an environment may take in a process of its own [s]."""
    crash_key: str | None = None
    """Key of the infos that says whether the ego has crashed; None takes the env's (`envs.readers.register_reader`)."""
    success_key: str | None = None
    """Key of the infos that says whether the ego has succeeded; None takes the env's."""
    sizes_of: str | None = None
    """Checkpoint whose sizes the observation has (edges, steps, agents, range), so that one network reads the forecasts
    of several forecasters; None takes the one that ships for the id, with observe=forecast `checkpoint` itself."""

    def __post_init__(self) -> None:
        """Checks choices, and that the fields fit together; replaces `device="auto"` by the device that is taken."""
        check_fields(self)
        if self.is_multiagent and self.backend != "gymnasium":
            raise UserError(f"backend {self.backend} has no {self.env_id}; leave it out")
        if self.learners:
            require_multiagent(self.env_id, "learners", "are for PettingZoo environments")
        check_choice("driver", self.driver, DRIVER_NAMES)
        if self.backend == "envpool":
            envpool_task_of(self.env_id)
            if importlib.util.find_spec("envpool") is None:
                raise UserError("backend envpool needs the envpool package; pip install 'dgvae-rl[envpool]'")
            if self.what_if or self.observe.startswith("oracle"):
                raise UserError(
                    f"observe={self.observe} and what_if={self.what_if} do not fit backend envpool, which makes no "
                    "plans and cannot be copied; leave it out, or take another arm without what_if"
                )
        if self.checkpoint is not None and self.observe in NO_CHECKPOINT:
            raise UserError(f"checkpoint '{self.checkpoint}' has no effect with observe={self.observe}; leave one out")
        check_at_least(self, 1, "num_samples", "horizon_steps")
        check_at_most(self, MOST_FUTURES, "num_samples", "horizon_steps")
        check_count(self.num_samples * (self.horizon_steps or 1), "horizon_steps times num_samples")
        if self.perception_m != math.inf:  # of an environment whose agents are seen from anywhere
            check_positive(self, "perception_m")
        if self.perception_m is not None and self.observe == "none":
            raise UserError("perception_m has no effect with observe=none; leave one out")
        if self.sizes_of is not None and self.observe == "none":
            raise UserError("sizes_of has no effect with observe=none; leave one out")
        if self.sizes_of == CONSTANT_VELOCITY or is_own(self.sizes_of):
            raise UserError(
                f"sizes_of takes a checkpoint, '{short(self.sizes_of)}' has no sizes of its own; leave it out"
            )
        trusted = {named for named in (self.checkpoint, self.sizes_of) if named and (is_own(named) or is_remote(named))}
        if len(trusted) > 1:  # who evaluates the run names one that is trusted
            raise UserError("checkpoint and sizes_of are both imported or fetched; copy that of sizes_of here first")
        check_positive(self, "timeout_s")
        if self.what_if and self.observe == "none":
            raise UserError("what_if has no effect with observe=none; leave one out")
        if self.what_if and self.is_multiagent:
            raise UserError(f"what_if needs an environment with one ego, {self.env_id} has several learners")
        if self.observe in ARMS:
            Arm(self.observe).check_room(self.num_samples, self.what_if)
        for name in ("crash_key", "success_key"):
            if getattr(self, name) == "":
                raise UserError(f"{name} must be a key of the infos, got ''; leave it out, or name one")
            if getattr(self, name) is not None and self.is_multiagent:
                raise UserError(f"{name} is a key of the infos of an environment with one ego; leave it out")
        if self.make_kwargs and self.backend == "envpool":
            raise UserError("env_kwargs are for the gymnasium backend; leave them or backend envpool out")
        object.__setattr__(self, "device", resolve_device(self.device))

    @property
    def is_multiagent(self) -> bool:
        """Whether this is a PettingZoo environment, with several learners."""
        return is_multiagent_id(self.env_id)

    @property
    def forecaster(self) -> str | None:
        """Value for the argument `checkpoint` of the wrappers."""
        if self.observe == CONSTANT_VELOCITY:
            return CONSTANT_VELOCITY
        if self.observe in _NO_FORECAST and self.checkpoint is None and entry_for(self.env_id).checkpoint is None:
            return self.sizes_of  # whose forecasts are not shown
        return self.checkpoint

    @property
    def make_kwargs(self) -> dict[str, Any]:
        """Arguments of the environment.

        Raises:
            UserError: `env_kwargs` is no JSON object.
        """
        return arguments_of(self.env_kwargs)

    @property
    def options(self) -> dict[str, Any]:
        """Arguments of the wrappers with forecasts, `VecForecast` included.

        All arms of an id have the entries of the checkpoint that ships for it, or of `sizes_of`, so that one network
        reads each of them.

        Raises:
            UserError: see `scene_spec`.
        """
        options: dict[str, Any] = {
            "checkpoint": self.forecaster, "horizon_steps": self.horizon_steps, "num_samples": self.num_samples,
            "device": self.device,
        }  # fmt: skip
        if self.what_if:
            options["what_if"] = True
        sized = self._sized
        if self.observe == "forecast" and sized is None:
            return options
        if sized is not None and self.horizon_steps is None:
            options["horizon_steps"] = sized.horizon_steps
        name = "forecast" if self.observe == CONSTANT_VELOCITY else self.observe
        layout = None if sized is None else EntryLayout.of(sized)
        bank = None
        if self.observe == "shuffled":
            sizes = self.sizes_of or entry_for(self.env_id).checkpoint
            bank = _bank_of(replace(self, observe="forecast", sizes_of=sizes))
        return options | {"arm": Arm(name, layout, bank)}

    def wrapped(self, env: Any) -> Any:
        """Returns an environment of the task in its wrapper with forecasts.

        Raises:
            UserError: see `scene_spec`.
        """
        options, sized = self.options, self._sized
        if sized is not None:  # constant velocity has no range of its own
            options["perception_m"] = sized.spec.perception_m
            if not self.is_multiagent:  # there a view has as many agents as the reader's scenes
                options["max_agents"] = sized.spec.max_agents
        if self.perception_m is not None:
            options["perception_m"] = self.perception_m
        return ForecastParallelEnv(env, **options) if self.is_multiagent else ForecastObservation(env, **options)

    @property
    def _sized(self) -> Forecaster | None:
        """Forecaster whose sizes the observation has; None for those of the one that is shown."""
        if self.observe == "forecast" and self.sizes_of in (None, self.checkpoint or entry_for(self.env_id).checkpoint):
            return None
        return (
            _shipped_for(self.env_id) if self.sizes_of is None else _loaded(self.sizes_of, weights_stamp(self.sizes_of))
        )

    def make(self, **kwargs: Any) -> Any:
        """Makes the environment, without forecasts.

        Raises:
            UserError: unknown id, or arguments that the environment refuses.
        """
        make = make_multiagent_env if self.is_multiagent else make_env
        return make(self.env_id, **self.make_kwargs, **kwargs)

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
            name = self.forecaster or checkpoint_for(self.env_id)
            pin = pin_forecaster(name, *self._forecasts(), self.options.get("arm"))
        return PolicyNote(pin, self.learners, self.driver, self.env_id, self.env_kwargs)

    def _forecasts(self) -> tuple[gym.spaces.Dict, SceneSpec]:
        """Returns an observation space with forecasts, and the layout of the scenes that a policy sees in them."""
        with closing(self.wrapped(self.make())) as env:
            if self.is_multiagent:
                return env.observation_space(env.possible_agents[0]), env.stream.view_spec
            return env.observation_space, env.get_wrapper_attr("scene_spec")

    def check(self) -> tuple[gym.Space, gym.Space]:
        """Makes the environment, with its forecaster, and returns its observation space and its action space.

        Raises:
            UserError: see `scene_spec`; unknown learners, or a driver that cannot drive the other agents.
        """
        if self.is_multiagent:
            return self._check_multiagent()
        with closing(self.make()) as env:
            check_unwrapped(env.observation_space, f"env '{self.env_id}'")
        if self.observe != "none":
            self._forecasts()
        return env.observation_space, env.action_space

    def _check_multiagent(self) -> tuple[gym.Space, gym.Space]:
        with closing(self.make()) as own:
            for agent in own.possible_agents:
                check_unwrapped(own.observation_space(agent), f"'{agent}' of {self.env_id}")
            env = own if self.observe == "none" else self.wrapped(own)
            learners = learners_named(env.possible_agents, self.learners, self.env_id)
            has_others = len(learners) < len(env.possible_agents)
            if has_others:
                make_driver(self.driver, env, np.random.default_rng(0))
            elif self.learners and self.driver != type(self).driver:
                raise UserError(
                    f"driver drives the agents that do not learn, and all of {self.env_id} do; name fewer learners, or "
                    "leave driver out"
                )
            rows = ParallelVecEnv([lambda: env], agents=learners, partner="random" if has_others else None)
            return rows.observation_space, rows.action_space


_OF_RUN = ("env_id", "observe", "checkpoint", "learners", "num_samples", "horizon_steps", "perception_m", "what_if",
           "env_kwargs", "crash_key", "success_key", "sizes_of")  # fmt: skip
"""Fields of a run's config that have the name of a task's; the driver's is "partner"."""
_OWN_PACKAGES = ("highway_env.", "envs.")
"""Packages that the arguments of a run's environment may name: those that it imports anyway."""


def task_of(
    run: Mapping[str, Any],
    device: str = "cpu",
    trusted: str | None = None,
    trusted_forecaster: str | None = None,
    where: str = "the run's config",
) -> Task:
    """Returns the task of a training run.

    Args:
        run: the run's config (`agents.runs.read_config`).
        device: device that runs the forecaster.
        trusted: id of an environment that may be imported ("module:Id"); a run's config alone imports nothing.
        trusted_forecaster: forecaster of a user's own that may be imported ("own:module:function").
        where: file of the config, for messages.

    Raises:
        UserError: the config does not fit this version, names what is missing, or would import code.
    """
    hints = get_type_hints(Task)
    for name in ("env_id", "observe", "checkpoint"):
        if name not in run:
            raise UserError(f"{where}: key '{name}' is missing")
    values = {name: converted(run[name], hints[name], f"{where}: {name}") for name in _OF_RUN if name in run}
    values["driver"] = converted(run.get("partner", "heuristic"), str, f"{where}: partner")
    if ":" in values["env_id"] and values["env_id"] != trusted:
        raise UserError(
            f"the run's environment '{short(values['env_id'], 80)}' imports code; if you trust it, name it yourself "
            f"with --env-id {short(values['env_id'], 80)}"
        )
    for named in filter(None, (values["checkpoint"], values.get("sizes_of"))):
        if named == trusted_forecaster:
            continue
        if is_own(named):
            raise UserError(
                f"the run's forecaster '{short(named, 80)}' imports code; if you trust it, name it yourself with "
                f"--checkpoint {short(named, 80)}"
            )
        if is_remote(named):
            raise UserError(
                f"the run's checkpoint would be fetched from '{short(named, 80)}'; if you trust it, name it yourself "
                f"with --checkpoint {short(named, 80)}"
            )
    try:
        task = Task(device=device, **values)
    except UserError as error:
        raise UserError(f"{where}: {error}") from error
    for text in _texts_of(task.make_kwargs):
        if re.search(r"[.:]", text) and not text.startswith(_OWN_PACKAGES):  # highway-env imports what is before a dot
            raise UserError(
                f"env_kwargs of the run name '{short(text, 80)}', which the environment could import; "
                "if you trust it, make the environment yourself and play the run in it: load_policy(run, env)"
            )
    return task


def _texts_of(content: Any) -> Iterator[str]:
    """Yields all texts in content of JSON."""
    if isinstance(content, str):
        yield content
    elif isinstance(content, dict):
        for value in content.values():
            yield from _texts_of(value)
    elif isinstance(content, list):
        for value in content:
            yield from _texts_of(value)


@functools.lru_cache(maxsize=8)
def _shipped_for(env_id: str) -> Forecaster | None:
    """Returns the forecaster that ships for an id; None if none does."""
    name = entry_for(env_id).checkpoint
    return None if name is None else _loaded(name, weights_stamp(name))


@functools.lru_cache(maxsize=8)
def _loaded(name: str, found: tuple[int, int]) -> Forecaster:
    """Returns the forecaster of a checkpoint."""
    forecaster: Forecaster = load_checkpoint(name)[0]
    return forecaster


@functools.lru_cache(maxsize=8)
def _bank_of(task: Task) -> EntryBank:
    """Returns forecast entries of other episodes of a task."""
    return record_bank(task.wrapped(task.make()), str(task))
