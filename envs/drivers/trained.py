"""Trained policies as drivers: of the agents of a PettingZoo environment, and of an ego with its wrapper.

Learners, the driver of the others and the forecaster are read from the note inside the policy's zip
(`envs.sb3.policy_file`); without a note, the policy drives all agents.
"""

import functools
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from envs.arms import Arm
from envs.drivers.all_agents import Driver, make_driver
from envs.own_observation import carries_forecasts, space_without_added
from envs.registry import entry_for
from predictor.own_forecasters import is_own
from predictor.scene import SceneSpec
from predictor.support.errors import UserError
from predictor.support.files import Stamp, stamp

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

    from envs.sb3.acting import ActingTeam
    from envs.sb3.policy_file import PolicyNote

EgoDriver = Callable[[Any], Any]
"""Maps an observation to an action."""


def trained_driver(path: str, env: Any, rng: np.random.Generator) -> Driver:
    """Returns a driver of all agents for one episode: the policy drives the learners, the note's driver the others.

    Args:
        path: path of an SB3 ``.zip``. It holds pickled data: load only files whose source you trust.
        env: a `ForecastParallelEnv`, whose observations the driver gets.
        rng: source of randomness of the note's driver.

    Raises:
        UserError: no such policy, or one that was trained on other observations.
    """
    from envs.sb3.acting import ActingTeam  # most drivers need no SB3

    policy, note = kept_policy(path), note_of(path)
    team = ActingTeam(policy, env, () if note is None else note.learners, f"policy {path}")
    if note is not None and is_own(note.driver):
        raise UserError(f"policy {path}: the note names driver '{note.driver}', which imports code; train it anew")
    others = (
        make_driver(note.driver, env, rng)
        if note is not None and team.actions.keys() < set(env.possible_agents)
        else None
    )
    return partial(_drive, env, team, others)


def trained_ego(path: str) -> EgoDriver:
    """Returns a driver of an ego for one episode.

    Raises:
        UserError: see `kept_policy`.
    """
    from envs.sb3.acting import ActingPolicy  # most drivers need no SB3

    return ActingPolicy(kept_policy(path))


def _drive(env: Any, team: "ActingTeam", others: Driver | None, observations: Mapping[str, Any]) -> dict[str, Any]:
    chosen = {} if others is None else others({a: s for a, s in observations.items() if a not in team.actions})
    return chosen | team({agent: seen for agent, seen in observations.items() if agent in env.agents})


def env_for_driver(env: gym.Env, name: str) -> gym.Env:
    """Returns the env with the observations of a driver: with forecasts for a policy trained on them, else as it is.

    Raises:
        UserError: no such policy, or one that was trained on other observations or actions.
    """
    if not name.endswith(".zip"):
        return env
    if sees_forecasts(name):
        from envs.wrappers import ForecastObservation  # most drivers need no wrapper

        options = wrapper_options(name)
        if not options and env.spec is not None and entry_for(env.spec.id).checkpoint is None:
            raise UserError(
                f"policy {name} does not say with which forecaster it was trained, and none ships for {env.spec.id}; "
                "play it with Stable-Baselines3 in the wrapper of its training, or train it with train_policy.py"
            )
        env = ForecastObservation(env, **options)
        require_view(env, name)
        if options:
            space: Any = env.observation_space
            require_forecaster(
                name, options["checkpoint"], space, env.get_wrapper_attr("scene_spec"), options.get("arm")
            )
        return env
    require_view(env, name)
    return env


def parallel_env_for_driver(env: Any, driver: str) -> Any:
    """Returns a PettingZoo env, in the wrapper that a policy with a note on its forecaster was trained with.

    Raises:
        UserError: the policy was trained on another forecaster, with plans, or on true futures beside agents that a
            driver moves.
    """
    options = wrapper_options(driver) if sees_forecasts(driver) else {}
    if not options:
        return env
    if "what_if" in options:
        raise UserError(f"policy {driver} was trained with plans of one ego, which PettingZoo environments do not have")
    note = note_of(driver)
    if options["arm"].shown.true_futures and note is not None and note.learners:
        raise UserError(
            f"policy {driver} was trained on arm '{options['arm'].name}' beside agents that do not learn, whose true "
            "futures follow from their driver: only agents.evaluate and agents.watch play it"
        )
    from envs.parallel import ForecastParallelEnv  # most drivers need no wrapper

    seen = ForecastParallelEnv(env, **options)
    space: Any = seen.observation_space(seen.possible_agents[0])
    require_forecaster(driver, options["checkpoint"], space, seen.stream.view_spec, options["arm"])
    return seen


def wrapper_options(path: str) -> dict[str, Any]:
    """Returns the arguments of the wrapper that shows what a policy was trained on; none if it has no note on it.

    Raises:
        UserError: the policy was trained on forecasts of other scenes, which only `agents.evaluate` can make.
    """
    note = note_of(path)
    if note is None or note.forecaster is None:
        return {}
    pin = note.forecaster
    arm = Arm(pin.arm, pin.layout)
    if arm.shown.other_scene:
        raise UserError(
            f"policy {path} was trained on arm '{pin.arm}', a control: only agents.evaluate and agents.watch play it"
        )
    what_if = {"what_if": True} if pin.num_plans else {}
    return {
        "checkpoint": pin.checkpoint, "horizon_steps": pin.horizon_steps, "num_samples": pin.num_samples,
        "max_agents": pin.max_agents, "perception_m": np.inf if pin.perception_m is None else pin.perception_m,
        "arm": arm,
    } | what_if  # fmt: skip


def require_view(env: gym.Env, name: str) -> None:
    """Raises a `UserError` if the driver is a policy of other observations or actions than the env's."""
    _require_spaces(env.observation_space, env.action_space, name)


def require_own_view(env: gym.Env, name: str) -> None:
    """Raises a `UserError` if the driver is a policy that does not drive by the environment's own observation."""
    if sees_forecasts(name):
        raise UserError(f"policy {name} sees forecasts, which a driver is not shown; measure it with --run-dir {name}")
    _require_spaces(space_without_added(env.observation_space), env.action_space, name)


def _require_spaces(observations: gym.Space, actions: gym.Space, name: str) -> None:
    if not name.endswith(".zip"):
        return
    from envs.sb3.acting import require_actions, space_as_stored  # most drivers need no SB3

    policy = kept_policy(name)
    if space_as_stored(observations) != policy.observation_space:
        raise UserError(f"policy {name} was trained on {policy.observation_space}, but the env gives {observations}")
    require_actions(policy, actions, f"policy {name}")


def sees_forecasts(name: str) -> bool:
    """Returns whether the driver is a policy that was trained on forecasts."""
    return name.endswith(".zip") and carries_forecasts(kept_policy(name).observation_space)


def kept_policy(path: str) -> "BaseAlgorithm":
    """Returns the policy of a zip, loaded once per process unless the file is replaced.

    Raises:
        UserError: see `envs.sb3.policy_file.load_policy`.
    """
    return _loaded(path, stamp(path))


@functools.lru_cache(maxsize=16)
def _loaded(path: str, found: Stamp) -> "BaseAlgorithm":
    from envs.sb3.policy_file import load_policy  # most drivers need no SB3

    return load_policy(Path(path))


def note_of(path: str) -> "PolicyNote | None":
    """Returns the note of a policy; None, with a warning, if it has none (saved by SB3 alone or by an old version)."""
    from envs.sb3.policy_file import read_policy_note

    note = read_policy_note(Path(path))
    if note is None:
        warnings.warn(
            f"{path} has no note on its forecaster and learners: it gets the forecaster that ships for the environment "
            "and drives all agents; policies that train_policy.py saves now have one",
            stacklevel=2,
        )
    return note


def require_forecaster(
    path: str, checkpoint: str, space: gym.spaces.Dict, spec: SceneSpec, arm: Arm | None = None
) -> None:
    """Raises a `UserError` if a policy was trained on another forecaster, or with other options.

    Args:
        path: path of the policy's zip.
        checkpoint: checkpoint whose forecasts it gets.
        space: observation space with that forecaster's forecasts.
        spec: layout of the scenes.
        arm: arm of the wrapper; None shows everything.
    """
    from envs.sb3.policy_file import pin_forecaster

    note = note_of(path)
    if note is not None and note.forecaster is not None:
        found = pin_forecaster(checkpoint, space, spec, arm)
        note.forecaster.check(found, f"policy {path}")
