"""Simulates k-Spring (paper Sec. V-B): particles in a box, some pairs joined by springs, or charged particles.

`python -m predictor.data.springs --out data/springs` writes train, val, test and ood stores with the true graph and
spring constants. F_ij = −k (r_i − r_j) for joined pairs, elastic walls. Where the paper is silent (box, initial spread,
initial speed) the settings are those that NRI publishes. Motion is integrated by leapfrog in float64, many rollouts at
once: symplectic, so energy does not drift.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from rich.progress import Progress
from torch import Tensor

from predictor.data.store import Episode, StoreInfo, write_store
from predictor.scene import SceneSpec
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least, check_choices, check_positive
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import check_out
from predictor.support.provenance import provenance

DT_S = 1 / 6
FRAMES = 50
CHUNK = 2000


@dataclass(frozen=True)
class Physics:
    """Constants of the simulated box."""

    kind: Literal["springs", "charged"] = "springs"
    """Kind of interaction: springs (paper), or NRI's charged particles: attraction and repulsion with 1/r², without
    constants to infer."""
    num_agents: int = 5
    """Number of particles (paper: 5)."""
    box_m: float = 5.0
    """Distance of the walls from the origin (NRI: 5)."""
    position_std_m: float = 0.5
    """Standard deviation of the initial positions, Gaussian (NRI: 0.5)."""
    speed_mps: float = 0.5
    """Norm of the initial velocities, Gaussian in direction (NRI: 0.5)."""
    dt_s: float = DT_S
    """Time between frames (paper: 6 Hz)."""
    frames: int = FRAMES
    """Number of frames of a rollout (paper: 50)."""
    substeps: int = 50
    """Number of leapfrog steps per frame (charges: four times as many)."""
    softening_m: float = 0.1
    """Least distance of two charges in the force law, in place of NRI's cap on the force."""

    def __post_init__(self) -> None:
        """Checks choices and ranges.

        Raises:
            UserError: a value out of range.
        """
        check_choices(self)
        check_positive(self, "num_agents", "box_m", "position_std_m", "speed_mps", "dt_s", "substeps", "softening_m")
        check_at_least(self, 2, "frames")


@dataclass(frozen=True)
class SpringsConfig:
    """Simulates the k-Spring dataset (or charged particles) into train/, val/, test/ and ood/ under one folder."""

    out: Path
    """Folder for the four stores."""
    train: int = 50_000
    """Number of rollouts for training (paper: 50,000)."""
    val: int = 10_000
    """Number of rollouts for model selection (paper: 10,000)."""
    test: int = 10_000
    """Number of rollouts for the table (paper: 10,000)."""
    ood: int = 10_000
    """Number of rollouts out of distribution: p = 0.5, k ∈ {1, 2, 3} (charges: twice the strength)."""
    edge_probability: float = 0.7
    """Probability of a spring between two particles (paper: 0.7)."""
    seed: int = 0
    """Random seed for the rollouts; each split draws from its own stream."""
    overwrite: bool = False
    """Replace existing stores."""
    physics: Physics = Physics()
    """Constants of the simulated box."""

    def __post_init__(self) -> None:
        """Checks ranges.

        Raises:
            UserError: a value out of range.
        """
        check_at_least(self, 0, "train", "val", "test", "ood", "seed")
        if not 0 <= self.edge_probability <= 1:
            raise UserError(f"edge_probability must lie between 0 and 1, got {self.edge_probability}")


def draw_springs(
    count: int, agents: int, probability: float, generator: torch.Generator, constants: tuple[float, ...] = ()
) -> Float[Tensor, "count agents agents"]:
    """Draws symmetric spring constants, 0 where there is no spring; k ~ U(0.5, 2), or one of `constants`."""
    shape = (count, agents, agents)
    joined = torch.rand(shape, generator=generator) < probability
    if constants:
        choice = torch.randint(len(constants), shape, generator=generator)
        values = torch.tensor(constants)[choice]
    else:
        values = 0.5 + 1.5 * torch.rand(shape, generator=generator)
    upper = torch.triu(torch.where(joined, values, 0.0), diagonal=1)
    return upper + upper.transpose(1, 2)


def draw_charges(
    count: int, agents: int, strength: float, generator: torch.Generator
) -> Float[Tensor, "count agents agents"]:
    """Draws products of random charges ±1, times the strength; a positive one repels."""
    charge = torch.randint(2, (count, agents), generator=generator) * 2.0 - 1.0
    products = strength * charge[:, :, None] * charge[:, None, :]
    return products * (1 - torch.eye(agents))


def draw_start(
    count: int, physics: Physics, generator: torch.Generator
) -> tuple[Float[Tensor, "count agents 2"], Float[Tensor, "count agents 2"]]:
    """Draws initial positions [m] and velocities [m/s]."""
    shape = (count, physics.num_agents, 2)
    positions = physics.position_std_m * torch.randn(shape, generator=generator)
    velocities = torch.randn(shape, generator=generator)
    velocities = physics.speed_mps * velocities / torch.linalg.vector_norm(velocities, dim=-1, keepdim=True)
    return positions.double(), velocities.double()


def simulate(
    physics: Physics,
    couplings: Float[Tensor, "count agents agents"],
    positions: Float[Tensor, "count agents 2"],
    velocities: Float[Tensor, "count agents 2"],
) -> Float[Tensor, "count frames agents 4"]:
    """Computes positions [m] and velocities [m/s] at every frame, the given ones first.

    Args:
        physics: constants of the box.
        couplings: spring constants [N/m at unit mass], or charge products.
        positions: initial positions [m], float64.
        velocities: initial velocities [m/s], float64.
    """
    couplings = couplings.double()
    substeps = physics.substeps * (1 if physics.kind == "springs" else 4)
    step_s = physics.dt_s / substeps
    # For springs the force is linear: −L r with the graph's weighted Laplacian, one product for both axes.
    kick = (couplings - torch.diag_embed(couplings.sum(-1))) * step_s
    frames = [torch.cat([positions, velocities], dim=-1)]

    def kicked(velocities: Tensor, share: float) -> Tensor:
        if physics.kind == "springs":
            return torch.baddbmm(velocities, kick, positions, alpha=share)
        return velocities + share * step_s * _charge_force(couplings, positions, physics.softening_m)

    for _ in range(physics.frames - 1):
        velocities = kicked(velocities, 0.5)
        for substep in range(substeps):
            positions = positions + velocities * step_s
            positions, velocities = _reflect(positions, velocities, physics.box_m)
            # Two consecutive half kicks are one whole kick.
            velocities = kicked(velocities, 1.0 if substep < substeps - 1 else 0.5)
        frames.append(torch.cat([positions, velocities], dim=-1))
    return torch.stack(frames, dim=1)


def energy(
    couplings: Float[Tensor, "count agents agents"], states: Float[Tensor, "count frames agents 4"]
) -> Float[Tensor, "count frames"]:
    """Computes kinetic plus elastic energy of springs [J at unit mass]."""
    kinetic = 0.5 * states[..., 2:].square().sum((-1, -2))
    distance = states[..., None, :2] - states[..., None, :, :2]
    elastic = 0.25 * (couplings.double()[:, None] * distance.square().sum(-1)).sum((-1, -2))
    return kinetic + elastic


def _charge_force(couplings: Tensor, positions: Tensor, softening_m: float) -> Tensor:
    apart = positions[:, :, None] - positions[:, None]
    squared = apart.square().sum(-1) + softening_m**2
    return ((couplings / (squared * squared.sqrt()))[..., None] * apart).sum(2)


def _reflect(positions: Tensor, velocities: Tensor, box_m: float) -> tuple[Tensor, Tensor]:
    outside: Bool[Tensor, "count agents 2"] = positions.abs() > box_m
    if not bool(outside.any()):
        return positions, velocities
    mirrored = 2 * box_m * positions.sign() - positions
    return torch.where(outside, mirrored, positions), torch.where(outside, -velocities, velocities)


def make_episodes(config: SpringsConfig, split: str, count: int) -> list[Episode]:
    """Simulates one split."""
    physics = config.physics
    stream = ("train", "val", "test", "ood").index(split)
    generator = torch.Generator().manual_seed(int(np.random.default_rng([config.seed, stream]).integers(2**62)))
    shifted = split == "ood"
    if physics.kind == "springs":
        constants = (1.0, 2.0, 3.0) if shifted else ()
        probability = 0.5 if shifted else config.edge_probability
        couplings = draw_springs(count, physics.num_agents, probability, generator, constants)
    else:
        couplings = draw_charges(count, physics.num_agents, 2.0 if shifted else 1.0, generator)
    positions, velocities = draw_start(count, physics, generator)
    parts = [
        simulate(physics, *(t[i : i + CHUNK] for t in (couplings, positions, velocities))).float().numpy()
        for i in range(0, count, CHUNK)
    ]
    states = np.concatenate(parts)
    # Springs: 0 none, 1 spring. Charges: 0 none (never), 1 attraction, 2 repulsion.
    signs = couplings.sign().numpy()
    types = (signs if physics.kind == "springs" else np.where(signs > 0, 2, -signs)).astype(np.int8)
    attributes = couplings.abs().float().numpy()[..., None]
    present = np.ones(states.shape[1:3], dtype=np.bool_)
    ids = np.arange(physics.num_agents)
    return [Episode(states[i], present, ids, split, i, types[i][None], attributes[i][None]) for i in range(count)]


def spring_spec(physics: Physics) -> SceneSpec:
    """Returns the layout of the states: world frame, since the walls stand in it; scales of order one."""
    return SceneSpec(
        physics.dt_s,
        feature_scales=(1.0, 1.0, 1.0, 1.0),
        has_ego=False,
        perception_m=1e6,
        max_agents=physics.num_agents,
    )


def make(config: SpringsConfig) -> dict[str, float]:
    """Simulates and writes every split that has rollouts; returns the time of each [s].

    Raises:
        UserError: `out` is a file, a split exists, or no split has rollouts.
    """
    check_out(config.out)
    took: dict[str, float] = {}
    attribute = "spring_constant" if config.physics.kind == "springs" else "charge_product"
    made = provenance(("torch", "numpy", "zarr"))
    splits = {name: getattr(config, name) for name in ("train", "val", "test", "ood")}
    splits = {name: count for name, count in splits.items() if count}
    if not splits:
        raise UserError("nothing to simulate: train, val, test and ood are all 0")
    for name in splits:
        if (config.out / name).exists() and not config.overwrite:
            raise UserError(f"{config.out / name} exists; choose another --out or pass --overwrite")
    with Progress() as progress:
        task = progress.add_task("simulate", total=sum(splits.values()))
        for name, count in splits.items():
            began = time.perf_counter()
            source = f"{config.physics.num_agents}-{config.physics.kind}"
            info = StoreInfo(spring_spec(config.physics), source, made | {"split": name}, (attribute,))
            write_store(config.out / name, info, make_episodes(config, name, count), config.overwrite)
            took[name] = time.perf_counter() - began
            progress.advance(task, count)
    return took


def main() -> None:
    """Entry point."""
    config = parse(SpringsConfig, __doc__)
    for name, seconds in make(config).items():
        print(f"{config.out / name}: {getattr(config, name)} rollouts in {seconds:.1f} s")


if __name__ == "__main__":
    run_entry_point(main)
