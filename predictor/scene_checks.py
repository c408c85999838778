"""Checks of batches of scenes and of what is asked of a forecast, cheap enough for every step."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from predictor.scene import LARGEST, PADDING_ID, SceneBatch, SceneSpec
from predictor.support.errors import UserError, short
from predictor.support.memory import check_memory

COARSEST = 5e-4
"""Largest distance between neighbouring numbers of float32 at positions, as a share of their scale."""
MOST_STEPS = 100_000
"""Largest number of steps of a forecast."""
_KINDS = {
    "states": ("f", "floating point"),
    "ids": ("iu", "integers"),
    "valid": ("b", "bool"),
    "heading_rad": ("fiu", "numbers"),
}


def check_batch(scenes: SceneBatch, envs: int, agents: int, features: int) -> None:
    """Checks types and shapes of a batch of scenes, and that its headings are finite; no other value is read.

    Args:
        scenes: batch.
        envs: required number of scenes.
        agents: required number of agents of each, padding included.
        features: required number of features of an agent.

    Raises:
        UserError: they do not fit.
    """
    for name, (kinds, wanted) in _KINDS.items():
        array = getattr(scenes, name)
        if not isinstance(array, np.ndarray) or array.dtype.kind not in kinds:
            got = f"{array.dtype}" if isinstance(array, np.ndarray) else type(array).__name__
            raise UserError(f"{name} of scenes must be a NumPy array of {wanted}, got {got}")
        shape = {"states": (envs, agents, features), "heading_rad": (envs,)}.get(name, (envs, agents))
        if array.shape != shape:
            raise UserError(f"{name} of {envs} scenes must have the shape {shape}, got {array.shape}")
    if not np.isfinite(scenes.heading_rad).all():
        scene = int(np.flatnonzero(~np.isfinite(scenes.heading_rad))[0])
        raise UserError(f"heading_rad of scenes must be finite, got {scenes.heading_rad[scene]} (scene {scene})")


def check_states(states: Float[np.ndarray, "envs agents state"]) -> None:
    """Checks that the states of all agents are finite, in float32 too; those of absent agents must be zeros here.

    Raises:
        UserError: some are not.
    """
    if not (np.abs(states) <= LARGEST).all():
        scene, agent, _ = np.argwhere(~(np.abs(states) <= LARGEST))[0].tolist()
        wanted = f"at most {LARGEST:g} in size" if np.isfinite(states).all() else "finite"
        raise UserError(f"states must be {wanted}, got {states[scene, agent].tolist()} (scene {scene}, agent {agent})")


def check_resolution(states: Float[np.ndarray, "... state"], spec: SceneSpec, where: str) -> None:
    """Checks that float32 keeps positions well enough for motion to be seen in them: not those of a country's map.

    Args:
        states: states, zeros where no agent is.
        spec: layout of the states.
        where: what they are of, for the message.

    Raises:
        UserError: they are too far from zero.
    """
    farthest = np.abs(states[..., : spec.position_dim]).max(axis=tuple(range(states.ndim - 1)), initial=0.0)
    step = np.spacing(farthest.astype(np.float32))
    share = step / np.asarray(spec.feature_scales[: spec.position_dim])
    if (share > COARSEST).any():
        axis = int(share.argmax())
        raise UserError(
            f"{where}: {spec.feature_names[axis]} lies up to {farthest[axis]:.8g} from zero, where float32 has steps "
            f"of {step[axis]:.2g}; subtract one fixed point of the map from all positions"
        )


def check_ids(ids: Int[np.ndarray, "envs agents"], valid: Bool[np.ndarray, "envs agents"]) -> None:
    """Checks that the ids of the agents of each scene are different and not negative.

    Args:
        ids: ids, `PADDING_ID` where `valid` is not.
        valid: which entries hold an agent.

    Raises:
        UserError: they are not.
    """
    if (ids < 0)[valid].any():
        raise UserError(f"ids of valid agents must be non-negative, got {int(ids[valid].min())}")
    ordered = np.sort(ids, axis=1)
    twice = (ordered[:, 1:] == ordered[:, :-1]) & (ordered[:, 1:] != PADDING_ID)
    if twice.any():
        scene, place = np.argwhere(twice)[0].tolist()
        raise UserError(f"ids must be unique within a scene, got {int(ordered[scene, place])} twice (scene {scene})")


def check_request(horizon_steps: object, num_samples: object, values_each: int) -> None:
    """Checks how many steps and samples of a forecast are asked for.

    Args:
        horizon_steps: number of steps.
        num_samples: number of samples.
        values_each: number of values of a step of one sample, for the estimate of memory.

    Raises:
        UserError: one is no whole number from 1 on, or the forecast cannot fit into the memory.
    """
    for name, value in (("horizon_steps", horizon_steps), ("num_samples", num_samples)):
        if not isinstance(value, int | np.integer) or value < 1:
            raise UserError(f"{name} must be a whole number of at least 1, got {value!r}")
    assert isinstance(horizon_steps, int | np.integer) and isinstance(num_samples, int | np.integer)
    if horizon_steps > MOST_STEPS:
        raise UserError(f"horizon_steps must be at most {MOST_STEPS:,}, got {horizon_steps:,}")
    needed = 4 * int(horizon_steps) * int(num_samples) * values_each
    check_memory(needed, f"a forecast with num_samples={num_samples:,}", "ask for fewer samples or steps")


def chosen_envs(envs: Any, count: int) -> Int[np.ndarray, " some"]:
    """Returns the indices of some of `count` environments, of a mask too.

    Raises:
        UserError: no list of whole numbers, a mask of another size, an index that is not there, or one twice.
    """
    given = np.asarray(envs)
    if given.ndim != 1 or given.dtype.kind not in "biu" and given.size:
        raise UserError(f"envs must be a list of whole numbers, or a mask, got {short(envs)}")
    if given.dtype == np.bool_:
        if given.shape != (count,):
            raise UserError(f"a mask of environments needs the shape ({count},), got {given.shape}")
        return np.flatnonzero(given)
    chosen = given.astype(np.int64)
    if ((chosen < 0) | (chosen >= count)).any() or len(np.unique(chosen)) != len(chosen):
        raise UserError(f"envs must be different numbers from 0 to {count - 1}, got {short(given.tolist())}")
    return chosen
