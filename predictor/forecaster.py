"""The interface of everything that forecasts: memory in, memory and belief out; roll-out from a belief.

Forecasters are stateless functions of an explicit `Memory`, so that a batch may hold rows of different age, rows may be
forgotten one by one, and agents may be re-sorted. `predictor.online` keeps the memory for an environment.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from predictor.scene import SceneSpec


@dataclass(frozen=True)
class Memory:
    """What is remembered of the past, per agent and per pair; zero means "nothing yet"."""

    nodes: tuple[Float[Tensor, "batch agents _"], ...] = ()
    """One tensor per kind of agent memory."""
    pairs: tuple[Float[Tensor, "batch agents agents _"], ...] = ()
    """One tensor per kind of pair memory, receiver first."""

    def reorder(self, source: Int[Tensor, "batch agents"], known: Bool[Tensor, "batch agents"]) -> "Memory":
        """Move memory along with agents that changed rows.

        Args:
            source: for each new row, the old row of the same agent.
            known: which new rows had an old one; the others start from zero.
        """
        rows = torch.arange(len(source), device=source.device)
        both = (known[:, :, None] & known[:, None, :])[..., None]
        nodes = tuple(m[rows[:, None], source] * known[..., None] for m in self.nodes)
        pairs = tuple(m[rows[:, None, None], source[:, :, None], source[:, None, :]] * both for m in self.pairs)
        return Memory(nodes, pairs)

    def padded(self, agents: int) -> "Memory":
        """The same with room for `agents` agents; the new ones have no memory."""

        def pad(memory: Tensor, axes: int) -> Tensor:
            missing = agents - memory.shape[1]
            return functional.pad(memory, (0, 0) + (0, missing) * axes) if missing else memory

        return Memory(tuple(pad(m, 1) for m in self.nodes), tuple(pad(m, 2) for m in self.pairs))

    def select(self, rows: Int[Tensor, " rows"]) -> "Memory":
        """The memory of some batch rows."""
        return Memory(tuple(m[rows] for m in self.nodes), tuple(m[rows] for m in self.pairs))

    def replace_rows(self, rows: Int[Tensor, " rows"], other: "Memory") -> "Memory":
        """A copy in which `rows` are those of `other`."""
        return Memory(
            tuple(m.index_copy(0, rows, o) for m, o in zip(self.nodes, other.nodes, strict=True)),
            tuple(m.index_copy(0, rows, o) for m, o in zip(self.pairs, other.pairs, strict=True)),
        )

    @staticmethod
    def concatenate(first: "Memory", second: "Memory") -> "Memory":
        """The batch rows of `first`, then those of `second`."""
        return Memory(
            tuple(torch.cat(pair) for pair in zip(first.nodes, second.nodes, strict=True)),
            tuple(torch.cat(pair) for pair in zip(first.pairs, second.pairs, strict=True)),
        )


@dataclass(frozen=True)
class Belief:
    """What a forecaster thinks after the latest observation."""

    states: Float[Tensor, "batch agents state"]
    """The observation itself, SI units."""
    valid: Bool[Tensor, "batch agents"]
    """Who is present."""
    edge_probs: Float[Tensor, "batch agents agents types"]
    """Prior over edge types, receiver first; [1, 0, …] where there is no pair."""
    edge_features: Float[Tensor, "batch agents agents feature"]
    """Edge features from the past only; zero where there is no pair."""
    internal: Any = None
    """What the forecaster itself needs to roll out."""


def edgeless_belief(
    states: Float[Tensor, "batch agents state"],
    valid: Bool[Tensor, "batch agents"],
    num_edge_types: int,
    edge_feature_dim: int,
) -> Belief:
    """The belief of who knows no interactions: every pair has "no edge"."""
    batch, agents, _ = states.shape
    probs = states.new_zeros(batch, agents, agents, num_edge_types)
    probs[..., 0] = 1.0
    return Belief(states, valid, probs, states.new_zeros(batch, agents, agents, edge_feature_dim))


@runtime_checkable
class Forecaster(Protocol):
    """Anything that forecasts scenes step by step."""

    @property
    def spec(self) -> SceneSpec:
        """Layout of the scenes it takes."""

    @property
    def horizon_steps(self) -> int:
        """Steps it was trained to forecast."""

    @property
    def num_edge_types(self) -> int:
        """Edge types, "no edge" included."""

    @property
    def edge_feature_dim(self) -> int:
        """Size of an edge's features."""

    def empty_memory(self, batch: int, agents: int) -> Memory:
        """The memory before any observation."""

    def observe(
        self,
        memory: Memory,
        states: Float[Tensor, "batch agents state"],
        valid: Bool[Tensor, "batch agents"],
    ) -> tuple[Memory, Belief]:
        """Take in one instant [SI units]; cost does not depend on how much was seen before."""

    def rollout(
        self, belief: Belief, horizon_steps: int, num_samples: int = 1, generator: torch.Generator | None = None
    ) -> Float[Tensor, "batch samples agents horizon state"]:
        """Future states [SI units]: sample 0 follows the most likely graph, the others draw theirs."""


class WindowOutput(NamedTuple):
    """What the losses need from one batch of training windows; graph entries are None for models without a graph."""

    one_step: Float[Tensor, "batch time agents state"]
    """Teacher-forced prediction of the next state, for each step [SI]; under the posterior graph where there is one."""
    rollout: Float[Tensor, "batch agents horizon state"]
    """Free-running states after `last_observed` [SI]; under the prior graph where there is one."""
    prior_logits: Float[Tensor, "batch time agents agents types"] | None = None
    """Edge types from the past."""
    posterior_logits: Float[Tensor, "batch time agents agents types"] | None = None
    """Edge types from past and future."""
    features: Float[Tensor, "batch time agents agents feature"] | None = None
    """Edge features from the past."""


@runtime_checkable
class TrainableForecaster(Forecaster, Protocol):
    """A forecaster that `predictor.train` can fit; an `nn.Module` besides."""

    @property
    def config(self) -> Any:
        """Its sizes: a frozen dataclass of JSON values."""

    def window(
        self,
        states: Float[Tensor, "batch time agents state"],
        valid: Bool[Tensor, "batch time agents"],
        last_observed: Int[Tensor, " batch"],
        rollout_steps: int,
        generator: torch.Generator | None = None,
    ) -> WindowOutput:
        """Teacher-forced pass over all steps, and a free roll-out of `rollout_steps` after each `last_observed`.

        Args:
            states: true states [SI], zeros where not valid.
            valid: who is present.
            last_observed: index of the last step that the roll-out of a row has seen.
            rollout_steps: steps to roll out; 0 skips it (`rollout` then has no steps).
            generator: source of all noise.
        """
