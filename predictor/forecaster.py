"""The interface of everything that forecasts: memory in, memory and belief out; roll-out from a belief.

Forecasters are stateless functions of an explicit `Memory`, so that a batch may hold environments of different age,
each can be cleared alone, and agents may be re-sorted. `predictor.online` keeps the memory for an environment.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from predictor.graph import NO_AGENT
from predictor.noise import Noise, TrainingNoise
from predictor.scene import SceneSpec, dense_edges


@dataclass(frozen=True)
class Memory:
    """Keeps the past of each agent and each pair; zero means "nothing yet"."""

    nodes: tuple[Float[Tensor, "batch agents _"], ...] = ()
    """One tensor per kind of agent memory."""
    pairs: tuple[Float[Tensor, "batch agents slots _"], ...] = ()
    """One tensor per kind of pair memory, receiver first."""
    senders: Int[Tensor, "batch agents slots"] | None = None
    """Index of the sender in each slot (`NO_AGENT` where empty); None if slot j is agent j's."""

    def reorder(self, source: Int[Tensor, "batch agents"], known: Bool[Tensor, "batch agents"]) -> "Memory":
        """Moves memory along with agents that changed places.

        Args:
            source: for each new place, the old place of its agent.
            known: which new places had an old one; the others start from zero.
        """
        envs = torch.arange(len(source), device=source.device)[:, None]
        nodes = tuple(m[envs, source] * known[..., None] for m in self.nodes)
        if self.senders is None:
            both = (known[:, :, None] & known[:, None, :])[..., None]
            pairs = tuple(m[envs[..., None], source[:, :, None], source[:, None, :]] * both for m in self.pairs)
            return Memory(nodes, pairs)
        pairs = tuple(m[envs, source] * known[..., None, None] for m in self.pairs)
        return Memory(nodes, pairs, self._moved_senders(source, known))

    def _moved_senders(self, source: Tensor, known: Tensor) -> Tensor:
        """Returns the senders after `reorder`: the new places of senders, in the new places of receivers."""
        assert self.senders is not None
        agents = self.senders.shape[1]
        # where each agent went; one more entry for empty slots, and one for the writes of places without a past
        went = source.new_full((len(source), agents + 2), NO_AGENT)
        new = torch.arange(source.shape[1], device=source.device).expand_as(source)
        went.scatter_(1, torch.where(known, source, agents + 1), new)
        old = self.senders.gather(1, source[..., None].expand(-1, -1, self.senders.shape[2]))
        old = torch.where((old == NO_AGENT) | ~known[..., None], agents, old)
        return went.gather(1, old.flatten(1)).view_as(old)

    def to_slots(
        self, senders: Int[Tensor, "batch agents slots"], present: Bool[Tensor, "batch agents slots"]
    ) -> "Memory":
        """Moves pair memory to the slots of each receiver's current senders; a sender that had none starts from zero.

        Args:
            senders: index of the agent in each slot.
            present: which slots hold an agent.
        """
        assert self.senders is not None  # dense memory has a place for every agent
        same = (senders[..., :, None] == self.senders[..., None, :]) & present[..., :, None]
        place, known = same.to(torch.uint8).argmax(-1), same.any(-1)[..., None]
        pairs = tuple(m.gather(2, place[..., None].expand(-1, -1, -1, m.shape[-1])) * known for m in self.pairs)
        return Memory(self.nodes, pairs, senders.masked_fill(~present, NO_AGENT))

    def padded(self, agents: int) -> "Memory":
        """Returns the memory with room for `agents` agents; the new ones have no memory."""

        def pad(memory: Tensor, axes: int, value: int = 0) -> Tensor:
            missing = agents - memory.shape[1]
            padding = (0, 0) * (memory.ndim - 1 - axes) + (0, missing) * axes
            return functional.pad(memory, padding, value=value) if missing else memory

        dense = self.senders is None
        pairs = tuple(pad(m, 2 if dense else 1) for m in self.pairs)
        senders = None if self.senders is None else pad(self.senders, 1, NO_AGENT)
        return Memory(tuple(pad(m, 1) for m in self.nodes), pairs, senders)

    def select(self, envs: Int[Tensor, " envs"] | slice) -> "Memory":
        """Returns the memory of the given environments; of a slice without copying it."""
        return self._map(lambda m: m[envs])

    def replace_envs(self, envs: Int[Tensor, " envs"], other: "Memory") -> "Memory":
        """Returns a copy in which the memory of `envs` is that of `other`."""
        return self._map(lambda m, o: m.index_copy(0, envs, o), other)

    @staticmethod
    def concatenate(first: "Memory", *others: "Memory") -> "Memory":
        """Returns the memory of the environments of `first`, then of those of the others."""
        return first._map(lambda *m: torch.cat(m), *others) if others else first

    def _map(self, change: Callable[..., Tensor], *others: "Memory") -> "Memory":
        """Applies `change` to every tensor, together with the corresponding tensors of other memories."""
        memories = (self, *others)
        listed = [m.senders for m in memories if m.senders is not None]
        return Memory(
            tuple(change(*tensors) for tensors in zip(*(m.nodes for m in memories), strict=True)),
            tuple(change(*tensors) for tensors in zip(*(m.pairs for m in memories), strict=True)),
            change(*listed) if listed else None,
        )


@dataclass(frozen=True)
class Belief:
    """State of a forecaster after the latest observation."""

    states: Float[Tensor, "batch agents state"]
    """Observed states [SI]."""
    valid: Bool[Tensor, "batch agents"]
    """Which agents are present."""
    edge_probs: Float[Tensor, "batch agents slots types"]
    """Prior over edge types, receiver first; [1, 0, …] where there is no pair."""
    edge_features: Float[Tensor, "batch agents slots feature"]
    """Edge features from the past only; zero where there is no pair."""
    internal: Any = None
    """Data that this forecaster needs to roll out."""
    senders: Int[Tensor, "batch agents slots"] | None = None
    """Index of the sender in each slot (`NO_AGENT` where empty); None if slot j is agent j's."""

    def dense(self) -> "Belief":
        """Returns the belief with slot j for agent j; of use where scenes are small."""
        if self.senders is None:
            return self
        probs, features = dense_edges(self.edge_probs, self.edge_features, self.senders)
        return Belief(self.states, self.valid, probs, features, self.internal)


def has_scale(forecaster: "Forecaster") -> bool:
    """Returns whether roll-outs of a forecaster come with `Futures.scale`: its attribute `has_scale`, if it has one."""
    return bool(getattr(forecaster, "has_scale", False))


def edgeless_belief(
    states: Float[Tensor, "batch agents state"],
    valid: Bool[Tensor, "batch agents"],
    num_edge_types: int,
    edge_feature_dim: int,
) -> Belief:
    """Returns the belief of a forecaster without interactions: every pair has "no edge"."""
    batch, agents, _ = states.shape
    probs = states.new_zeros(batch, agents, agents, num_edge_types)
    probs[..., 0] = 1.0
    return Belief(states, valid, probs, states.new_zeros(batch, agents, agents, edge_feature_dim))


class Futures(NamedTuple):
    """Possible futures of each scene of a batch; each sample is a whole scene."""

    states: Float[Tensor, "batch *plans samples agents horizon state"]
    """Future states [SI]; sample 0 is the single forecast, for use where only one is wanted. With plans of the ego
    (`predictor.what_if`) there is an axis for them."""
    mode_probs: Float[Tensor, "batch *plans samples agents"] | None = None
    """Probability of each sample for each agent, which sum to 1 over the samples; None if the samples are draws."""
    scale: Float[Tensor, "batch *plans samples agents horizon axes"] | None = None
    """Standard deviation of the position around each sample [m]; None if the forecaster has no such estimate."""


@runtime_checkable
class Forecaster(Protocol):
    """Interface of models that forecast scenes step by step."""

    @property
    def spec(self) -> SceneSpec:
        """Layout of the scenes that it observes."""

    @property
    def horizon_steps(self) -> int:
        """Number of steps that it was trained to forecast."""

    @property
    def num_edge_types(self) -> int:
        """Number of edge types, "no edge" included."""

    @property
    def edge_feature_dim(self) -> int:
        """Number of features of an edge."""

    def empty_memory(self, batch: int, agents: int) -> Memory:
        """Returns the memory before any observation."""

    def observe(
        self,
        memory: Memory,
        states: Float[Tensor, "batch agents state"],
        valid: Bool[Tensor, "batch agents"],
    ) -> tuple[Memory, Belief]:
        """Updates the memory with the states of one instant [SI], at a cost that does not depend on its past."""

    def rollout(
        self, belief: Belief, horizon_steps: int, num_samples: int = 1, generator: Noise | None = None
    ) -> Futures:
        """Computes possible futures: sample 0 is the single forecast, the others are drawn or enumerated.

        With one generator per scene of the batch, a scene's samples depend on no other scene.
        """


class WindowOutput(NamedTuple):
    """Inputs of the losses for one batch of training windows; graph entries are None for models without a graph."""

    one_step: Float[Tensor, "batch time agents state"]
    """Teacher-forced predictions of the next state at each step [SI]; under the posterior graph where there is one."""
    rollout: Float[Tensor, "batch agents horizon state"]
    """Free-running states after `last_observed` [SI]; under the prior graph where there is one."""
    prior_logits: Float[Tensor, "batch time agents agents types"] | None = None
    """Logits of edge types from the past."""
    posterior_logits: Float[Tensor, "batch time agents agents types"] | None = None
    """Logits of edge types from past and future."""
    features: Float[Tensor, "batch time agents agents feature"] | None = None
    """Edge features from the past; those that are averaged over the whole window in training know all of it."""
    modes: Futures | None = None
    """Enumerated futures after `last_observed`, `rollout` first; None for models without modes."""
    pairs: Bool[Tensor, "batch time agents agents"] | None = None
    """Pairs whose edges were inferred; None stands for all that are there."""

    def float(self) -> "WindowOutput":
        """Returns the output in float32."""

        def exact(value: Any) -> Any:
            return (
                type(value)(*map(exact, value))
                if isinstance(value, tuple)
                else None
                if value is None
                else value.float()
                if value.is_floating_point()
                else value
            )

        return WindowOutput(*map(exact, self))


@runtime_checkable
class TrainableForecaster(Forecaster, Protocol):
    """Interface of forecasters that `predictor.train` can fit; each is also an `nn.Module`."""

    @property
    def config(self) -> Any:
        """Sizes of the network: a frozen dataclass of JSON values."""

    def window(
        self,
        states: Float[Tensor, "batch time agents state"],
        valid: Bool[Tensor, "batch time agents"],
        last_observed: Int[Tensor, " batch"],
        rollout_steps: int,
        generator: TrainingNoise | None = None,
    ) -> WindowOutput:
        """Runs a teacher-forced pass over all steps and a free roll-out of `rollout_steps` after each `last_observed`.

        Args:
            states: true states [SI], zeros where not valid.
            valid: which agents are present.
            last_observed: index of the last observed step of each window, after which the roll-out starts.
            rollout_steps: number of steps to roll out; 0 skips it (`rollout` then has no steps).
            generator: source of all noise.
        """
