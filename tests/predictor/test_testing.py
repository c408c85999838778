"""`check_forecaster`: finds nothing in a forecaster that keeps the rules, and each of the planted mistakes."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from predictor.baselines.constant_velocity import ConstantVelocity, NoisyConstantVelocity
from predictor.checkpoint import load_checkpoint
from predictor.forecaster import Belief, Futures, Memory, edgeless_belief
from predictor.forecaster_checks import require_forecaster
from predictor.scene import SceneSpec
from predictor.support.errors import UserError
from predictor.testing import check_forecaster, forecaster_problems
from tests.predictor.helpers import EVERY_MODEL, WORLD, any_model

SPEC = SceneSpec(dt_s=0.5, frame=WORLD)


class Smooth:
    """Goes on with the mean of all velocities so far; samples scatter."""

    spec = SPEC
    horizon_steps, num_edge_types, edge_feature_dim = 4, 2, 3

    def empty_memory(self, batch: int, agents: int) -> Memory:
        return Memory(nodes=(torch.zeros(batch, agents, 3),))

    def observe(self, memory: Memory, states: Tensor, valid: Tensor) -> tuple[Memory, Belief]:
        (before,) = memory.nodes
        now = torch.cat([states[..., 2:4], torch.ones_like(states[..., :1])], -1) * valid[..., None]
        total = before + now
        belief = edgeless_belief(states, valid, self.num_edge_types, self.edge_feature_dim)
        mean = total[..., :2] / total[..., 2:].clamp(min=1)
        return Memory((total,)), Belief(states, valid, belief.edge_probs, belief.edge_features, mean)

    def rollout(self, belief: Belief, horizon_steps: int, num_samples: int = 1, generator: Any = None) -> Futures:
        velocity = belief.internal[:, None].repeat(1, num_samples, 1, 1)
        for scene, own in enumerate(generator or [] if num_samples > 1 else []):
            there = belief.valid[scene]
            drawn = own.normal(size=(num_samples - 1, int(there.sum()), 2))
            velocity[scene, 1:, there] += torch.from_numpy(drawn.astype(np.float32))
        steps = torch.arange(1, horizon_steps + 1)[:, None] * self.spec.dt_s
        states = belief.states[:, None, :, None].repeat(1, num_samples, 1, horizon_steps, 1)
        states[..., :2] += velocity[..., None, :] * steps
        return Futures(states)


def changed_rollout(change: Callable[[Tensor], Tensor]) -> type[Smooth]:
    """Returns a forecaster whose predicted states are changed."""

    class Changed(Smooth):
        def rollout(self, belief: Belief, *arguments: Any, **named: Any) -> Futures:
            return Futures(change(super().rollout(belief, *arguments, **named).states))

    return Changed


class WrongStep(Smooth):
    """Believes that a step lasts 2 s."""

    def rollout(self, belief: Belief, *arguments: Any, **named: Any) -> Futures:
        return super().rollout(Belief(*vars(belief).values()), *arguments, **named)

    def observe(self, memory: Memory, states: Tensor, valid: Tensor) -> tuple[Memory, Belief]:
        memory, belief = super().observe(memory, states, valid)
        belief.internal.mul_(2.0 / self.spec.dt_s)
        return memory, belief


class KilometresPerHour(WrongStep):
    def observe(self, memory: Memory, states: Tensor, valid: Tensor) -> tuple[Memory, Belief]:
        memory, belief = Smooth.observe(self, memory, states, valid)
        belief.internal.mul_(3.6)
        return memory, belief


class Mirrored(WrongStep):
    def observe(self, memory: Memory, states: Tensor, valid: Tensor) -> tuple[Memory, Belief]:
        memory, belief = Smooth.observe(self, memory, states, valid)
        belief.internal[..., 1] *= -1
        return memory, belief


class Global(Smooth):
    """Draws from torch's own generator."""

    def rollout(self, belief: Belief, horizon_steps: int, num_samples: int = 1, generator: Any = None) -> Futures:
        states = super().rollout(belief, horizon_steps, num_samples).states
        states[:, 1:] += torch.randn(states[:, 1:].shape)
        return Futures(states)


class OfNumPy(Smooth):
    """Draws a few numbers from NumPy's own generator."""

    def rollout(self, belief: Belief, horizon_steps: int, num_samples: int = 1, generator: Any = None) -> Futures:
        states = super().rollout(belief, horizon_steps, num_samples).states
        states[:, 1:] += torch.as_tensor(np.random.normal(size=3)[0])  # noqa: NPY002
        return Futures(states)


class FirstGenerator(Smooth):
    """Draws for all scenes from the first one's generator."""

    def rollout(self, belief: Belief, horizon_steps: int, num_samples: int = 1, generator: Any = None) -> Futures:
        return super().rollout(belief, horizon_steps, num_samples, generator and [generator[0]] * len(belief.states))


class NoisySingle(Smooth):
    """Scatters sample 0, too."""

    def rollout(self, belief: Belief, horizon_steps: int, num_samples: int = 1, generator: Any = None) -> Futures:
        states = super().rollout(belief, horizon_steps, num_samples, generator).states
        for scene, own in enumerate(generator or []):
            states[scene] += float(own.normal())
        return Futures(states)


class OwnMemory(Smooth):
    """Keeps the past in itself: other environments get it."""

    past: Tensor | None = None

    def observe(self, memory: Memory, states: Tensor, valid: Tensor) -> tuple[Memory, Belief]:
        last = self.past if self.past is not None and self.past.shape == states.shape else states
        self.past = states
        _, belief = super().observe(memory, (states + last) / 2, valid)
        return memory, Belief(states, valid, belief.edge_probs, belief.edge_features, belief.internal)


class Peeking(Smooth):
    """Rolls out from the latest states that it saw, not from the belief."""

    latest: Tensor

    def observe(self, memory: Memory, states: Tensor, valid: Tensor) -> tuple[Memory, Belief]:
        self.latest = states
        return super().observe(memory, states, valid)

    def rollout(self, belief: Belief, *arguments: Any, **named: Any) -> Futures:
        there = self.latest if self.latest.shape == belief.states.shape else belief.states
        edges = (belief.edge_probs, belief.edge_features)
        return super().rollout(Belief(there, belief.valid, *edges, belief.internal), *arguments, **named)


class Normalised(Smooth):
    """Subtracts a mean over the whole batch, as batch normalisation in training mode does."""

    def rollout(self, belief: Belief, *arguments: Any, **named: Any) -> Futures:
        futures = super().rollout(belief, *arguments, **named)
        return Futures(futures.states + 0.1 * belief.states.mean())


class ByPlace(Smooth):
    """Treats each place differently."""

    def rollout(self, belief: Belief, *arguments: Any, **named: Any) -> Futures:
        states = super().rollout(belief, *arguments, **named).states
        return Futures(states + torch.arange(states.shape[2])[:, None, None])


class MeanOfPlaces(Smooth):
    """Counts padding."""

    def rollout(self, belief: Belief, *arguments: Any, **named: Any) -> Futures:
        states = super().rollout(belief, *arguments, **named).states
        return Futures(states + belief.states.mean(dim=1)[:, None, None, None])


class WritesMemory(Smooth):
    def observe(self, memory: Memory, states: Tensor, valid: Tensor) -> tuple[Memory, Belief]:
        new, belief = super().observe(memory, states, valid)
        memory.nodes[0].copy_(new.nodes[0])
        return memory, belief


class WritesBelief(Smooth):
    def rollout(self, belief: Belief, *arguments: Any, **named: Any) -> Futures:
        belief.states[..., :2] += belief.internal * self.spec.dt_s
        return super().rollout(belief, *arguments, **named)


class NotEmpty(Smooth):
    def empty_memory(self, batch: int, agents: int) -> Memory:
        return Memory(nodes=(torch.ones(batch, agents, 3),))


class TimeFirst(Smooth):
    def empty_memory(self, batch: int, agents: int) -> Memory:
        return Memory(nodes=(torch.zeros(3, batch, agents),))


class Logits(Smooth):
    """Forgets the softmax."""

    def observe(self, memory: Memory, states: Tensor, valid: Tensor) -> tuple[Memory, Belief]:
        memory, belief = super().observe(memory, states, valid)
        belief.edge_probs.mul_(3.0)
        return memory, belief


class NormalisedStates(Smooth):
    def observe(self, memory: Memory, states: Tensor, valid: Tensor) -> tuple[Memory, Belief]:
        return super().observe(memory, states / torch.tensor(self.spec.feature_scales), valid)


class Shares(Smooth):
    """Probabilities of three modes for every agent, whatever number of samples is asked."""

    def rollout(self, belief: Belief, *arguments: Any, **named: Any) -> Futures:
        states = super().rollout(belief, *arguments, **named).states
        return Futures(states, torch.full(states.shape[:3], 0.5))


class TrainingMode(Smooth):
    """Drops out inputs at random."""

    def rollout(self, belief: Belief, *arguments: Any, **named: Any) -> Futures:
        states = super().rollout(belief, *arguments, **named).states
        return Futures(torch.nn.functional.dropout(states, 0.1, training=True))


class Displacements(Smooth):
    """Gives displacements from where each agent is."""

    def rollout(self, belief: Belief, *arguments: Any, **named: Any) -> Futures:
        states = super().rollout(belief, *arguments, **named).states
        states[..., :2] -= belief.states[:, None, :, None, :2]
        return Futures(states)


class Fails(Smooth):
    def rollout(self, belief: Belief, *arguments: Any, **named: Any) -> Futures:
        raise IndexError("list index\nout of range")


class Windowed(Smooth):
    """Its roll-out of training begins at the last state instead of the last observed one."""

    def window(self, states: Tensor, valid: Tensor, last_observed: Tensor, rollout_steps: int, generator: Any) -> Any:
        from predictor.forecaster import WindowOutput

        return WindowOutput(states, states[:, -1:, :, :].transpose(1, 2).repeat(1, 1, rollout_steps, 1))


MISTAKES: dict[str, tuple[Any, str]] = {
    "dt_s": (WrongStep, "rollout: the first step is 4 times velocity × dt_s along x; is a step 0.5 s (spec.dt_s)"),
    "units": (KilometresPerHour, "rollout: the first step is 3.6 times velocity × dt_s along x"),
    "mirrored": (Mirrored, "rollout: the first step goes against the velocity along y; is the axis mirrored?"),
    "nan": (changed_rollout(lambda s: s * float("nan")), "rollout: states of agents that are there must be finite"),
    "axes": (changed_rollout(lambda s: s.transpose(1, 2)), "samples): states must have the shape (3, 1, 4, 4, 4)"),
    "horizon": (changed_rollout(lambda s: s[..., :1, :]), "states must have the shape (3, 1, 4, 4, 4)"),
    "noise of NumPy": (OfNumPy, "rollout draws from torch's or NumPy's global generator; draw from the given one"),
    "global noise": (Global, "rollout draws from torch's or NumPy's global generator; draw from the given one"),
    "shared noise": (FirstGenerator, "rollout: the samples of a scene must come from its own generator"),
    "noisy single": (NoisySingle, "rollout: sample 0 is the single forecast and must not depend on the generator"),
    "own memory": (OwnMemory, "observe: what it returns depends on what else was observed before"),
    "peeking": (Peeking, "rollout: a forecast changes when later states are observed"),
    "window peeks": (Windowed, "window: rollout changes with the states after last_observed"),
    "batch": (Normalised, "rollout: the forecast of a scene changes with the other scenes of its batch"),
    "order": (ByPlace, "rollout: the forecast of an agent changes with the order of the agents"),
    "padding": (MeanOfPlaces, "rollout: forecasts change with the number of absent (padded) agents; mask by valid"),
    "writes memory": (WritesMemory, "observe writes into the old memory; return a new one"),
    "writes belief": (WritesBelief, "rollout writes into the belief; copy belief.states"),
    "memory not zero": (NotEmpty, "empty_memory: nodes must be zero, which stands for an agent that was never seen"),
    "memory by time": (TimeFirst, "empty_memory: nodes must have the shape (scenes, agents, size), got (3, 3, 4)"),
    "logits": (Logits, "observe: belief.edge_probs must be probabilities that sum to 1 over the types of each pair"),
    "normalised": (NormalisedStates, "observe: belief.states must be the observed states"),
    "mode_probs": (Shares, "rollout: mode_probs must sum to 1 over the samples of each agent"),
    "training mode": (
        TrainingMode,
        "the single forecast differs from call to call; is the network in training",
    ),
    "displacements": (Displacements, "rollout: states hold displacements from where each agent is now; give positions"),
    "one step": (
        changed_rollout(lambda s: s[..., :1, :].expand(-1, -1, -1, s.shape[3], -1).clone()),
        "rollout: all steps of a forecast are the same; step i is where an agent is i times dt_s later",
    ),
    "error": (Fails, "rollout: failed with IndexError: list index out of range"),
    "class": (lambda: Smooth, "a forecaster is an object, got the class Smooth; call it first"),
    "no forecaster": (dict, "but dict has no spec, horizon_steps"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_is_found_and_said_in_a_line(mistake: str):
    make, sentence = MISTAKES[mistake]
    with pytest.raises(UserError) as error:
        check_forecaster(make())
    lines = str(error.value).splitlines()
    assert any(sentence in line for line in lines), lines
    assert len(lines) <= 2, lines


@pytest.mark.parametrize("frame", [("world", "world"), ("ego", "world"), ("centroid", "centroid")])
def test_nothing_is_found_where_nothing_is_wrong(frame: Any):
    class There(Smooth):
        spec = SceneSpec(dt_s=0.1, frame=frame, has_ego="ego" in frame)

    check_forecaster(There())
    check_forecaster(There(), seed=5)
    check_forecaster(ConstantVelocity(There.spec))
    check_forecaster(NoisyConstantVelocity(There.spec, 1.0, 1.0))


def test_what_is_said_of_absent_agents_does_not_count():
    class Absent(Smooth):
        has_scale = True

        def rollout(self, belief: Belief, *arguments: Any, **named: Any) -> Futures:
            states = super().rollout(belief, *arguments, **named).states
            there = belief.valid[:, None].expand(states.shape[:3])
            nothing = torch.full(states.shape[:3], float("nan"))
            scale = torch.where(there[..., None, None], 1.0, nothing[..., None, None]).expand(*states.shape[:4], 2)
            return Futures(states, torch.where(there, 1 / states.shape[1], nothing), scale)

    check_forecaster(Absent())


def test_a_frame_that_is_not_kept_is_found():
    class Somewhere(Smooth):
        spec = SceneSpec(dt_s=0.1, frame=("centroid", "centroid"), has_ego=False)

        def rollout(self, belief: Belief, *arguments: Any, **named: Any) -> Futures:
            states = super().rollout(belief, *arguments, **named).states
            return Futures(states + 0.1 * states)

    assert "spec.frame says 'centroid', but the forecast changes" in "".join(forecaster_problems(Somewhere()))


class Reacts(Smooth):
    """Others follow the ego's plan by a step later."""

    spec = SceneSpec(dt_s=0.5, frame=WORLD, has_ego=True)
    late = 1

    def rollout_plans(self, belief: Belief, plans: Tensor, num_samples: int = 1, generator: Any = None) -> Futures:
        states = self.rollout(belief, plans.shape[2], num_samples, generator).states
        states = states[:, None].repeat(1, plans.shape[1], 1, 1, 1, 1)
        seen = (plans - belief.states[:, None, :1])[:, :, None, None]
        states[..., self.late :, :2] += 0.1 * seen[..., : plans.shape[2] - self.late, :2]
        return Futures(states)


def test_a_reaction_one_step_later_is_right():
    assert forecaster_problems(Reacts()) == []


def test_mistakes_with_plans_are_found():
    class TooEarly(Reacts):
        late = 0

    class Transposed(Reacts):
        def rollout_plans(self, *arguments: Any, **named: Any) -> Futures:
            return Futures(super().rollout_plans(*arguments, **named).states.transpose(1, 2))

    class Broken(Reacts):
        def rollout_plans(self, *arguments: Any, **named: Any) -> Futures:
            return Futures(super().rollout_plans(*arguments, **named).states * np.nan)

    assert forecaster_problems(TooEarly()) == [
        "rollout_plans: others react to a plan too early; their step i may depend on its steps before i alone"
    ]
    assert forecaster_problems(Transposed()) == [
        "rollout_plans of a forecaster: states must have the shape (3, 2, 3, 4, 4, 4), got (3, 3, 2, 4, 4, 4)"
    ]
    assert "rollout_plans: states of agents that are there must be finite" in forecaster_problems(Broken())[0]


@pytest.mark.parametrize("name", ["roundabout", "simple-tag", "racetrack"])
def test_shipped_checkpoints_pass(name: str):
    assert forecaster_problems(load_checkpoint(name)[0]) == []


@pytest.mark.parametrize("name", EVERY_MODEL)
def test_every_model_passes_untrained_but_for_its_first_step(name: str):
    problems = [line for line in forecaster_problems(any_model(name)) if "first step" not in line]
    by_place = ["rollout: the forecast of an agent changes with the order of the agents"]
    assert problems == (by_place if name == "lstm-joint" else [])  # it has weights for each place, as in the paper


def test_a_forecaster_needs_all_parts():
    assert require_forecaster(Smooth()).horizon_steps == 4

    class Half(Smooth):
        spec: Any = {"dt_s": 1}

    with pytest.raises(UserError, match="the spec of a forecaster must be a SceneSpec, got dict"):
        require_forecaster(Half())
    for part, number, least in (("horizon_steps", "five", 1), ("num_edge_types", 0, 1), ("edge_feature_dim", -1, 0)):
        wrong = Smooth()
        setattr(wrong, part, number)
        with pytest.raises(UserError, match=f"{part} of a forecaster must be a whole number from {least} on, got"):
            require_forecaster(wrong)
    text = Smooth()
    text.horizon_steps = "5"  # type: ignore[assignment]
    with pytest.raises(UserError, match="horizon_steps of a forecaster must be a whole number from 1 on, got '5'"):
        require_forecaster(text)


def test_methods_take_what_they_are_called_with():
    class WithoutNoise(Smooth):
        def rollout(self, belief: Belief, horizon_steps: int, num_samples: int = 1) -> Futures:  # type: ignore[override]
            return super().rollout(belief, horizon_steps, num_samples)

    with pytest.raises(
        UserError, match="rollout of a forecaster must take .belief, .*generator., which that of Withou"
    ):
        require_forecaster(WithoutNoise())
