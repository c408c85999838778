"""Two layers from an agent's state to its change of state: "Linear" in the paper's tables.

The past and the other agents are no inputs, so the difference to other models shows what these are worth.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from predictor.baselines.base import Tensors, UnrolledForecaster, check_sizes
from predictor.layers.state_codec import Residual
from predictor.scene import SceneSpec


@dataclass(frozen=True)
class MLPConfig:
    """Sizes of the network; the default is the paper's (Sec. V)."""

    hidden_dim: int = 256
    """Width of the hidden layer."""
    residual: Residual = "state"
    """Position to which the predicted change is added; see `predictor.layers.state_codec`."""
    delta_scales: tuple[float, ...] = ()
    """Typical one-step change of each feature [SI]; empty takes the spec's feature scales."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        check_sizes(self, "hidden_dim")


class MLP(UnrolledForecaster):
    """Network of two layers, with the same weights for every agent and every step.

    Args:
        spec: layout of the scenes.
        config: sizes of the network.
        horizon_steps: number of steps that it is trained to forecast.
    """

    def __init__(self, spec: SceneSpec, config: MLPConfig | None = None, horizon_steps: int = 5) -> None:
        """Builds the network; weights are drawn from torch's generator, so seed it first."""
        config = config or MLPConfig()
        super().__init__(spec, config.residual, config.delta_scales, horizon_steps)
        self.config = config
        self.hidden = nn.Linear(self.codec.num_inputs, config.hidden_dim)
        self.readout = nn.Linear(config.hidden_dim, spec.num_features)

    def change(
        self,
        inputs: Float[Tensor, "*batch agents inputs"],
        valid: Bool[Tensor, "*batch agents"],
        nodes: Tensors,
    ) -> Float[Tensor, "*batch agents state"]:
        """Computes W₂ relu(W₁ x)."""
        change: Tensor = self.readout(torch.relu(self.hidden(inputs)))
        return change
