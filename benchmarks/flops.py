"""Counts the floating-point operations (FLOP) of the dG-VAE's matrix products from its config.

The count is the least that the mathematics needs, not what an implementation executes, so that wasteful work cannot
raise a rate. A product of (m × k) and (k × n) counts 2·m·k·n. Algebraic identities are used wherever they save work: a
linear layer on x_i ‖ x_j is computed for each agent, not for each pair; the last layer of an edge MLP commutes with the
sum over senders; two consecutive linear layers are one (embedding and EdgeConv, edge embedding and LSTM gates, messages
and GRU gates). Pairs are ordered, of two different agents. Not counted: element-wise operations, softmax, the search
for neighbours, the optimiser. Backward counts twice forward. Only what the presets use is counted, not innovation,
substeps or input changes.
"""

from dataclasses import dataclass

from predictor.dgvae.config import DGVAEConfig

STATE = 4
"""Number of features of a kinematic state."""


@dataclass(frozen=True)
class Work:
    """Counts the FLOP of a network's parts, for one scene at one step.

    Args:
        config: sizes of the network.
        agents: number of agents in the scene.
        inputs: number of input features of an agent, the ego's mark included where there is one.
        neighbours: number of senders of each receiver; 0 takes all other agents.
    """

    config: DGVAEConfig
    agents: int
    inputs: int = STATE + 1
    neighbours: int = 0

    @property
    def pairs(self) -> int:
        """Number of ordered pairs."""
        others = self.agents - 1
        return self.agents * (min(self.neighbours, others) if self.neighbours else others)

    @property
    def encode(self) -> float:
        """FLOP from states to prior and edge features, one LSTM step included."""
        c = self.config
        embedded = _cheapest(2 * self.inputs * c.hidden_dim, self.inputs * c.hidden_dim + 2 * c.hidden_dim**2)
        agent = embedded + 3 * c.hidden_dim**2
        heads = c.rnn_dim * c.head_dim + c.head_dim * c.num_edge_types
        if c.edge_feature_dim:
            heads += c.rnn_dim * c.head_dim + c.head_dim * c.edge_feature_dim
        pair = self._gates + heads
        return 2.0 * (self.agents * agent + self.pairs * pair)

    @property
    def posterior(self) -> float:
        """FLOP of the backward LSTM and the posterior head."""
        c = self.config
        head = 2 * c.rnn_dim * c.head_dim + c.head_dim * c.num_edge_types
        return 2.0 * self.pairs * (self._gates + head)

    @property
    def features(self) -> float:
        """FLOP from edge features to messages; needed once per roll-out where the graph is frozen."""
        c = self.config
        return 2.0 * self.pairs * c.edge_feature_dim * self._types * c.message_dim

    @property
    def weigh(self) -> float:
        """FLOP of the sum of messages along a graph, the GRU and the read-out."""
        c, types = self.config, self._types
        gates = 3 * c.decoder_dim
        apart = types * c.message_dim**2 + self.inputs * c.message_dim + c.message_dim * gates
        joined = types * c.message_dim * gates + self.inputs * gates
        agent = _cheapest(apart, joined) + c.decoder_dim * gates + c.decoder_dim * STATE
        return 2.0 * (self.agents * agent + self.pairs * types * c.message_dim)

    @property
    def move(self) -> float:
        """FLOP of a decoder step with known edge features."""
        node = 2 * self.inputs * self._types * self.config.message_dim
        return 2.0 * self.agents * node + self.weigh

    def observe(self, batch: int = 1) -> float:
        """Returns the FLOP of observing one scene per environment of a batch."""
        return batch * (self.encode + self.features + self.move)

    def rollout(self, horizon_steps: int, samples: int = 1, batch: int = 1, frozen: bool = False) -> float:
        """Returns the FLOP of a roll-out; the first step of sample 0 is known from observing."""
        encodes, draws = horizon_steps - 1, samples - 1
        if frozen:
            moves = encodes + draws * horizon_steps
            return batch * (moves * self.move + (self.features if moves else 0.0))
        first = encodes * (self.encode + self.features + self.move)
        return batch * (samples * first + draws * (self.features + self.move))

    def training(self, batch: int, steps: int, rollout_steps: int = 0, last: int = 0) -> float:
        """Returns the FLOP of forward and backward of a batch of windows; the roll-out starts after step `last`."""
        forward = steps * (self.encode + self.posterior + self.features + self.move)
        if rollout_steps:
            forward += (last + 1) * self.weigh  # burn-in with the prior: its hidden messages are known from above
            forward += self.rollout(rollout_steps) + self.features + self.move
        return 3.0 * batch * forward

    @property
    def _types(self) -> int:
        return self.config.num_edge_types - 1  # the first one means no edge

    @property
    def _gates(self) -> int:
        return (self.config.hidden_dim + self.config.rnn_dim) * 4 * self.config.rnn_dim


def _cheapest(*ways: int) -> int:
    return min(ways)
