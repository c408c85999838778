"""How many floating-point operations the dG-VAE's matrix products need, counted from its config.

What is counted is what the mathematics needs, not what an implementation happens to execute, so that a rate cannot be
raised by wasteful work. A product of (m × k) and (k × n) counts 2·m·k·n. Free identities are assumed wherever they
save: a linear layer on x_i ‖ x_j costs agents, not pairs; the last layer of an edge MLP commutes with the sum over
senders; two linear layers in a row are one (embedding and EdgeConv, edge embedding and LSTM gates, messages and GRU
gates). Pairs are ordered and of two different agents. Not counted: everything element by element, softmax, the search
for neighbours, the optimiser. Backward counts twice forward. Only what the presets use is known here: innovation,
substeps and input changes would come on top.
"""

from dataclasses import dataclass

from predictor.dgvae.networks import DGVAEConfig

STATE = 4
"""Features of a kinematic state."""


@dataclass(frozen=True)
class Work:
    """FLOP of a config's parts, for one scene at one step.

    Args:
        config: sizes.
        agents: present.
        inputs: of an agent, the ego's mark included where there is one.
        neighbours: senders of each receiver; 0 is all others.
    """

    config: DGVAEConfig
    agents: int
    inputs: int = STATE + 1
    neighbours: int = 0

    @property
    def pairs(self) -> int:
        """Ordered pairs."""
        others = self.agents - 1
        return self.agents * (min(self.neighbours, others) if self.neighbours else others)

    @property
    def encode(self) -> float:
        """States to prior and features, one LSTM step included."""
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
        """Backward LSTM and posterior head."""
        c = self.config
        head = 2 * c.rnn_dim * c.head_dim + c.head_dim * c.num_edge_types
        return 2.0 * self.pairs * (self._gates + head)

    @property
    def features(self) -> float:
        """Edge features into messages; once per roll-out where the graph is frozen."""
        c = self.config
        return 2.0 * self.pairs * c.edge_feature_dim * self._types * c.message_dim

    @property
    def weigh(self) -> float:
        """Messages summed along a graph, GRU, read-out."""
        c, types = self.config, self._types
        gates = 3 * c.decoder_dim
        apart = types * c.message_dim**2 + self.inputs * c.message_dim + c.message_dim * gates
        joined = types * c.message_dim * gates + self.inputs * gates
        agent = _cheapest(apart, joined) + c.decoder_dim * gates + c.decoder_dim * STATE
        return 2.0 * (self.agents * agent + self.pairs * types * c.message_dim)

    @property
    def move(self) -> float:
        """A decoder step whose features are known already."""
        node = 2 * self.inputs * self._types * self.config.message_dim
        return 2.0 * self.agents * node + self.weigh

    def observe(self, batch: int = 1) -> float:
        """One scene of each batch row."""
        return batch * (self.encode + self.features + self.move)

    def rollout(self, horizon_steps: int, samples: int = 1, batch: int = 1, frozen: bool = False) -> float:
        """A free run; the first step of sample 0 is known from observing."""
        encodes, draws = horizon_steps - 1, samples - 1
        if frozen:
            moves = encodes + draws * horizon_steps
            return batch * (moves * self.move + (self.features if moves else 0.0))
        first = encodes * (self.encode + self.features + self.move)
        return batch * (samples * first + draws * (self.features + self.move))

    def training(self, batch: int, steps: int, rollout_steps: int = 0, last: int = 0) -> float:
        """Forward and backward of one batch of windows; the free run starts after step `last`."""
        forward = steps * (self.encode + self.posterior + self.features + self.move)
        if rollout_steps:
            forward += (last + 1) * self.weigh  # burn-in along the prior: hidden messages are those of above
            forward += self.rollout(rollout_steps) + self.features + self.move
        return 3.0 * batch * forward

    @property
    def _types(self) -> int:
        return self.config.num_edge_types - 1  # the first one is silent

    @property
    def _gates(self) -> int:
        return (self.config.hidden_dim + self.config.rnn_dim) * 4 * self.config.rnn_dim


def _cheapest(*ways: int) -> int:
    return min(ways)
