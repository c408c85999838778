"""Trains an SB3 policy: preset, parallel environments, model selection on separate seeds, resumable checkpoints.

`policy.zip` is the model with the highest mean return on the selection seeds, of equal ones the latest. Those seeds are
disjoint from training and from the final evaluation, so selection does not bias the final numbers.
"""

import contextlib
import math
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.vec_env import VecEnv

from agents.algorithms import check_actions, check_finite, check_learns, check_observations, log_interval, new_model
from agents.arena import Arena, open_arena
from agents.features import AttentionConfig
from agents.forecast_errors import ForecastErrors
from agents.plan_scores import plan_actions
from agents.preset_settings import changed
from agents.presets import Algorithm, Preset, preset_for
from agents.runs import BEST_FILE, CHECKPOINT_FILE, CURVE_FILE, POLICY_FILE, load_model, read_curve, save_model
from agents.step_count import CountSteps, StepProgress
from agents.summaries import mean_of_known
from agents.task import SELECTION_SEED, Task
from agents.vec_envs import EpisodeResult, make_venv
from envs.sb3.algorithms import require_algorithm
from envs.sb3.policy_file import PolicyNote, check_whole, read_note, selection_return
from predictor.support.config_checks import check_at_least, check_fields
from predictor.support.errors import UserError
from predictor.support.files import copy_file, write_json
from predictor.support.runtime import resolve_device


@dataclass(frozen=True)
class TrainingPlan:
    """Settings of a training run."""

    task: Task
    """Environment and what the policy sees."""
    algorithm: Algorithm
    """Learning algorithm."""
    steps: int
    """Number of environment steps, over all environments; a step of a copy is one, however many agents learn."""
    num_envs: int
    """Number of parallel environments."""
    seed: int
    """Random seed for torch, NumPy and the environments."""
    device: str = "cpu"
    """Device that runs the policy's network: cpu, cuda or auto."""
    selections: int = 8
    """Number of times that the policy is measured on the selection seeds, evenly spread as far as its updates allow: a
    measurement comes after an update, and the last one after the last."""
    selection_episodes: int = 20
    """Number of episodes per measurement; all measurements use the same seeds."""
    selection_envs: int = 2
    """Number of parallel environments that measure the policy."""
    checkpoint_every: int = 2_000
    """Number of environment steps between checkpoints."""
    in_process: bool = False
    """Whether all environments run in the process that trains, for several trainings side by side."""
    repeatable: bool = False
    """Whether a run that was stopped and resumed equals one that was not: environments and random streams then start
    anew at every checkpoint. Episodes end there, so `checkpoint_every / num_envs` should be well above their length."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Hyperparameters in place of the preset's."""
    shaping: bool = True
    """Whether to learn from shaped rewards where those of the environment are rare (`agents.shaping`)."""

    def __post_init__(self) -> None:
        """Checks choices and ranges; replaces `device="auto"` by the device that is taken."""
        check_fields(self)
        check_at_least(
            self, 1, "steps", "num_envs", "selections", "selection_episodes", "selection_envs", "checkpoint_every"
        )
        if not 0 <= self.seed < SELECTION_SEED:
            raise UserError(f"seed must lie in [0, {SELECTION_SEED}), got {self.seed}")
        object.__setattr__(self, "device", resolve_device(self.device))
        require_algorithm(self.algorithm)
        check_learns(self.preset, self.algorithm, self.steps)

    @property
    def preset(self) -> Preset:
        """Hyperparameters of the algorithm for the task's environment, with the plan's settings."""
        preset = preset_for(self.task.env_id, self.algorithm, self.task.backend)
        return changed(preset, self.settings, self.algorithm)

    @property
    def attention(self) -> AttentionConfig:
        """Sizes and scales of the features extractor; the scales fit the task's scenes."""
        spec = self.task.scene_spec
        return AttentionConfig() if spec is None else AttentionConfig.for_scenes(spec)

    def check_spaces(self, observations: spaces.Space, actions: spaces.Space) -> None:
        """Checks that a policy can read an observation space, and that the algorithm supports an action space.

        Raises:
            UserError: one of them does not fit.
        """
        check_observations(observations, self.task.env_id)
        check_actions(self.algorithm, actions, self.task.env_id)


def train(plan: TrainingPlan, run_dir: Path, progress_bar: bool = True) -> Path:
    """Trains until `plan.steps`, from the checkpoint in `run_dir` if there is one.

    A run that has its policy but no checkpoint any more is finished: nothing is trained.

    Args:
        plan: settings of the training.
        run_dir: folder of the run, which exists.
        progress_bar: whether to show how far it is, and each measurement.

    Returns:
        Path of the final policy, `run_dir/policy.zip`.
    """
    policy = run_dir / POLICY_FILE
    if policy.exists() and not (run_dir / CHECKPOINT_FILE).exists():
        return policy  # made at the end, when the checkpoint is needed no more
    note = plan.task.note  # loads the forecaster, which draws random numbers: before the model is seeded
    venv = make_venv(plan.task, plan.num_envs, in_process=plan.in_process or None, shaping=plan.shaping)
    # a process may have but one simulator of someone else's, and that is the one that trains
    beside = True if plan.in_process else False if ":" in plan.task.env_id else None
    with contextlib.ExitStack() as opened:
        opened.callback(venv.close)
        selection = open_arena(plan.task, min(plan.selection_envs, plan.selection_episodes), beside)
        opened.callback(selection.close)
        model = _resume_or_make(plan, venv, run_dir)
        learns = model.num_timesteps < plan.steps
        if learns:
            _learn(plan, model, selection, run_dir, note, progress_bar)
            save_model(model, run_dir / CHECKPOINT_FILE, note=note, to_continue=True)
    if (run_dir / BEST_FILE).exists():
        selection_return(run_dir / BEST_FILE)  # refuses a damaged file
        copy_file(run_dir / BEST_FILE, policy)
    elif learns or not policy.exists():  # it was damaged, and removed as the message says; the last model stands for it
        save_model(model, policy, note=note)
    return policy


def _learn(
    plan: TrainingPlan, model: BaseAlgorithm, selection: Arena, run_dir: Path, note: PolicyNote, progress_bar: bool
) -> None:
    """Trains for the remaining steps."""
    every = Fraction(plan.steps, plan.selections)  # of floats, a multiple may be missed
    checkpoint = run_dir / CHECKPOINT_FILE
    kept = read_note(checkpoint)
    errors, progress = ForecastErrors(kept.get("loop_errors")), StepProgress(plan.steps, plan.num_envs)
    restart = partial(_restart_streams, plan, model, errors) if plan.repeatable else None
    select = SelectBest(
        selection,
        run_dir / BEST_FILE,
        plan.selection_episodes,
        every,
        note,
        curve=run_dir / CURVE_FILE,
        seconds=kept.get("seconds", 0.0),
        scalars=errors.scalars,
        say=progress.say,
    )

    def extra() -> dict[str, Any]:
        return {"seconds": select.seconds, "loop_errors": errors.sums()}

    also = bool if plan.repeatable else select.has_kept  # what is not repeated goes on where the best model is its own
    save = SaveCheckpoint(checkpoint, plan.checkpoint_every, note, extra, restart, also)
    callbacks = [CountSteps(plan.num_envs), errors, select, save, *([progress] if progress_bar else [])]
    try:
        model.learn(
            plan.steps - model.num_timesteps,
            callback=CallbackList(callbacks),
            tb_log_name="run",
            reset_num_timesteps=model.num_timesteps == 0,
            log_interval=log_interval(plan.algorithm),
        )
    except ValueError:  # SB3's own, of a distribution that is none
        check_finite(model)
        raise
    finally:
        progress.close()


def make_model(plan: TrainingPlan, venv: VecEnv, tensorboard_log: str | None = None) -> BaseAlgorithm:
    """Makes a new model with the plan's preset; Dict observations get a `ForecastAttention` in front."""
    return new_model(
        plan.algorithm,
        plan.preset,
        plan.attention,
        venv,
        plan_actions=plan_actions(plan.task) if plan.task.what_if else None,
        seed=plan.seed,
        device=plan.device,
        tensorboard_log=tensorboard_log,
    )


def _resume_or_make(plan: TrainingPlan, venv: VecEnv, run_dir: Path) -> BaseAlgorithm:
    logs, checkpoint = str(run_dir / "tb"), run_dir / CHECKPOINT_FILE
    if checkpoint.exists():
        ended = (run_dir / POLICY_FILE).exists()
        anew = f"remove it to train anew; copy {BEST_FILE} first, if it is there: the best policy so far"
        check_whole(checkpoint, f"remove it: the training has ended, with {POLICY_FILE}" if ended else anew)
        model = load_model(checkpoint, plan.algorithm, venv, plan.device)
        model.tensorboard_log = logs  # the folder may have moved
    else:
        model = make_model(plan, venv, logs)
    _seed_from_steps(plan, model)
    return model


def _seed_from_steps(plan: TrainingPlan, model: BaseAlgorithm) -> None:
    """Seeds a model for the episodes from its current step on: a function of step and plan's seed.

    Environments get this seed and those that follow it. Were it the plan's own, runs of neighbouring seeds would see
    the same episodes, all but one of 64.
    """
    fresh = np.random.SeedSequence([plan.seed, model.num_timesteps]).generate_state(1)[0]
    model.set_random_seed(int(fresh) % (SELECTION_SEED - plan.num_envs))


def _restart_streams(plan: TrainingPlan, model: BaseAlgorithm, errors: ForecastErrors) -> None:
    """Puts a running training where a resumed one begins: random streams of its step, environments reset."""
    assert model.env is not None
    _seed_from_steps(plan, model)
    model._last_obs = model.env.reset()  # type: ignore[assignment]
    model._last_episode_starts = np.ones(model.env.num_envs, dtype=bool)
    errors.begin()


class SaveCheckpoint(BaseCallback):
    """Keeps the latest model on disk, taken between updates so that no collected step is lost or counted twice."""

    def __init__(
        self,
        path: Path,
        every_steps: int,
        note: PolicyNote | None = None,
        extra: Callable[[], dict[str, Any]] = dict,
        after: Callable[[], None] | None = None,
        also: Callable[[], bool] = bool,
    ) -> None:
        """Saves to `path` about every `every_steps` steps and if `also`, with note and `extra`; then calls `after`."""
        super().__init__()
        self._note = note
        self._path, self._every = path, every_steps
        self._extra, self._after, self._also = extra, after, also
        self._saved_at = 0

    def _on_training_start(self) -> None:
        self._saved_at = self.model.num_timesteps

    def _on_rollout_start(self) -> None:
        if self.model.num_timesteps - self._saved_at >= self._every or self._also():
            self._saved_at = self.model.num_timesteps
            save_model(self.model, self._path, self._extra(), self._note, to_continue=True)
            if self._after is not None:
                self._after()

    def _on_step(self) -> bool:
        return True


class SelectBest(BaseCallback):
    """Keeps the model with the highest mean return so far, of equal ones the latest, with its result inside.

    Over few episodes that mean is higher than what the model returns elsewhere, as it is the highest of several noisy
    ones.

    Measurements are made between updates and at the end, so that all that was collected has been learned from. In the
    list of callbacks they stand before `SaveCheckpoint`, whose file then has them.

    Args:
        arena: arena that plays the same seeds at each measurement.
        path: path of the selected model, written atomically.
        num_episodes: number of episodes per measurement.
        every_steps: number of environment steps at whose multiples a measurement is due, at the next update; there is
            always one at the end.
        note: what the policy needs beside its weights.
        curve: path of a JSON file with a line per measurement, written atomically; None writes none.
        seconds: time that was learned before this start [s].
        scalars: called at each measurement; what it returns stands in TensorBoard and in the curve.
        say: called with a line on each measurement.
    """

    def __init__(
        self,
        arena: Arena,
        path: Path,
        num_episodes: int,
        every_steps: float | Fraction,
        note: PolicyNote | None = None,
        *,
        curve: Path | None = None,
        seconds: float = 0.0,
        scalars: Callable[[], dict[str, float]] = dict,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        """Prepares the measurements; none is made yet."""
        super().__init__()
        self._note = note
        self._arena, self._path, self._every = arena, path, every_steps
        self._curve, self._learned_s = curve, seconds
        self._scalars, self._say = scalars, say
        self._seeds = range(SELECTION_SEED, SELECTION_SEED + num_episodes)
        self._measured_at, self._kept_at = 0, -1
        self._highest = -math.inf
        self._points: list[dict[str, Any]] = []
        self._seen: set[str] = set()
        self._since = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Time that was learned, without measurements [s]."""
        return self._learned_s + time.perf_counter() - self._since

    def has_kept(self) -> bool:
        """Returns whether the model as it is now was measured and kept."""
        return self._kept_at == self.model.num_timesteps

    def _on_training_start(self) -> None:
        """Continues from the results inside an existing file."""
        self._measured_at = begun = self.model.num_timesteps
        stored = selection_return(self._path)  # with nothing to go on from, it is that of another training
        self._highest = stored if begun else -math.inf
        if self._curve is not None:
            self._points = [p for p in read_curve(self._curve) if p["steps"] <= begun]
            self._measured_at = self._points[-1]["steps"] if self._points else 0
        self._since = time.perf_counter()

    def _on_rollout_start(self) -> None:
        if self.num_timesteps // self._every > self._measured_at // self._every:
            self._measure()

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        if self._measured_at != self.num_timesteps:
            self._measure()

    def _measure(self) -> None:
        """Plays the seeds, keeps the model unless an earlier one is better, and adds a point to the curve.

        Raises:
            DivergedError: the weights are not finite; algorithms that learn values go on with those unnoticed.
        """
        check_finite(self.model)
        self._measured_at, self._learned_s = self.num_timesteps, self.seconds
        results = self._arena.play(self.model, self._seeds)
        mean, scalars = float(np.mean([r.episode_return for r in results])), self._scalars()
        for name, value in scalars.items():
            self.logger.record(f"loop/{name}", value)
        self._keep(results, mean)
        said = f"return {mean:.2f} over {len(results)} episodes (best {self._highest:.2f})"
        self._say(f"step {self.num_timesteps:,}: {said}")
        if self._curve is not None:
            point = {"steps": self.num_timesteps, "return": mean, "episodes": len(results), "seconds": self._learned_s}
            self._points.append(point | scalars)
            write_json(self._curve, self._points)
        self._since = time.perf_counter()

    def _keep(self, results: Sequence[EpisodeResult], mean: float) -> None:
        self.logger.record("eval/mean_reward", mean)
        self.logger.record("eval/mean_ep_length", float(np.mean([r.length for r in results])))
        scalars = driving_scalars(results)
        self._seen |= {name for name in scalars if name == "crash_rate" or name.startswith("share_")}
        for name, value in (dict.fromkeys(self._seen, 0.0) | scalars).items():  # what no longer happens is drawn as 0
            self.logger.record(f"eval/{name}", value)
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)
        if mean < self._highest:
            return
        self._highest = mean
        extra = {"selection_return": mean, "steps": self.num_timesteps}
        save_model(self.model, self._path, extra, self._note)
        self._kept_at = self.num_timesteps


def driving_scalars(results: Sequence[EpisodeResult]) -> dict[str, float]:
    """Returns what TensorBoard shows of episodes beside their returns: crash rate, speed [m/s], share of each action.

    What an environment does not report is left out.
    """
    scalars: dict[str, float] = {}
    if any(r.crashed is not None for r in results):  # some environments report a crash only when it happens
        scalars["crash_rate"] = float(np.mean([bool(r.crashed) for r in results]))
    speed_mps = mean_of_known([r.mean_speed_mps for r in results])
    if not math.isnan(speed_mps):
        scalars["speed_mps"] = speed_mps
    actions = sum((Counter(r.action_counts) for r in results), Counter())
    return scalars | {f"share_{name}": count / actions.total() for name, count in sorted(actions.items())}
