"""Predict, compare, correct: how the encoder finds out what an edge does (not in the paper).

An LSTM per pair sees two agents and a summary of the rest. What an edge does to its receiver can only be told once the
other edges' share is taken off, so each pair has to know what all the others are believed to do. Here each pair's
memory weighs learned regressors of the pair; their sum over senders is what the receiver was expected to show, the
difference to what it shows is the innovation, and the innovation times the regressor is how the pair should change its
mind. It is one step of least mean squares in a learned space, as in a Kalman filter's correction; the LSTM decides
what to do with it.
"""

from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from predictor.layers.pairs import PairLinear


class Innovation(nn.Module):
    """Corrections to pair memories from what was observed at one step.

    Args:
        inputs: size of an agent's input.
        memory: size of a pair's memory.
        width: of the learned space.
        rounds: corrections at each step; a later one sees what the earlier one changed.
    """

    def __init__(self, inputs: int, memory: int, width: int, rounds: int) -> None:
        """Layers in the order in which data passes."""
        super().__init__()
        self.regressor_linear = PairLinear(inputs, width)
        self.regressor_pair = PairLinear(inputs, width)
        self.regressor_out = nn.Linear(width, width)
        self.target = nn.Linear(inputs, width)
        self.weigh = nn.Linear(memory, width)
        self.correct_own = nn.ModuleList([nn.Linear(width, memory) for _ in range(rounds)])
        self.correct_other = nn.ModuleList([nn.Linear(width, memory, bias=False) for _ in range(rounds)])

    def prepare(
        self, inputs: Float[Tensor, "*batch agents inputs"], pairs: Bool[Tensor, "*batch agents agents"]
    ) -> tuple[Float[Tensor, "*batch agents agents width"], Float[Tensor, "*batch agents width"]]:
        """Regressors of each pair and targets of each agent; all steps at once, since no memory enters."""
        curved = self.regressor_out(functional.elu(self.regressor_pair(inputs)))
        regressors = (self.regressor_linear(inputs) + curved) * pairs[..., None]
        return regressors, self.target(inputs)

    def forward(
        self,
        memory: Float[Tensor, "batch agents agents memory"],
        regressors: Float[Tensor, "batch agents agents width"],
        targets: Float[Tensor, "batch agents width"],
    ) -> Float[Tensor, "batch agents agents memory"]:
        """Σ over rounds of W (φ_ij ⊙ ε_i ‖ φ_ji ⊙ ε_j), with ε_i = τ_i − Σ_j w(h_ij) ⊙ φ_ij."""
        believed = memory
        for own, other in zip(self.correct_own, self.correct_other, strict=True):
            innovation = targets - (self.weigh(believed) * regressors).sum(-2)
            gradient = regressors * innovation[..., :, None, :]
            believed = believed + own(gradient) + other(gradient).transpose(-2, -3)
        return believed - memory
