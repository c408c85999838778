"""Checks a forecaster of one's own: `check_forecaster(my_forecaster)` raises one line for each thing that is wrong.

It runs the forecaster on made-up motion, as the wrappers would: shapes and ranges first; where these are right, what no
shape shows: whether the past is in the memory alone, whether other scenes, the order of agents or absent agents change
a forecast, whether noise comes from the given generators, whether the first step lasts `dt_s`.

How good the forecasts are is not asked; `predictor.evaluate` and `envs.evaluate` measure that.
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from predictor.forecaster import Belief, Futures, Memory
from predictor.forecaster_checks import check_futures, check_scale, require_forecaster
from predictor.forecaster_trial import AGENTS, SAMPLES, SCENES, STEPS, Trial
from predictor.support.errors import UserError
from predictor.what_if import ReactiveForecaster

SLOWEST, FASTEST = 0.4, 2.5
"""Range of the first forecast step, as a multiple of velocity times `dt_s`; unit mistakes (3.6, 100) are outside."""


def check_forecaster(forecaster: Any, *, device: str = "cpu", seed: int = 0) -> None:
    """Checks that an object can be given to the wrappers in the place of a checkpoint.

        >>> from predictor.baselines.constant_velocity import ConstantVelocity
        >>> from predictor.scene import SceneSpec
        >>> check_forecaster(ConstantVelocity(SceneSpec(dt_s=1.0)))

    Args:
        forecaster: what should be a `predictor.forecaster.Forecaster`, in evaluation mode.
        device: device of the forecaster.
        seed: random seed of the made-up motion and of the samples.

    Raises:
        UserError: something is wrong; one line for each thing.
    """
    problems = forecaster_problems(forecaster, device=device, seed=seed)
    if problems:
        raise UserError("\n".join(problems))


def forecaster_problems(forecaster: Any, *, device: str = "cpu", seed: int = 0) -> list[str]:
    """Returns what is wrong with a forecaster, one line for each thing; empty if nothing was found."""
    try:
        trial = Trial(require_forecaster(forecaster), device, seed)
    except UserError as error:
        return [str(error)]
    problems: list[str] = []
    with torch.no_grad():
        for check in (*_LAYOUT, *_MEANING):
            found = _run(check, trial)
            problems += found
            if found and check is not _first_step:
                break  # what the next ones would find may follow from it
    return problems


def _run(check: Callable[[Trial], Iterator[str]], trial: Trial) -> list[str]:
    """Returns what a check finds; an error of the forecaster's own is a finding."""
    try:
        return list(check(trial))
    except Exception as error:
        reason = " ".join(str(error).split())[:200]
        return [f"{check.__name__.strip('_').replace('_', ' ')}: failed with {type(error).__name__}: {reason}"]


# --- Layout -----------------------------------------------------------------------------------------------------------


def _empty_memory(trial: Trial) -> Iterator[str]:
    memory: Any = trial.forecaster.empty_memory(SCENES, AGENTS)
    if not isinstance(memory, Memory):
        yield f"empty_memory must return a Memory, got {type(memory).__name__}"
        return
    for kind, tensors, axes in (("nodes", memory.nodes, 2), ("pairs", memory.pairs, 3)):
        for tensor in tensors:
            shape = tuple(tensor.shape)
            if tensor.ndim != axes + 1 or shape[:2] != (SCENES, AGENTS):
                wanted = "(scenes, agents, size)" if kind == "nodes" else "(scenes, agents, slots, size)"
                yield f"empty_memory: {kind} must have the shape {wanted}, got {shape}; memory moves with agents"
            elif bool((tensor != 0).any()):
                yield f"empty_memory: {kind} must be zero, which stands for an agent that was never seen"


def _observe(trial: Trial) -> Iterator[str]:
    before = trial.forecaster.empty_memory(SCENES, AGENTS)
    result: Any = trial.forecaster.observe(before, trial.states[:, 0].clone(), trial.valid)
    if not (isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], Belief)):
        yield f"observe must return a Memory and a Belief, got {type(result).__name__}"
        return
    memory, belief = result
    shapes = [[tuple(t.shape) for t in (*m.nodes, *m.pairs)] for m in (before, memory)]
    if shapes[0] != shapes[1]:
        yield f"observe: the memory must keep its shapes, got {shapes[1]} after {shapes[0]}"
    if belief.states.shape != trial.states[:, 0].shape or trial.differ(belief.states, trial.states[:, 0]):
        yield "observe: belief.states must be the observed states, which the wrappers compare with the forecast"
    if not torch.equal(belief.valid, trial.valid):
        yield "observe: belief.valid must be the given valid"
    yield from _edges(trial, belief)


def _edges(trial: Trial, belief: Belief) -> Iterator[str]:
    sizes = {"edge_probs": trial.forecaster.num_edge_types, "edge_features": trial.forecaster.edge_feature_dim}
    slots = AGENTS if belief.senders is None else belief.senders.shape[-1]
    for name, size in sizes.items():
        tensor, wanted = getattr(belief, name), (SCENES, AGENTS, slots, size)
        if tuple(tensor.shape) != wanted:
            yield f"observe: belief.{name} must have the shape {wanted}, got {tuple(tensor.shape)}"
        elif not bool(torch.isfinite(tensor).all()):
            yield f"observe: belief.{name} must be finite"
        elif name == "edge_probs" and bool(((tensor.sum(-1) - 1).abs() > 1e-3).any() or (tensor < 0).any()):
            yield "observe: belief.edge_probs must be probabilities that sum to 1 over the types of each pair"


def _rollout(trial: Trial) -> Iterator[str]:
    _, belief = trial.observed()
    for samples, steps in ((1, trial.horizon), (SAMPLES, trial.horizon), (SAMPLES, 1)):
        futures: Any = trial.forecaster.rollout(belief, steps, samples, trial.noise())
        if not isinstance(futures, Futures):
            yield f"rollout must return Futures, got {type(futures).__name__}"
            return
        states: Any = futures.states
        if not isinstance(states, torch.Tensor):
            yield f"rollout: states must be a tensor, got {type(states).__name__}; torch.from_numpy makes one"
            return
        wanted = (SCENES, samples, AGENTS, steps, trial.spec.num_features)
        if tuple(futures.states.shape) != wanted:
            yield (
                f"rollout({steps} steps, {samples} samples): states must have the shape {wanted} (scenes, samples, "
                f"agents, steps, features), got {tuple(futures.states.shape)}"
            )
            return
        if not bool(torch.isfinite(futures.states[trial.valid[:, None].expand(-1, samples, -1)]).all()):
            yield "rollout: states of agents that are there must be finite, got not-a-number or infinity"
            return
        found = list(_probabilities(futures, wanted, trial))
        yield from found
        if found:
            return


def _probabilities(futures: Futures, wanted: tuple[int, ...], trial: Trial) -> Iterator[str]:
    probs, scale = futures.mode_probs, futures.scale
    there = trial.valid[:, None].expand(-1, wanted[1], -1)  # of absent agents nothing is read
    if probs is not None and tuple(probs.shape) != wanted[:3]:
        yield f"rollout: mode_probs must have the shape {wanted[:3]}, got {tuple(probs.shape)}"
    elif probs is not None and not bool(
        (((probs.sum(1) - 1).abs() <= 1e-3) | ~trial.valid).all() and (probs[there] >= 0).all()
    ):
        yield "rollout: mode_probs must sum to 1 over the samples of each agent"
    shape = (*wanted[:4], trial.spec.position_dim)
    if scale is not None and tuple(scale.shape) != shape:
        yield f"rollout: scale must have the shape {shape}, got {tuple(scale.shape)}"
    elif scale is not None and not bool(((scale >= 0) & torch.isfinite(scale))[there].all()):
        yield "rollout: scale is a standard deviation [m]; it must be finite and not negative"
    try:
        check_scale(futures, trial.forecaster)
    except UserError as error:
        yield str(error)


# --- Meaning ----------------------------------------------------------------------------------------------------------


def _first_step(trial: Trial) -> Iterator[str]:
    """Straight motion goes on for a step, by and large: its sign and its size are those of velocity times dt_s."""
    axes = trial.spec.position_dim
    _, belief = trial.observed()
    asked = trial.valid.clone()
    asked[:, : int(trial.spec.has_ego)] = False  # the ego's future is the policy's choice
    forecast = trial.single(belief)[..., :axes]
    moved = (forecast[:, :, 0] - trial.states[:, -1, :, :axes])[asked]
    expected = (trial.states[:, -1, :, axes : 2 * axes] * trial.spec.dt_s)[asked]
    if trial.horizon > 1 and torch.equal(forecast[asked][:, 1:], forecast[asked][:, :-1]) and bool(moved.any()):
        yield "rollout: all steps of a forecast are the same; step i is where an agent is i times dt_s later"
        return
    if (forecast[:, :, 0][asked] - expected).square().sum() < 0.2 * expected.square().sum():
        yield "rollout: states hold displacements from where each agent is now; give positions, as in belief.states"
        return
    for axis, letter in enumerate("xyz"[:axes]):
        along = (moved[:, axis] * expected[:, axis]).sum() / expected[:, axis].square().sum()
        if along < -SLOWEST:
            yield f"rollout: the first step goes against the velocity along {letter}; is the axis mirrored?"
        elif not (SLOWEST <= along <= FASTEST):
            yield (
                f"rollout: the first step is {along:.2g} times velocity × dt_s along {letter}; is a step "
                f"{trial.spec.dt_s:g} s (spec.dt_s), and are positions in metres and velocities in m/s?"
            )


def _repeats(trial: Trial) -> Iterator[str]:
    _, belief = trial.observed()
    if trial.differ(trial.single(belief), trial.single(belief)):
        yield "rollout: the single forecast differs from call to call; is the network in training mode (call eval())?"


def _arguments_stay(trial: Trial) -> Iterator[str]:
    memory, _ = trial.observed(trial.states[:, :2])
    states, valid = trial.states[:, 2].clone(), trial.valid.clone()
    kept = [tensor.clone() for tensor in (*memory.nodes, *memory.pairs)]
    _, belief = trial.forecaster.observe(memory, states, valid)
    if not torch.equal(states, trial.states[:, 2]) or not torch.equal(valid, trial.valid):
        yield "observe writes into its arguments; copy states and valid before changing them"
    if not all(torch.equal(a, b) for a, b in zip(kept, (*memory.nodes, *memory.pairs), strict=True)):
        yield "observe writes into the old memory; return a new one, since copies of an environment share it"
    before = belief.states.clone()
    trial.forecaster.rollout(belief, trial.horizon)
    if not torch.equal(before, belief.states):
        yield "rollout writes into the belief; copy belief.states before changing them"


def _no_peeking(trial: Trial) -> Iterator[str]:
    """A forecast from a belief stays what it was, whatever is observed later or elsewhere."""
    memory, belief = trial.observed(trial.states[:, :3])
    before = trial.single(belief)
    trial.forecaster.observe(memory, trial.states[:, 3].clone(), trial.valid)
    if trial.differ(before, trial.single(belief)):
        yield (
            "rollout: a forecast changes when later states are observed: it reads something else than its belief (the "
            "future, where a whole episode is encoded); keep everything in Memory and Belief"
        )
        return
    trial.observed(trial.states.flip(0))  # something else in between
    _, same = trial.forecaster.observe(memory, trial.states[:, 3].clone(), trial.valid)
    _, alone = trial.observed(trial.states[:, :4])
    if trial.differ(trial.single(same), trial.single(alone)):
        yield (
            "observe: what it returns depends on what else was observed before, not on the given memory alone; keep "
            "the past in Memory, not in the object"
        )


def _window_does_not_peek(trial: Trial) -> Iterator[str]:
    window: Any = getattr(trial.forecaster, "window", None)
    if window is None:
        return
    last = torch.full((SCENES,), 2, device=trial.device)
    valid = trial.valid[:, None].expand(-1, STEPS, -1).clone()
    other = trial.states.clone()
    other[:, 3:] *= 0.5
    one, two = (
        window(states, valid, last, 2, torch.Generator(trial.device).manual_seed(trial.seed))
        for states in (trial.states.clone(), other)
    )
    pairs = [(one.rollout, two.rollout, "rollout")]
    if one.prior_logits is not None:
        pairs.append((one.prior_logits[:, :3], two.prior_logits[:, :3], "prior_logits"))
    for before, after, name in pairs:
        if bool(((before - after).abs() > 1e-3 * (1 + before.abs())).any()):
            yield f"window: {name} changes with the states after last_observed; only the posterior may see the future"


def _scenes_are_independent(trial: Trial) -> Iterator[str]:
    together = trial.single(trial.observed()[1])
    for scene in range(SCENES):
        alone = trial.single(trial.observed(trial.states[[scene]], trial.valid[[scene]])[1])
        if trial.differ(alone[0], together[scene]):
            yield "rollout: the forecast of a scene changes with the other scenes of its batch"
            return


def _order_of_agents(trial: Trial) -> Iterator[str]:
    """Agents stand in another order from the middle of the history on, and their memory moves with them."""
    first = 1 if trial.spec.has_ego else 0
    order = torch.tensor([*range(first), *reversed(range(first, AGENTS))], device=trial.device)
    expected = trial.single(trial.observed()[1])[:, order]
    if trial.differ(trial.single(trial.observed(trial.states[:, :, order], trial.valid[:, order])[1]), expected):
        yield "rollout: the forecast of an agent changes with the order of the agents"
        return
    memory, _ = trial.observed(trial.states[:, :3])
    source: Int[Tensor, "scenes agents"] = order.expand(SCENES, -1)
    memory = memory.reorder(source, torch.ones_like(source, dtype=torch.bool))
    for step in range(3, STEPS):
        memory, belief = trial.forecaster.observe(memory, trial.states[:, step, order], trial.valid[:, order])
    if trial.differ(trial.single(belief), expected):
        yield "memory: the past of an agent stays at its old place when agents are re-sorted (Memory.reorder)"


def _absent_agents(trial: Trial) -> Iterator[str]:
    room = 2
    states = torch.cat([trial.states, trial.states.new_zeros(SCENES, STEPS, room, trial.spec.num_features)], 2)
    valid = torch.cat([trial.valid, trial.valid.new_zeros(SCENES, room)], 1)
    if trial.differ(trial.single(trial.observed(states, valid)[1])[:, :AGENTS], trial.single(trial.observed()[1])):
        yield "rollout: forecasts change with the number of absent (padded) agents; mask by valid"


def _of_samples(valid: Bool[Tensor, "scenes agents"]) -> Bool[Tensor, "scenes samples agents"]:
    """Returns the mask of present agents for each sample."""
    return valid[:, None].expand(-1, SAMPLES, -1)


def _noise(trial: Trial) -> Iterator[str]:
    _, belief = trial.observed()
    before = torch.get_rng_state(), _global_numpy()
    one, two = (trial.forecaster.rollout(belief, trial.horizon, SAMPLES, trial.noise()).states for _ in range(2))
    here = _of_samples(trial.valid)
    if not torch.equal(before[0], torch.get_rng_state()) or _global_numpy() != before[1]:
        yield "rollout draws from torch's or NumPy's global generator; draw from the given one"
    elif trial.differ(one[here], two[here]):
        yield "rollout: equal generators must give equal samples"
    other = trial.forecaster.rollout(belief, trial.horizon, SAMPLES, trial.noise(first=7)).states
    if trial.differ(other[:, 0][trial.valid], one[:, 0][trial.valid]):
        yield "rollout: sample 0 is the single forecast and must not depend on the generator"
    for scene in range(SCENES):
        _, alone = trial.observed(trial.states[[scene]], trial.valid[[scene]])
        drawn = trial.forecaster.rollout(alone, trial.horizon, SAMPLES, trial.noise(1, scene)).states[0]
        there = here[scene]
        if trial.differ(drawn[there], one[scene][there]):
            yield "rollout: the samples of a scene must come from its own generator, whatever the other scenes draw"
            return


def _global_numpy() -> tuple[list[int], int, int, float]:
    """Returns the state of NumPy's global generator: its numbers, how many of them are used, and a kept normal draw."""
    state: Any = np.random.get_state()  # noqa: NPY002
    return state[1].tolist(), *state[2:]


def _place_does_not_matter(trial: Trial) -> Iterator[str]:
    """On "centroid" axes all agents may stand elsewhere."""
    axes = torch.tensor([frame == "centroid" for frame in trial.spec.frame], device=trial.device)
    if not bool(axes.any()):
        return
    count = trial.spec.position_dim
    far = trial.states.clone()
    shift = 3.0 * torch.tensor(trial.spec.feature_scales[:count], device=trial.device) * axes
    far[..., :count] += shift * trial.valid[:, None, :, None]
    moved = trial.single(trial.observed(far)[1])
    moved[..., :count] -= shift * trial.valid[:, :, None, None]
    if trial.differ(moved, trial.single(trial.observed()[1])):
        yield "rollout: spec.frame says 'centroid', but the forecast changes when all agents stand elsewhere"


def _plans(trial: Trial) -> Iterator[str]:
    """Two plans of the ego that part in the middle of the horizon: the others may differ from the next step on."""
    if not trial.spec.has_ego or not isinstance(trial.forecaster, ReactiveForecaster):
        return
    _, belief = trial.observed()
    axes, part = trial.spec.position_dim, trial.horizon // 2
    plans = belief.states[:, None, :1].expand(-1, 2, trial.horizon, -1).clone()
    plans[:, 1, part:, :axes] += torch.tensor(trial.spec.feature_scales[:axes], device=trial.device)
    futures: Any = trial.forecaster.rollout_plans(belief, plans, SAMPLES, trial.noise())
    try:
        check_futures(futures, trial.horizon, SAMPLES, belief.states, axes, plans=2)
    except UserError as error:
        yield str(error).partition(";")[0]
        return
    there = _of_samples(trial.valid[:, 1:])
    one, two = (futures.states[:, plan, :, 1:][there] for plan in range(2))
    if not bool(torch.cat([one, two]).isfinite().all()):
        yield "rollout_plans: states of agents that are there must be finite, got not-a-number or infinity"
    elif trial.differ(one[:, : part + 1], two[:, : part + 1]):
        yield "rollout_plans: others react to a plan too early; their step i may depend on its steps before i alone"


_LAYOUT = (_empty_memory, _observe, _rollout)
_MEANING = (
    _first_step, _arguments_stay, _repeats, _no_peeking, _window_does_not_peek, _scenes_are_independent,
    _order_of_agents, _absent_agents, _noise, _place_does_not_matter, _plans,
)  # fmt: skip
