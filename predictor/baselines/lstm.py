"""An LSTM between two linear layers (64–128–64), as in the paper's comparison (Sec. V): one per scene, or per agent.

The paper's processes all agents at once (`joint=True`): its input is the states of a fixed number of agents side by
side, so agents are identified by their column, permuting them changes the forecast, and it fits fixed groups only (a
team, a skeleton). `joint=False` runs the same network on every agent by itself and takes any number of them.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from predictor.baselines.base import Tensors, UnrolledForecaster, check_sizes
from predictor.layers.rnn import full_precision
from predictor.layers.state_codec import Residual
from predictor.scene import MOST_AGENTS, SceneSpec
from predictor.support.config_checks import check_at_most
from predictor.support.errors import UserError


@dataclass(frozen=True)
class LSTMConfig:
    """Sizes of the network; the defaults are the paper's (Sec. V)."""

    joint: bool = False
    """Whether there is one LSTM for the whole scene, as in the paper, rather than one per agent."""
    num_agents: int = 0
    """Number of agents of the joint variant; 0 takes the spec's `max_agents`. Not used otherwise."""
    embed_dim: int = 64
    """Width of the linear layers before and after the LSTM."""
    rnn_dim: int = 128
    """Width of the LSTM."""
    residual: Residual = "state"
    """Position to which the predicted change is added; see `predictor.layers.state_codec`."""
    delta_scales: tuple[float, ...] = ()
    """Typical one-step change of each feature [SI]; empty takes the spec's feature scales."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        check_sizes(self, "embed_dim", "rnn_dim")
        check_at_most(self, MOST_AGENTS, "num_agents")
        if self.num_agents < 0:
            raise UserError(f"num_agents must be positive, or 0 for the spec's max_agents; got {self.num_agents}")


class LSTM(UnrolledForecaster):
    """Network of linear → ReLU → LSTM → linear → ReLU → linear.

    The joint variant has one memory for the scene. Every present agent has a copy of it, with a mark, so that `Memory`
    moves it like any agent's; it is taken from an agent that was present before and still is. A scene's memory is thus
    kept as long as one agent stays, and starts anew when all agents were replaced.

    Args:
        spec: layout of the scenes.
        config: sizes of the network.
        horizon_steps: number of steps that it is trained to forecast.
    """

    def __init__(self, spec: SceneSpec, config: LSTMConfig | None = None, horizon_steps: int = 5) -> None:
        """Builds the network; weights are drawn from torch's generator, so seed it first."""
        config = config or LSTMConfig()
        super().__init__(spec, config.residual, config.delta_scales, horizon_steps)
        self.config = config
        self.columns = (config.num_agents or spec.max_agents) if config.joint else 1
        self.node_sizes = (config.rnn_dim, config.rnn_dim) + ((1,) if config.joint else ())
        self.embed = nn.Linear(self.columns * self.codec.num_inputs, config.embed_dim)
        self.cell = nn.LSTMCell(config.embed_dim, config.rnn_dim)
        self.hidden = nn.Linear(config.rnn_dim, config.embed_dim)
        self.readout = nn.Linear(config.embed_dim, self.columns * spec.num_features)

    def recur(
        self,
        inputs: Float[Tensor, "batch agents inputs"],
        valid: Bool[Tensor, "batch agents"],
        weights: Float[Tensor, "batch agents agents weights"],
        nodes: Tensors,
    ) -> Tensors:
        """Computes one LSTM step per agent, or one per scene."""
        present = valid[..., None]
        if not self.config.joint:
            flat = [t.flatten(0, 1) for t in (inputs, *nodes)]
            hidden, cell = self._step(flat[0], flat[1], flat[2])
            return hidden.view_as(nodes[0]) * present, cell.view_as(nodes[1]) * present
        *memory, mark = nodes
        hidden, cell = (_of_first(m, valid & (mark[..., 0] > 0)) for m in memory)
        hidden, cell = self._step(self._side_by_side(inputs, valid), hidden, cell)
        return hidden[:, None] * present, cell[:, None] * present, present.to(inputs.dtype)

    def change(
        self,
        inputs: Float[Tensor, "*batch agents inputs"],
        valid: Bool[Tensor, "*batch agents"],
        nodes: Tensors,
    ) -> Float[Tensor, "*batch agents state"]:
        """Computes the change of state from the hidden state; in the joint variant each agent has its own columns."""
        hidden = _of_first(nodes[0], valid) if self.config.joint else nodes[0]
        change: Tensor = self.readout(torch.relu(self.hidden(hidden)))
        if self.config.joint:
            change = change.unflatten(-1, (self.columns, -1))
            change = functional.pad(change, (0, 0, 0, valid.shape[-1] - self.columns))
        return change

    def _step(
        self, inputs: Float[Tensor, "rows inputs"], hidden: Float[Tensor, "rows rnn"], cell: Float[Tensor, "rows rnn"]
    ) -> tuple[Float[Tensor, "rows rnn"], Float[Tensor, "rows rnn"]]:
        embedded = torch.relu(self.embed(inputs)).to(hidden.dtype)
        with full_precision(inputs.device):
            hidden, cell = self.cell(embedded, (hidden, cell))
        return hidden, cell

    def _side_by_side(
        self, inputs: Float[Tensor, "batch agents inputs"], valid: Bool[Tensor, "batch agents"]
    ) -> Float[Tensor, "batch columns"]:
        extra = valid.shape[1] - self.columns
        if extra > 0 and valid[:, self.columns :].any():
            needed = 1 + int(valid.any(0).nonzero().max())
            raise UserError(
                f"this joint LSTM takes {self.columns} agents at fixed places, but place {needed - 1} holds one too; "
                f"train with num_agents={needed} or joint=False"
            )
        return functional.pad(inputs, (0, 0, 0, -extra)).flatten(1)


def _of_first(
    memory: Float[Tensor, "*batch agents hidden"], chosen: Bool[Tensor, "*batch agents"]
) -> Float[Tensor, "*batch hidden"]:
    """Returns the memory of the first chosen agent; zeros if there is none."""
    first = chosen.to(torch.uint8).argmax(-1)[..., None, None].expand(*chosen.shape[:-1], 1, memory.shape[-1])
    return memory.gather(-2, first).squeeze(-2) * chosen.any(-1, keepdim=True)
