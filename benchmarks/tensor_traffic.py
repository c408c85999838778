"""Traffic in torch tensors, many roads at once: agents that move straight, enter and leave, and episodes that end.

It stands for any environment that keeps its state in arrays; `benchmarks.rows` measures forecasts with it.
"""

import torch

from envs.readers.batched import AgentTensors
from predictor.scene import SceneSpec

LEAVES, ENTERS, ENDS = 0.1, 0.09, 0.02
"""Probabilities in a step: that an agent leaves, that an empty entry gets a new agent, that an episode ends."""


def spec(agents: int, dt_s: float = 1.0) -> SceneSpec:
    """Returns the layout of the scenes: a road along x, around an ego."""
    return SceneSpec(dt_s=dt_s, frame=("ego", "world"), max_agents=agents)


class TensorTraffic:
    """Steps many roads at once; on average about half of the entries hold an agent.

    Args:
        rows: number of roads.
        agents: number of entries for agents on each, the ego included.
        seed: random seed.

    Attributes:
        begun: which roads began a new episode in the last step.
    """

    def __init__(self, rows: int, agents: int, seed: int = 0) -> None:
        """Begins an episode on every road."""
        self._random = torch.Generator().manual_seed(seed)
        self._states = torch.zeros(rows, agents, 4, dtype=torch.float64)
        self._valid = torch.zeros(rows, agents, dtype=torch.bool)
        self._ids = torch.zeros(rows, agents, dtype=torch.int64)
        self._next = torch.ones(rows, dtype=torch.int64)
        self.begun = torch.ones(rows, dtype=torch.bool)
        self._begin()

    @property
    def agents(self) -> AgentTensors:
        """Returns the state of all roads."""
        return AgentTensors(self._states, self._valid, self._ids)

    def step(self) -> None:
        """Moves all agents by a second; some leave, some enter, some episodes end."""
        self._states[..., :2] += self._states[..., 2:]
        self._valid &= self._drawn() > LEAVES
        self._enter(~self._valid & (self._drawn() < ENTERS))
        self.begun = torch.rand(len(self._valid), generator=self._random) < ENDS
        self._begin()

    def _begin(self) -> None:
        """Begins episodes where `begun` says so."""
        there = self.begun[:, None]
        self._states.masked_fill_(there[..., None], 0.0)
        self._ids.masked_fill_(there, 0)
        self._next.masked_fill_(self.begun, 1)
        self._valid &= ~there
        self._enter(there & (self._drawn() < 0.5))

    def _enter(self, entries: torch.Tensor) -> None:
        """Puts new agents near the ego; the ego itself is always there, with the number 0."""
        entries[:, 0] = False
        spread = torch.tensor([30.0, 4.0, 3.0, 0.1], dtype=torch.float64)
        drawn = torch.randn(self._states.shape, generator=self._random, dtype=torch.float64) * spread
        drawn[..., 0] += self._states[:, :1, 0]
        drawn[..., 2] += 25.0
        self._states = torch.where(entries[..., None], drawn, self._states)
        self._ids = torch.where(entries, self._next[:, None] + entries.cumsum(1) - 1, self._ids)
        self._next += entries.sum(1)
        self._valid |= entries
        self._valid[:, 0], self._ids[:, 0], self._states[:, 0, 2] = True, 0, 25.0

    def _drawn(self) -> torch.Tensor:
        return torch.rand(self._valid.shape, generator=self._random)
