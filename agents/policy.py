"""Loads a trained policy with the environment that it was trained for: `policy, env = load_policy("runs/highway")`.

What the policy sees, which agents it drives and who drives the others stand in the note inside its zip
(`envs.sb3.policy_file`). The zip itself is Stable-Baselines3's and holds pickled Python objects: **loading a policy
runs code that is in the file.** Load only files that you made, or whose source you trust. Predictor checkpoints hold no
code.
"""

from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
from pettingzoo import ParallelEnv
from stable_baselines3.common.base_class import BaseAlgorithm

from agents.hub import local_policy
from agents.runs import CONFIG_FILE, policy_zip, read_config
from agents.task import Task, task_of
from agents.vec_envs import DrivenEnv
from envs.drivers.trained import env_for_driver, parallel_env_for_driver
from envs.own_observation import carries_forecasts
from envs.registry import arguments_of
from envs.sb3 import policy_file
from envs.sb3.acting import ActingPolicy, ActingTeam
from envs.sb3.padded_spaces import learners_named
from envs.sb3.policy_file import PolicyNote, read_policy_note
from predictor.checkpoint import CONSTANT_VELOCITY
from predictor.support.errors import UserError, short


class TrainedPolicy:
    """Maps observations of its environment to actions: `action = policy(observation)`.

    In a PettingZoo environment it takes the observations of all agents and returns the actions of all that live; the
    driver of the training acts for those that did not learn. A recurrent policy remembers what it saw since the latest
    reset of its environment.

    Args:
        model: network and algorithm, as Stable-Baselines3 loads them.
        env: environment whose resets begin episodes, with a `CountedEpisodes` or a `DrivenEnv` inside.

    Attributes:
        model: network and algorithm.
    """

    def __init__(self, model: BaseAlgorithm, env: Any) -> None:
        """Begins without a state."""
        self.model = model
        self._env = env
        self._acting = ActingPolicy(model)
        self._episode = -1

    def __call__(self, observation: Any) -> Any:
        """Returns the most likely action."""
        if self._begins():
            self._acting = ActingPolicy(self.model)
        return self._acting(observation)

    def _begins(self) -> bool:
        """Returns whether an episode has begun since the latest call, of which a recurrent policy must know."""
        if not is_recurrent(self.model) or self._episode == (episode := _episodes(self._env)):
            return False
        self._episode = episode
        return True


class CountedEpisodes(gym.Wrapper[Any, Any, Any, Any]):
    """Counts resets, by which a recurrent policy knows that an episode begins.

    Attributes:
        episodes: number of resets so far.
    """

    def __init__(self, env: gym.Env) -> None:
        """Begins at 0."""
        super().__init__(env)
        self.episodes = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Resets the environment."""
        self.episodes += 1
        return self.env.reset(seed=seed, options=options)


def _episodes(env: Any) -> int:
    number: int = env.get_wrapper_attr("episodes") if isinstance(env, gym.Env) else env.episodes
    return number


def is_recurrent(model: BaseAlgorithm) -> bool:
    """Returns whether a policy keeps a state from step to step, as sb3-contrib's RecurrentPPO does."""
    return hasattr(model, "_last_lstm_states")


class LoadedPolicy(NamedTuple):
    """Trained policy and its environment."""

    policy: TrainedPolicy
    """Function of an observation that returns an action."""
    env: Any
    """Environment whose observations the policy was trained on, with forecasts if it saw any."""


def load_policy(
    path: str | Path,
    env: Any = None,
    *,
    device: str = "cpu",
    render_mode: str | None = None,
    trust_pickle: bool = False,
) -> LoadedPolicy:
    """Loads a policy and makes its environment.

        >>> from agents import load_policy
        >>> policy, env = load_policy("runs/highway")  # doctest: +SKIP
        >>> observation, info = env.reset(seed=0)  # doctest: +SKIP
        >>> observation, *_ = env.step(policy(observation))  # doctest: +SKIP

    The zip holds pickled Python objects, and loading it runs their code: load only policies whose source you trust.

    Args:
        path: run folder of train_policy.py, a policy's ``.zip``, or "hub:owner/name" (`agents.hub`).
        env: environment without forecasts, to take instead of a new one; for zips that do not name theirs.
        device: device of the policy's network.
        render_mode: render mode of the new environment ("human", "rgb_array").
        trust_pickle: whether you trust everyone who can write to a repository on a hub; without it nothing is
            downloaded from there.

    Raises:
        UserError: no policy there, one on a hub without `trust_pickle`, a policy that does not name its environment,
            or one that was trained on other observations or another forecaster.
    """
    path = local_policy(path, trust_pickle)
    zipped = policy_zip(path)
    note = read_policy_note(zipped)
    model = policy_file.load_policy(zipped, device=device)
    if env is None:
        task = task_of_policy(path, sized=False)
        env = task.make() if render_mode is None else task.make(render_mode=render_mode)
    elif render_mode is not None:
        raise UserError(f"render_mode={render_mode!r} is for a new environment; give it to the env that you pass")
    if isinstance(env, ParallelEnv):
        return _of_many_agents(str(zipped), model, env, note or PolicyNote())
    env = env_for_driver(CountedEpisodes(env) if is_recurrent(model) else env, str(zipped))
    return LoadedPolicy(TrainedPolicy(model, env), env)


def require_forecaster_of(zipped: Path, task: Task) -> None:
    """Checks that a task has the forecaster that a policy was trained on; one that notes none may have any.

    Raises:
        UserError: another forecaster, or other options of the forecasts.
    """
    note, now = read_policy_note(zipped), task.note
    if note is not None and note.forecaster is not None and now.forecaster is not None:
        note.forecaster.check(now.forecaster, f"policy {zipped}")


def require_as_trained(zipped: Path, model: BaseAlgorithm, task: Task) -> None:
    """Checks that a task shows a policy what it was trained on.

    Raises:
        UserError: as `require_forecaster_of`; or forecasts where it saw none, or none where it saw them.
    """
    require_forecaster_of(zipped, task)
    sees, shown = carries_forecasts(model.observation_space), task.observe != "none"
    if sees != shown:
        kind = "sees forecasts" if sees else "sees no forecasts"
        raise UserError(f"policy {zipped} {kind}, but its run's config says observe={task.observe}; copy both together")


def task_of_policy(path: str | Path, device: str = "cpu", sized: bool = True) -> Task:
    """Returns the task of a policy, by the note inside its zip or the config of its run folder.

    Code of a user's own (an environment "module:Id", a forecaster "own:module:name") is imported if the zip names it,
    which is as trusted as code; the config alone imports nothing.

    Args:
        path: policy, or its run folder.
        device: device that runs the forecaster.
        sized: whether the task's observation must have the sizes that the policy was trained with.

    Raises:
        UserError: neither names an environment, this version cannot make it, or only the run folder knows the sizes.
    """
    zipped = policy_zip(path)
    note = read_policy_note(zipped)
    if (zipped.parent / CONFIG_FILE).is_file():
        pin = None if note is None else note.forecaster
        named = (None if note is None else note.env_id, None if pin is None else pin.checkpoint)
        task = task_of(read_config(zipped.parent), device, *named, where=str(zipped.parent / CONFIG_FILE))
        require_env_of(zipped, task)
        return task
    if note is None or not note.env_id:
        policy_file.algorithm_of(zipped)  # has the message for what is no policy at all
        raise UserError(f"{zipped} does not say which environment it drives; pass env=, or the run folder it is from")
    return _task_of_note(note, device, sized)


def require_env_of(zipped: Path, task: Task) -> None:
    """Checks that a policy was trained in the environment of the config beside it, as its note says.

    Raises:
        UserError: it was not, or with other arguments, learners or drivers.
    """
    note = read_policy_note(zipped)
    if note is None or not note.env_id:
        return
    trained, found = note.env_id, task.env_id
    if trained == found:
        driven = {name: (getattr(note, name), getattr(task, name)) for name in ("learners", "driver")}
        arguments = (arguments_of(note.env_kwargs), task.make_kwargs)
        parts = {"env_kwargs": arguments} | (driven if task.is_multiagent else {})
        other = next((name for name, (of_note, of_run) in parts.items() if of_note != of_run), None)
        if other is None:
            return
        trained, found = (f"{task.env_id} with {other} {value or 'none'}" for value in parts[other])
    raise UserError(
        f"{zipped} was trained on {short(trained, 120)}, but {CONFIG_FILE} beside it is that of a run on "
        f"{short(found, 120)}; move the policy into a folder of its own"
    )


def _task_of_note(note: PolicyNote, device: str, sized: bool) -> Task:
    driven = {"device": device, "learners": note.learners, "driver": note.driver, "env_kwargs": note.env_kwargs}
    pin = note.forecaster
    if pin is None:
        return Task(note.env_id, "none", **driven)  # type: ignore[arg-type]
    constant = pin.checkpoint == CONSTANT_VELOCITY and pin.arm == "forecast"
    task = Task(
        note.env_id,
        CONSTANT_VELOCITY if constant else pin.arm,  # type: ignore[arg-type]
        None if constant else pin.checkpoint,
        num_samples=pin.num_samples,
        horizon_steps=pin.horizon_steps,
        perception_m=float("inf") if pin.perception_m is None else pin.perception_m,
        what_if=bool(pin.num_plans),
        **driven,  # type: ignore[arg-type]
    )
    arm = task.options.get("arm")
    if sized and pin.layout is not None and (arm is None or pin.layout != arm.layout):
        raise UserError("the policy was trained with the sizes of another checkpoint (sizes_of); give its run folder")
    return task


def _of_many_agents(path: str, model: BaseAlgorithm, env: ParallelEnv, note: PolicyNote) -> LoadedPolicy:
    driven: Any = DrivenEnv(env, note.driver, learners_named(env.possible_agents, note.learners, f"policy {path}"))
    driven = parallel_env_for_driver(driven, path)
    return LoadedPolicy(_TeamPolicy(path, model, driven, note.learners), driven)


class _TeamPolicy(TrainedPolicy):
    """Acts for all agents of one environment, observations padded as in training."""

    def __init__(self, path: str, model: BaseAlgorithm, env: Any, names: tuple[str, ...]) -> None:
        super().__init__(model, env)
        self._team = ActingTeam(model, env, names, f"policy {path}")

    def __call__(self, observation: Any) -> Any:
        if self._begins():
            self._team.forget()
        seen = {agent: one for agent, one in observation.items() if agent in self._env.agents}
        return self._env.drive_others(seen) | self._team(seen)
