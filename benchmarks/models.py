"""Models and inputs that the sections share."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from predictor.data.windows import WindowBatch
from predictor.dgvae import DGVAE
from predictor.dgvae.config import PRESETS, DGVAEConfig
from predictor.forecaster import Belief, Memory
from predictor.scene import AxisFrame, SceneSpec
from predictor.support.runtime import Precision, precision
from predictor.training.config import TrainConfig
from predictor.training.objective import window_loss

SIZES = ("fast", "paper")
"""Names of the presets that are measured."""


def road(agents: int) -> SceneSpec:
    """Returns the layout of kinematic scenes around an ego, as on highway-env's roads."""
    frame: tuple[AxisFrame, AxisFrame] = ("ego", "world")
    return SceneSpec(1.0, frame, max_agents=agents)


def box(agents: int) -> SceneSpec:
    """Returns the layout of kinematic scenes without an ego, as for springs."""
    scales = (1.0, 1.0, 1.0, 1.0)
    return SceneSpec(0.1, feature_scales=scales, has_ego=False, perception_m=1e6, max_agents=agents)


def sized(preset: str) -> DGVAEConfig:
    """Returns a preset whose roll-out stays finite without training: initial weights predict no change."""
    return replace(PRESETS[preset], zero_start=True)


def forecaster(config: DGVAEConfig, spec: SceneSpec, horizon_steps: int) -> DGVAE:
    """Makes an untrained model, ready to forecast."""
    torch.manual_seed(0)
    return DGVAE(spec, config, horizon_steps).eval().requires_grad_(False)


def scenes(batch: int, agents: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Returns states [m, m/s] of cars on a road, (batch, agents, 4), and `valid`, true for all of them."""
    generator = torch.Generator().manual_seed(seed)
    spread, mean = torch.tensor([50.0, 4.0, 3.0, 0.3]), torch.tensor([0.0, 0.0, 25.0, 0.0])
    states = torch.randn(batch, agents, 4, generator=generator) * spread + mean
    return states, torch.ones(batch, agents, dtype=torch.bool)


def observed(model: DGVAE, states: Tensor, valid: Tensor) -> tuple[Memory, Belief]:
    """Returns memory and belief after two equal scenes."""
    with torch.inference_mode():
        memory, _ = model.observe(model.empty_memory(*valid.shape), states, valid)
        return model.observe(memory, states, valid)


def inference(call: Callable[[], Any]) -> Callable[[], Any]:
    """Returns a function that makes the call without gradients."""
    return torch.inference_mode()(call)


class TrainingStep:
    """Makes training steps (window, loss, backward, Adam) on one batch of full windows.

    Args:
        config: sizes of the network.
        agents: number of agents of each window, all present throughout.
        steps: number of steps of each window.
        batch: number of windows.
        rollout_steps: number of steps of the roll-out at the window's end; 0 trains teacher-forced only.
        kind: precision of matrix products.
    """

    def __init__(
        self,
        config: DGVAEConfig,
        agents: int,
        steps: int,
        batch: int,
        rollout_steps: int = 0,
        kind: Precision = "float32",
    ) -> None:
        """Makes model, optimiser and windows."""
        torch.manual_seed(0)
        self.model = DGVAE(box(agents), config, max(1, rollout_steps)).train()
        self.rollout_steps = rollout_steps
        self._kind: Precision = kind
        self.last = steps - 1 - max(1, rollout_steps)
        self._optimizer = torch.optim.Adam(self.model.parameters(), lr=5e-4)
        states = 0.3 * torch.randn(batch, steps, agents, 4)
        valid = torch.ones(batch, steps, agents, dtype=torch.bool)
        self._batch = WindowBatch(states, valid, torch.full((batch,), self.last))
        nowhere = Path()
        weight = 1.0 if rollout_steps else 0.0
        self._config = TrainConfig((nowhere,), nowhere, rollout_weight=weight, one_step_weight=1.0)
        self._generator = torch.Generator().manual_seed(0)

    def timed(self) -> float:
        """Makes one step and returns its seconds."""
        began = time.perf_counter()
        self()
        return time.perf_counter() - began

    def __call__(self) -> None:
        """Makes one step."""
        batch = self._batch
        with precision(self._kind, "cpu"):
            output = self.model.window(
                batch.states, batch.valid, batch.last_observed, self.rollout_steps, self._generator
            )
        output = output.float()
        loss, _ = window_loss(self.model, batch, output, self._config, 1.0)
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self._optimizer.step()
