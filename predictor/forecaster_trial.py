"""The made-up motion on which `predictor.testing` runs a forecaster."""

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from predictor.forecaster import Belief, Forecaster, Memory
from predictor.noise import Noise
from predictor.scene import SceneSpec

SCENES, AGENTS, STEPS, SAMPLES = 3, 4, 6, 3
TOLERANCE = 1e-3
"""Largest difference of forecasts that are equal but for rounding, in units of `SceneSpec.feature_scales`."""


@dataclass
class Trial:
    """A forecaster and the motion that it is shown."""

    forecaster: Forecaster
    device: str
    seed: int
    states: Float[Tensor, "scenes time agents state"] = field(init=False)
    """Agents on straight lines, in the axes that the forecaster gets: relative to the ego where its frame says so."""
    valid: Bool[Tensor, "scenes agents"] = field(init=False)
    """Which agents are there; the last one of the second scene is not."""

    def __post_init__(self) -> None:
        """Makes the motion."""
        spec, rng = self.spec, np.random.default_rng(self.seed)
        axes, scales = spec.position_dim, np.array(spec.feature_scales)
        states = np.zeros((SCENES, STEPS, AGENTS, spec.num_features))
        start = rng.uniform(-0.4, 0.4, (SCENES, 1, AGENTS, axes)) * scales[:axes]
        speed = rng.uniform(0.4, 0.8, (SCENES, 1, AGENTS, axes)) * rng.choice([-1, 1], (SCENES, 1, AGENTS, axes))
        velocity = speed * scales[axes : 2 * axes]
        time_s = spec.dt_s * np.arange(STEPS)[None, :, None, None]
        states[..., :axes], states[..., axes : 2 * axes] = start + velocity * time_s, velocity
        states[..., 2 * axes :] = rng.integers(0, 2, (SCENES, 1, AGENTS, spec.num_features - 2 * axes))
        ego_axes = np.array([frame == "ego" for frame in spec.frame])
        states[..., :axes] -= states[:, :, :1, :axes] * ego_axes
        valid = np.ones((SCENES, AGENTS), dtype=np.bool_)
        valid[1, -1] = False
        states[1, :, -1] = 0.0
        self.states = torch.from_numpy(states.astype(np.float32)).to(self.device)
        self.valid = torch.from_numpy(valid).to(self.device)

    @property
    def spec(self) -> SceneSpec:
        """Layout of the scenes."""
        return self.forecaster.spec

    @property
    def horizon(self) -> int:
        """Number of steps of the forecasts that are tried."""
        return min(5, self.forecaster.horizon_steps)

    def observed(self, states: Tensor | None = None, valid: Tensor | None = None) -> tuple[Memory, Belief]:
        """Shows the forecaster a history, step by step."""
        states, valid = (self.states if states is None else states), (self.valid if valid is None else valid)
        memory = self.forecaster.empty_memory(states.shape[0], states.shape[2])
        for step in range(states.shape[1]):
            memory, belief = self.forecaster.observe(memory, states[:, step].clone(), valid)
        return memory, belief

    def single(self, belief: Belief) -> Float[Tensor, "scenes agents horizon state"]:
        """Returns the single forecast, zeros for absent agents."""
        futures = self.forecaster.rollout(belief, self.horizon)
        return futures.states[:, 0] * belief.valid[:, :, None, None]

    def differ(self, one: Tensor, other: Tensor) -> bool:
        """Returns whether two forecasts differ by more than rounding."""
        scales = torch.tensor(self.spec.feature_scales, device=one.device)
        return bool(((one - other).abs() / scales).max() > TOLERANCE)

    def noise(self, scenes: int = SCENES, first: int = 0) -> Noise:
        """Returns a generator for each scene; scene i has the same one whatever the others are."""
        return [np.random.default_rng((self.seed, first + i)) for i in range(scenes)]
