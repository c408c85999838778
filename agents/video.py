"""Films an episode of a trained policy, with the forecasts drawn in."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm

from agents.summaries import EXTREMES
from agents.task import EVALUATION_SEED, NO_CHECKPOINT, Task
from agents.vec_envs import EpisodeResult, MakeCopy
from envs.own_observation import without_added
from envs.parallel import ForecastParallelEnv
from envs.readers.highway import HighwayReader, is_highway_env
from envs.registry import entry_for
from envs.sb3.acting import ActingPolicy, ActingTeam
from envs.simulators.envpool import ENV_IDS, HIGHWAY_ENV_OF
from envs.video.film import Film
from envs.video.film_forecasts import FilmForecasts, record_pictures, view_of
from envs.video.highway import record_episode
from envs.video.multiagent import MultiagentRecording, record_multiagent_episode
from predictor.checkpoint import CONSTANT_VELOCITY
from predictor.forecaster import Forecaster, has_scale
from predictor.support.errors import UserError

FAN = 6
"""Number of futures that are drawn of a forecaster with modes."""
MAX_VIDEO_STEPS = 200
"""Maximum length of a video [policy steps]; a racetrack episode has 1500."""


def record_task(task: Task, policy: BaseAlgorithm, seed: int, max_steps: int) -> MultiagentRecording | None:
    """Plays one episode for a film; forecasts are drawn also for a policy that sees none.

    Returns:
        The recording; None if no reader is registered for the environment.
    """
    filmed = _with_forecasts(task)
    if filmed is None:
        return None
    env = MakeCopy(filmed)()
    assert isinstance(env, ForecastParallelEnv)
    try:
        team = ActingTeam(policy, env, task.learners, "the policy")

        def act(observations: dict[str, Any]) -> dict[str, Any]:
            others: dict[str, Any] = env.drive_others(observations)
            return others | team(observations)

        return record_multiagent_episode(
            env, act, seed=seed, max_steps=max_steps, num_samples=_num_drawn(env.forecaster)
        )
    finally:
        env.close()


def _num_drawn(forecaster: Forecaster) -> int:
    """Returns the number of futures drawn per agent: several only if they come with probabilities."""
    return FAN if has_scale(forecaster) else 1


def _with_forecasts(task: Task) -> Task | None:
    """Returns the task with forecasts to draw, those of the policy if it sees any; None where no reader is registered.

    Else they are those that ship, or of constant velocity where these do not fit the environment.
    """
    if task.observe != "none":
        return task
    for checkpoint in (None, CONSTANT_VELOCITY):
        shown = replace(task, observe="forecast", checkpoint=checkpoint)
        try:
            if shown.scene_spec is not None:
                return shown
        except UserError:
            continue
    return None


def film(
    task: Task, model: BaseAlgorithm, path: Path, seed: int = EVALUATION_SEED, max_steps: int | None = None
) -> Path | None:
    """Films an evaluation episode with the forecasts drawn in, also for a policy that sees none.

    Args:
        task: environment and what the policy sees.
        model: the policy.
        path: path of the video to write.
        seed: seed of the episode; the default is the first one's.
        max_steps: largest number of policy steps; None takes `MAX_VIDEO_STEPS`.

    Returns:
        `path`; None if the environment cannot be drawn.
    """
    recording = recorded(task, model, seed, max_steps)
    if recording is None:
        return None
    recording.write_video(path)
    return path


def _in_highway_env(task: Task) -> Task:
    """Returns the task in highway-env's environment; checkpoint and sizes stay those of EnvPool's id."""
    shipped = entry_for(task.env_id).checkpoint
    return replace(
        task,
        env_id=HIGHWAY_ENV_OF[ENV_IDS[task.env_id]],
        checkpoint=None if task.observe in NO_CHECKPOINT else task.checkpoint or shipped,
        sizes_of=task.sizes_of if task.observe in ("none", "forecast") else task.sizes_of or shipped,
    )


def recorded(
    task: Task, model: BaseAlgorithm, seed: int = EVALUATION_SEED, max_steps: int | None = None
) -> Film | None:
    """Plays an episode of `film` and returns it; None if the environment cannot be drawn.

    An id of EnvPool is played in the environment of highway-env that it is a copy of.
    """
    max_steps = MAX_VIDEO_STEPS if max_steps is None else max_steps
    if task.is_multiagent:
        return record_task(task, model, seed, max_steps)
    if task.env_id in ENV_IDS and not task.make_kwargs:
        task = _in_highway_env(task)
    plain = task.make()
    highway, drawn = is_highway_env(plain), view_of(plain) is not None
    plain.close()
    if not highway and not drawn:
        return None
    shown = _with_forecasts(task)
    if shown is None:
        return None
    env = shown.wrapped(_with_pictures(task))
    act, samples = _act(task, model), _num_drawn(env.forecaster)
    try:
        if drawn or not isinstance(env.get_wrapper_attr("reader"), HighwayReader):
            return record_pictures(
                FilmForecasts(env, num_samples=samples, crash_key=task.crash_key), act, seed=seed, max_steps=max_steps
            )
        return record_episode(env, act, seed=seed, max_steps=max_steps, num_samples=samples)
    finally:
        env.close()


def _with_pictures(task: Task) -> Any:
    """Makes the environment with pictures, where it has such a render mode."""
    env = task.make()
    if "rgb_array" not in (env.metadata or {}).get("render_modes", []):
        return env
    env.close()
    return task.make(render_mode="rgb_array")


def film_extremes(
    task: Task, model: BaseAlgorithm, episodes: Sequence[EpisodeResult], folder: Path
) -> dict[str, dict[str, Any]]:
    """Films the best, the median and the worst of a policy's episodes by return, as ``best.mp4`` and so on.

    Args:
        task: environment and what the policy sees.
        model: the policy.
        episodes: results of the policy's episodes, at least one. Of an even number the lower median is taken; equal
            returns are in the order of the seeds.
        folder: folder of the videos.

    Returns:
        Seed, return and file of each film; empty if the environment cannot be drawn, and for EnvPool's ids, whose
        episodes highway-env, which draws, does not have.
    """
    if task.env_id in ENV_IDS:
        return {}
    by_return = sorted(episodes, key=lambda episode: episode.episode_return)
    places = dict(zip(EXTREMES, (-1, (len(by_return) - 1) // 2, 0), strict=True))
    films: dict[str, dict[str, Any]] = {}
    for name, place in places.items():
        episode, path = by_return[place], folder / f"{name}.mp4"
        if film(task, model, path, episode.seed) is not None:
            films[name] = {"seed": episode.seed, "return": episode.episode_return, "file": path.name}
    return films


def _act(task: Task, model: BaseAlgorithm) -> Callable[[Any], Any]:
    acting = ActingPolicy(model)

    def act(obs: dict[str, Any]) -> Any:
        return acting(without_added(obs) if task.observe == "none" else obs)

    return act
