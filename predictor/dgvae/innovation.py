"""Corrections of pair memories by prediction errors (not in the paper): predict, compare, correct.

The input of each pair's LSTM is two agents and a summary of the rest. The effect of one edge on its receiver can be
estimated only after the effects of the other edges are subtracted. Here each pair's memory weighs learned regressors of
the pair. Their sum over senders is the predicted motion of the receiver; observed minus predicted motion is the
innovation; innovation times regressor is the correction of the pair. This is one step of least mean squares in a
learned space, as in a Kalman filter; the correction is one more input of the LSTM's gates.
"""

from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from predictor.layers.pairs import PairLinear


class Innovation(nn.Module):
    """Computes corrections to pair memories from the observation of one step.

    Args:
        inputs: number of an agent's inputs.
        memory: size of a pair's memory.
        width: dimension of the learned space.
        rounds: number of corrections at each step; a later one starts from the result of the earlier one.
    """

    def __init__(self, inputs: int, memory: int, width: int, rounds: int) -> None:
        """Creates the layers, in the order in which data passes them."""
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
        """Computes regressors of each pair and targets of each agent, for all steps at once: no memory is involved."""
        curved = self.regressor_out(functional.elu(self.regressor_pair(inputs)))
        regressors = (self.regressor_linear(inputs) + curved) * pairs[..., None]
        return regressors, self.target(inputs)

    def forward(
        self,
        memory: Float[Tensor, "batch agents agents memory"],
        regressors: Float[Tensor, "batch agents agents width"],
        targets: Float[Tensor, "batch agents width"],
    ) -> Float[Tensor, "batch agents agents memory"]:
        """Computes Σ over rounds of W (φ_ij ⊙ ε_i ‖ φ_ji ⊙ ε_j), with ε_i = τ_i − Σ_j w(h_ij) ⊙ φ_ij."""
        believed = memory
        for own, other in zip(self.correct_own, self.correct_other, strict=True):
            innovation = targets - (self.weigh(believed) * regressors).sum(-2)
            gradient = regressors * innovation[..., :, None, :]
            believed = believed + own(gradient) + other(gradient).transpose(-2, -3)
        return believed - memory
