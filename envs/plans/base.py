"""Interface of plan models, and what they return."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from numbers import Real
from types import SimpleNamespace
from typing import Any, Protocol, cast, runtime_checkable

import gymnasium as gym
import numpy as np
from jaxtyping import Bool, Float

from predictor.scene import Scene, SceneSpec
from predictor.support.errors import UserError, short
from predictor.support.signatures import takes


@dataclass(frozen=True)
class Plans:
    """Candidate plans of an ego, as if it were alone; rewards are needed by the planner only."""

    states: Float[np.ndarray, "plans horizon state"]
    """State of the ego at each of the next policy steps, in the world frame and the units of its scenes."""
    actions: tuple[Any, ...]
    """Action with which each plan begins."""
    rewards: Float[np.ndarray, "plans horizon"] | None = None
    """Reward of each step without a collision."""
    crash_rewards: Float[np.ndarray, "plans horizon"] | None = None
    """Reward of each step if the ego collides in it; the episode then ends. None takes 0."""
    crashed: Bool[np.ndarray, "plans horizon"] | None = None
    """Whether the ego has collided with a fixed obstacle by each step; None takes False."""
    size_m: tuple[float, float] = (5.0, 2.0)
    """Length and width of every agent [m], with which collisions are found; default: highway-env's vehicles."""
    margin_m: float = 0.0
    """Gap below which the planner counts a contact [m]: what straight moves between steps leave out."""
    later_actions: tuple[tuple[Any, ...], ...] | None = None
    """Actions of each plan's steps after the first; needed to play plans in a simulator (`envs.evaluate --plans`)."""
    true_xy: Float[np.ndarray, "played agents horizon 2"] | None = None
    """Positions of all agents of the scene if a plan is played [m], world frame (`envs.plans.playing`)."""


@runtime_checkable
class PlanModel(Protocol):
    """Proposes plans for the ego of a running environment, always as many; the mildest first, since it wins ties."""

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each plan."""

    def plans(self, env: gym.Env, horizon_steps: int) -> Plans:
        """Returns the plans from the environment's present state, which it must not change."""


def checked_model(model: Any, demand: str = "what_if must be True, False,") -> PlanModel:
    """Returns what was given as a plan model.

    Args:
        model: what was given.
        demand: beginning of the sentence that says what is needed.

    Raises:
        UserError: it is none, or its plans have no names, or the same ones.
    """
    if isinstance(model, type):
        raise UserError(f"{demand} or an object with names and plans, got a class: write {model.__name__}()")
    if not callable(getattr(model, "plans", None)) or not hasattr(model, "names"):
        raise UserError(
            f"{demand} or an object with names and plans(env, horizon_steps), got {model!r}; see docs/what_if.md"
        )
    if not takes(model.plans, None, 1):
        raise UserError(f"plans of plan model {type(model).__name__} must take an environment and horizon_steps")
    names = model.names
    if not isinstance(names, tuple | list) or not all(isinstance(name, str) for name in names) or not names:
        raise UserError(f"names of plan model {type(model).__name__} must be texts, one or more, got {names!r}")
    if len(set(names)) != len(names):
        raise UserError(f"names of plan model {type(model).__name__} must be different, got {names!r}")
    return cast(PlanModel, model)


def checked_plans(
    model: PlanModel,
    env: gym.Env,
    horizon_steps: int,
    num_features: int,
    scene: Scene | None = None,
    spec: SceneSpec | None = None,
) -> Plans:
    """Returns the plans of a model, after checking them.

    Args:
        model: plan model.
        env: environment that was reset.
        horizon_steps: number of steps of a plan.
        num_features: number of features of a state.
        scene: present scene of the environment's reader; with its `spec`, plans have to begin near its ego.
        spec: layout of the scene.

    Raises:
        UserError: plans of another shape, not finite numbers, not one action for each plan and step, no size, other
            actions than the model names, or far from the ego, as in a frame with another origin.
    """
    proposed, count = model.plans(env, horizon_steps), len(model.names)
    source = f"plan model {type(model).__name__}"
    if not hasattr(proposed, "states") or not hasattr(proposed, "actions"):
        raise UserError(f"{source}: plans must give Plans (envs.plans), got {type(proposed).__name__}")
    plans = _with_arrays(proposed, source)
    wanted = {
        "states": (count, horizon_steps, num_features),
        "rewards": (count, horizon_steps),
        "crash_rewards": (count, horizon_steps),
        "crashed": (count, horizon_steps),
    }
    for name, shape in wanted.items():
        values = getattr(plans, name)
        if values is None and name != "states":
            continue
        if np.shape(values) != shape:
            raise UserError(f"{source}: {name} need the shape {shape}, got {np.shape(values)}")
        if np.asarray(values).dtype.kind not in "fiub":
            raise UserError(f"{source}: {name} must be numbers, got {np.asarray(values).dtype}")
        if not np.isfinite(values).all():
            raise UserError(f"{source}: {name} must be finite, got NaN or infinity")
    if plans.crashed is not None and plans.crashed.dtype != np.bool_:
        raise UserError(f"{source}: crashed must be true or false (dtype bool), got {plans.crashed.dtype}")
    if count < 1 or len(plans.actions) != count:
        raise UserError(f"{source}: each of its {count} plans needs one action, got {len(plans.actions)}")
    try:
        size = np.asarray(plans.size_m)
    except ValueError:  # ragged
        size = np.zeros(0)
    if size.shape != (2,) or size.dtype.kind not in "fiu" or not (np.isfinite(size) & (size > 0)).all():
        raise UserError(f"{source}: size_m must be length and width [m], positive numbers, got {short(plans.size_m)}")
    fixed = getattr(model, "actions", None)  # with which policies that score plans choose
    if fixed is not None and not _same(fixed, plans.actions):
        raise UserError(
            f"{source}: its attribute actions must be those of its plans, in the same order, got {short(fixed, 100)} "
            f"and plans that begin with {short(plans.actions, 100)}; leave it out where they change"
        )
    if not isinstance(plans.margin_m, Real) or not 0 <= float(plans.margin_m) < np.inf:
        raise UserError(f"{source}: margin_m must be finite and at least 0, got {plans.margin_m}")
    later = None if plans.later_actions is None else [_length(actions) for actions in plans.later_actions]
    if later not in (None, [horizon_steps - 1] * count):
        raise UserError(f"{source}: later_actions need {horizon_steps - 1} for each of {count} plans, got {later}")
    if scene is not None and spec is not None:
        _check_begin(plans.states, scene, spec, source)
    return Plans(**vars(plans))


def _with_arrays(plans: Any, source: str) -> SimpleNamespace:
    """Returns the fields of `Plans` with arrays where a model gave lists, and tuples of actions; no shape is checked.

    Raises:
        UserError: rows of unequal length, or actions that cannot be counted.
    """
    given: dict[str, Any] = {field.name: getattr(plans, field.name, field.default) for field in fields(Plans)}
    for name in ("states", "rewards", "crash_rewards", "crashed"):
        if given[name] is not None:
            try:
                given[name] = np.array(given[name])  # a copy: a model may fill one array again
            except ValueError as error:
                raise UserError(f"{source}: {name} must be an array: {error}") from error
    for name in ("actions", "later_actions"):
        if given[name] is not None or name == "actions":
            try:
                given[name] = tuple(given[name])
            except TypeError as error:
                raise UserError(f"{source}: {name} must be one for each plan, got {short(given[name], 100)}") from error
    return SimpleNamespace(**given)


def _same(fixed: Any, actions: tuple[Any, ...]) -> bool:
    """Returns whether these are the actions of plans."""
    return _length(fixed) == len(actions) and all(_equal(one, other) for one, other in zip(fixed, actions, strict=True))


def _length(actions: Any) -> int:
    """Returns the number of actions; 1 of what is no sequence."""
    return len(actions) if isinstance(actions, Sequence) or np.ndim(actions) else 1


def _equal(one: Any, other: Any) -> bool:
    """Returns whether two actions are equal; those of Tuple and Dict spaces part by part."""
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(_equal(one[key], other[key]) for key in one)
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(map(_equal, one, other))
    return np.array_equal(one, other)


def _check_begin(states: Float[np.ndarray, "plans horizon state"], scene: Scene, spec: SceneSpec, source: str) -> None:
    """Raises if no plan begins near the ego: a few of its steps, and some slack at the scale of the scene."""
    axes = spec.position_dim
    ego = scene.states[0]
    away_m = np.linalg.norm(states[:, 0, :axes] - ego[:axes], axis=-1)
    steps_m = np.linalg.norm(np.diff(states[..., :axes], axis=1), axis=-1).max(initial=0.0)
    reach_m = max(steps_m, spec.dt_s * float(np.linalg.norm(ego[axes : 2 * axes])))
    if away_m.min() > 3 * reach_m + 0.1 * max(spec.feature_scales[:axes]):
        first = states[away_m.argmin(), 0, :axes]
        raise UserError(
            f"{source}: plans must begin at the ego, in the frame of the reader; after a step the nearest is "
            f"{away_m.min():.3g} m from it, got {first.tolist()} for an ego at {ego[:axes].tolist()}"
        )
