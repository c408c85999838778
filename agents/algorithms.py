"""Models of the learning algorithms: made from a preset, with `ForecastAttention` in front of each of them."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from agents.features import AttentionConfig, ForecastAttention
from agents.plan_scores import PlanAttention, PlanScores, PlanValues
from agents.presets import Algorithm, PPOPreset, Preset, RecurrentPPOPreset
from envs.sb3.algorithms import algorithm_class
from predictor.support.errors import UserError, short

DISCRETE: tuple[Algorithm, ...] = ("dqn", "qrdqn")
"""Algorithms that need discrete actions."""
CONTINUOUS: tuple[Algorithm, ...] = ("sac", "tqc")
"""Algorithms that need continuous actions."""
LOG_INTERVAL: dict[Algorithm, int] = {"ppo": 1, "recurrent-ppo": 1, "a2c": 25}
"""Number of rollouts between lines of the log: a line about every 128 steps; others count episodes."""
LOG_EPISODES = 20
SCORE_PLANS: dict[Algorithm, type] = {"ppo": PlanScores, "a2c": PlanScores, "dqn": PlanValues}
"""Policies of the algorithms that score candidate plans (`agents.plan_scores`); others read them as features."""


def check_actions(algorithm: Algorithm, space: spaces.Space, env_id: str) -> None:
    """Checks that an algorithm supports an action space.

    Raises:
        UserError: it does not.
    """
    if algorithm in DISCRETE and not isinstance(space, spaces.Discrete):
        raise UserError(f"{algorithm} needs a discrete action space, {env_id} has {space}; use ppo")
    if algorithm in CONTINUOUS and not (isinstance(space, spaces.Box) and np.issubdtype(space.dtype, np.floating)):
        raise UserError(f"{algorithm} needs a continuous action space, {env_id} has {space}; use ppo")
    if isinstance(space, spaces.Box) and not np.issubdtype(space.dtype, np.floating):
        raise UserError(f"{algorithm} gives actions with a fraction, {env_id} has {space} of whole numbers; wrap it")
    if isinstance(space, spaces.Box) and not space.is_bounded():
        raise UserError(f"{algorithm} needs bounded actions, {env_id} has {space}; give its action space bounds")
    if not isinstance(space, spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        raise UserError(
            f"{algorithm} needs a Box, Discrete, MultiDiscrete or MultiBinary action space, {env_id} has {space}; "
            "wrap it"
        )
    if isinstance(space, spaces.MultiDiscrete | spaces.MultiBinary) and len(space.shape) != 1:
        raise UserError(f"{algorithm} needs actions in one row, {env_id} has {space}; flatten them")
    if isinstance(space, spaces.Discrete | spaces.MultiDiscrete) and np.any(space.start != 0):
        raise UserError(f"{algorithm} counts actions from 0, {env_id} has {space}; wrap it so that its actions do, too")


def check_observations(space: spaces.Space, env_id: str) -> None:
    """Checks that policies can read an observation space.

    Raises:
        UserError: they cannot.
    """
    for entry in space.spaces.values() if isinstance(space, spaces.Dict) else (space,):
        numbers = isinstance(entry, spaces.Box) and entry.shape and min(entry.shape) > 0
        counted = isinstance(entry, spaces.Discrete | spaces.MultiDiscrete) and len(entry.shape or ()) < 2
        from_zero = counted and not np.any(entry.start)  # type: ignore[attr-defined]
        if not (numbers or from_zero or isinstance(entry, spaces.MultiBinary)):
            found = short(" ".join(str(entry).split()), 100)
            raise UserError(
                "a policy reads arrays (Box), Discrete and MultiDiscrete that count from 0, MultiBinary, and Dicts of "
                f"these, {env_id} has {found}; flatten it, in gymnasium with FlattenObservation"
            )


def log_interval(algorithm: Algorithm) -> int:
    """Returns the number of rollouts (with a replay buffer: of episodes) between lines of the log."""
    return LOG_INTERVAL.get(algorithm, LOG_EPISODES)


def new_model(
    algorithm: Algorithm,
    preset: Preset,
    attention: AttentionConfig,
    venv: VecEnv,
    *,
    plan_actions: Sequence[int] | None = None,
    seed: int,
    device: str = "cpu",
    tensorboard_log: str | None = None,
) -> BaseAlgorithm:
    """Makes a model; Dict observations get a `ForecastAttention` in front of the policy's network.

    Args:
        algorithm: learning algorithm.
        preset: its hyperparameters.
        attention: sizes and scales of the features extractor.
        venv: environments to learn in.
        plan_actions: action with which each candidate plan of the ego begins, for algorithms in `SCORE_PLANS`; None
            where observations have no plans, or plans begin with other actions in other states.
        seed: random seed.
        device: device of the network.
        tensorboard_log: folder of the log; None writes none.

    Raises:
        UserError: the algorithm's package is not installed.
    """
    policy_kwargs = preset.of_policy
    options = {name: value for name, value in asdict(preset).items() if name not in policy_kwargs}
    if isinstance(preset, PPOPreset):
        options["batch_size"] = even_batches(preset.n_steps * venv.num_envs, preset.batch_size)
    kind = "MultiInput" if isinstance(venv.observation_space, spaces.Dict) else "Mlp"
    policy: str | type = f"{kind}LstmPolicy" if isinstance(preset, RecurrentPPOPreset) else f"{kind}Policy"
    extractor = ForecastAttention
    if plan_actions is not None and algorithm in SCORE_PLANS:
        policy, extractor = SCORE_PLANS[algorithm], PlanAttention
        policy_kwargs["plan_actions"] = tuple(plan_actions)
    if kind == "MultiInput":
        policy_kwargs |= {
            "features_extractor_class": extractor,
            "features_extractor_kwargs": {"config": attention},
        }
    make: Any = algorithm_class(algorithm)
    model: BaseAlgorithm = make(
        policy,
        venv,
        policy_kwargs=policy_kwargs,
        tensorboard_log=tensorboard_log,
        seed=seed,
        device=device,
        **options,
    )
    return model


def even_batches(rollout: int, most: int) -> int:
    """Returns the largest batch of at most `most` samples that divides a rollout into equal ones.

    Where that is less than half of `most`, or 1, the last batch is a smaller one instead, of two samples or more: one
    has no spread, by which recurrent PPO divides its advantages. A batch is larger than `most` where no other does.
    """
    even = next(rollout // count for count in range(-(-rollout // most), rollout + 1) if rollout % count == 0)
    if even > 1 and 2 * even >= most:
        return even
    sizes = (*range(min(rollout, most), 1, -1), *range(most + 1, rollout + 1))
    return next((size for size in sizes if rollout % size != 1), min(rollout, most))


def check_learns(preset: Preset, algorithm: Algorithm, steps: int) -> None:
    """Checks that an algorithm makes an update within so many environment steps.

    Raises:
        UserError: it does not.
    """
    first = getattr(preset, "learning_starts", 0)
    if first >= steps:
        raise UserError(
            f"{algorithm} makes its first update after learning_starts={first:,} steps, so {steps:,} steps teach it "
            "nothing; take more steps, or lower learning_starts"
        )
    between = getattr(preset, "train_freq", 1)
    if between > steps:
        raise UserError(
            f"{algorithm} makes an update every train_freq={between:,} steps of each environment, so {steps:,} steps "
            "teach it nothing; take more steps, or lower train_freq"
        )


class DivergedError(UserError):
    """A training whose weights are no longer finite."""


def check_finite(model: BaseAlgorithm) -> None:
    """Checks that the weights of a policy are numbers.

    Raises:
        DivergedError: they are not.
    """
    if not all(bool(weights.isfinite().all()) for weights in model.policy.parameters()):
        raise DivergedError(
            f"the policy's weights are not finite after {model.num_timesteps:,} steps: its training diverged; "
            "scale rewards and observations of many thousands down, or lower learning_rate"
        )
