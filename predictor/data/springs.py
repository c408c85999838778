"""Simulates k-Spring (paper Sec. V-B): particles in a box, some pairs joined by springs, or charged particles.

`python -m predictor.data.springs --out data/springs` writes train, val, test and ood stores with the true graph and
spring constants. F_ij = −k (r_i − r_j) for joined pairs, elastic walls. Where the paper is silent (box, initial spread,
initial speed) the settings are those that NRI publishes. Motion is integrated by leapfrog in float64, many rollouts at
once: symplectic, so energy does not drift.
"""

import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from predictor.data.store import PERTURBATIONS, Episode, StoreInfo, write_store
from predictor.scene import SceneSpec
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least, check_choices, check_positive
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import check_out
from predictor.support.memory import check_count
from predictor.support.progress import WorkShown
from predictor.support.provenance import provenance
from predictor.support.remote import address, exists

DT_S = 1 / 6
FRAMES = 50
CHUNK = 2000
STATE_BYTES = 16
"""Memory of the position and velocity of a particle in a frame [bytes]."""
CHARGE_SUBSTEPS = 4
"""Number of leapfrog steps of charges for each one of springs."""


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
    """Least distance of two charges in the force law; with 0 the law is 1/r², and needs `largest_force`."""
    largest_force: float = 0.0
    """Largest force of charges on a particle along an axis [N at unit mass] (NRI: 100); 0 is no limit."""

    def __post_init__(self) -> None:
        """Checks choices and ranges.

        Raises:
            UserError: a value out of range.
        """
        check_choices(self)
        check_positive(self, "num_agents", "box_m", "position_std_m", "speed_mps", "dt_s", "substeps")
        check_at_least(self, 0, "softening_m", "largest_force")
        check_at_least(self, 2, "frames")
        if self.softening_m == self.largest_force == 0:
            raise UserError("softening_m and largest_force are both 0; charges that meet would have an infinite force")


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
    """Probability of a spring between two particles (paper: 0.7); charges act on all pairs."""
    kicks: float = 0.0
    """Share of rollouts in which one particle is kicked: at a random frame its velocity changes by `kick_mps` in a
    random direction. The store marks the kicked particle from the frame before (`perturbed`). 0 simulates none."""
    kick_mps: float = 1.0
    """Change of velocity by a kick [m/s]; particles move at about 0.5 m/s."""
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
        if self.physics.kind == "charged" and self.edge_probability != SpringsConfig.edge_probability:
            raise UserError(f"charges act on all pairs, got edge_probability {self.edge_probability}; leave it out")
        if not 0 <= self.kicks <= 1:
            raise UserError(f"kicks must lie between 0 and 1, got {self.kicks}")
        check_positive(self, "kick_mps")
        for name in ("train", "val", "test", "ood"):
            check_count(getattr(self, name), name, STATE_BYTES * self.physics.num_agents * self.physics.frames)


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


def draw_kicks(
    count: int, physics: Physics, share: float, kick_mps: float, generator: torch.Generator
) -> tuple[Int[Tensor, " count"], Float[Tensor, "count agents 2"]]:
    """Draws one kick per rollout: the frame after which it comes, and the change of each particle's velocity [m/s].

    Rollouts without a kick have frame -1 and no change; one particle is kicked in the others.
    """
    frame = torch.randint(physics.frames - 1, (count,), generator=generator)
    particle = torch.randint(physics.num_agents, (count,), generator=generator)
    angle = 2 * torch.pi * torch.rand(count, generator=generator, dtype=torch.float64)
    kicked = torch.rand(count, generator=generator) < share
    change = kick_mps * torch.stack([angle.cos(), angle.sin()], dim=-1)
    hit = kicked[:, None] & (torch.arange(physics.num_agents) == particle[:, None])
    return torch.where(kicked, frame, -1), hit[..., None] * change[:, None]


def simulate(
    physics: Physics,
    couplings: Float[Tensor, "count agents agents"],
    positions: Float[Tensor, "count agents 2"],
    velocities: Float[Tensor, "count agents 2"],
    kick_frames: Int[Tensor, " count"] | None = None,
    kicks_mps: Float[Tensor, "count agents 2"] | None = None,
) -> Float[Tensor, "count frames agents 4"]:
    """Computes positions [m] and velocities [m/s] at every frame, the given ones first.

    Args:
        physics: constants of the box.
        couplings: spring constants [N/m at unit mass], or charge products.
        positions: initial positions [m], float64.
        velocities: initial velocities [m/s], float64.
        kick_frames: frame right after which the velocities change; -1 for none. None kicks no rollout.
        kicks_mps: change of the velocities [m/s].
    """
    couplings = couplings.double()
    substeps = physics.substeps * (1 if physics.kind == "springs" else CHARGE_SUBSTEPS)
    step_s = physics.dt_s / substeps
    # For springs the force is linear: −L r with the graph's weighted Laplacian, one product for both axes.
    kick = (couplings - torch.diag_embed(couplings.sum(-1))) * step_s
    frames = [torch.cat([positions, velocities], dim=-1)]

    def kicked(velocities: Tensor, share: float) -> Tensor:
        if physics.kind == "springs":
            return torch.baddbmm(velocities, kick, positions, alpha=share)
        return velocities + share * step_s * charge_force(physics, couplings, positions)

    for frame in range(physics.frames - 1):
        if kick_frames is not None and kicks_mps is not None:
            velocities = velocities + (kick_frames == frame)[:, None, None] * kicks_mps
        velocities = kicked(velocities, 0.5)
        for substep in range(substeps):
            positions = positions + velocities * step_s
            positions, velocities = _reflect(positions, velocities, physics.box_m)
            # Two consecutive half kicks are one whole kick.
            velocities = kicked(velocities, 1.0 if substep < substeps - 1 else 0.5)
        frames.append(torch.cat([positions, velocities], dim=-1))
    return torch.stack(frames, dim=1)


def simulate_chunks(physics: Physics, *start: Tensor) -> Float[np.ndarray, "count frames agents 4"]:
    """Simulates any number of rollouts, a part at a time, and returns float32."""
    parts = [
        simulate(physics, *(t[i : i + CHUNK] for t in start)).float().numpy() for i in range(0, len(start[0]), CHUNK)
    ]
    return np.concatenate(parts)


def stream_of(split: str, seed: int) -> torch.Generator:
    """Returns the generator of a split's draws."""
    stream = ("train", "val", "test", "ood").index(split)
    return torch.Generator().manual_seed(int(np.random.default_rng([seed, stream]).integers(2**62)))


def charge_force(
    physics: Physics, couplings: Float[Tensor, "count agents agents"], positions: Float[Tensor, "count agents 2"]
) -> Float[Tensor, "count agents 2"]:
    """Computes the force of all charges on each [N at unit mass]; a positive product repels."""
    apart = positions[:, :, None] - positions[:, None]
    # the distance to itself is 0, and its product too
    itself = torch.eye(physics.num_agents, dtype=positions.dtype)
    squared = apart.square().sum(-1) + physics.softening_m**2 + itself
    force = ((couplings / (squared * squared.sqrt()))[..., None] * apart).sum(2)
    return force.clamp(-physics.largest_force, physics.largest_force) if physics.largest_force else force


def _reflect(positions: Tensor, velocities: Tensor, box_m: float) -> tuple[Tensor, Tensor]:
    outside: Bool[Tensor, "count agents 2"] = positions.abs() > box_m
    if not bool(outside.any()):
        return positions, velocities
    mirrored = 2 * box_m * positions.sign() - positions
    return torch.where(outside, mirrored, positions), torch.where(outside, -velocities, velocities)


def make_episodes(config: SpringsConfig, split: str, count: int) -> list[Episode]:
    """Simulates one split."""
    physics = config.physics
    generator = stream_of(split, config.seed)
    shifted = split == "ood"
    if physics.kind == "springs":
        constants = (1.0, 2.0, 3.0) if shifted else ()
        probability = 0.5 if shifted else config.edge_probability
        couplings = draw_springs(count, physics.num_agents, probability, generator, constants)
    else:
        couplings = draw_charges(count, physics.num_agents, 2.0 if shifted else 1.0, generator)
    positions, velocities = draw_start(count, physics, generator)
    kicks: tuple[Tensor, ...] = ()
    if config.kicks:
        kicks = draw_kicks(count, physics, config.kicks, config.kick_mps, generator)
    states = simulate_chunks(physics, couplings, positions, velocities, *kicks)
    # Springs: 0 none, 1 spring. Charges: 0 none (never), 1 attraction, 2 repulsion.
    signs = couplings.sign().numpy()
    types = (signs if physics.kind == "springs" else np.where(signs > 0, 2, -signs)).astype(np.int8)
    attributes = couplings.abs().float().numpy()[..., None]
    present = np.ones(states.shape[1:3], dtype=np.bool_)
    ids = np.arange(physics.num_agents)
    episodes = [Episode(states[i], present, ids, split, i, types[i][None], attributes[i][None]) for i in range(count)]
    return [_marked(episode, *(k[i] for k in kicks)) for i, episode in enumerate(episodes)] if kicks else episodes


def _marked(episode: Episode, frame: Tensor, kick_mps: Tensor) -> Episode:
    """Returns the episode with a mark at the kicked particle, at the last frame before the kick."""
    perturbed = np.zeros(episode.valid.shape, dtype=np.int8)
    if frame >= 0:
        perturbed[int(frame), kick_mps.abs().sum(-1).numpy() > 0] = PERTURBATIONS.index("kick")
    return replace(episode, perturbed=perturbed)


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
    attribute = "spring_constant" if config.physics.kind == "springs" else "charge_product"
    source = f"{config.physics.num_agents}-{config.physics.kind}"
    info = StoreInfo(spring_spec(config.physics), source, edge_attribute_names=(attribute,))
    splits = {name: getattr(config, name) for name in ("train", "val", "test", "ood")}
    return write_splits(
        config.out, splits, info, lambda split, count: make_episodes(config, split, count), config.overwrite
    )


def write_splits(
    out: Path,
    splits: Mapping[str, int],
    info: StoreInfo,
    episodes: Callable[[str, int], list[Episode]],
    overwrite: bool,
) -> dict[str, float]:
    """Writes a store for each split that has rollouts; returns the time of each [s].

    Args:
        out: folder of the stores.
        splits: number of rollouts by name of the split.
        info: content of the stores; provenance is added.
        episodes: function that simulates a number of rollouts of a split.
        overwrite: whether to replace existing stores.

    Raises:
        UserError: `out` is a file, a split exists, or no split has rollouts.
    """
    check_out(out, only_stores=True)
    took: dict[str, float] = {}
    made = provenance(("torch", "numpy", "zarr"))
    names = list(splits)
    kept = [address(out / name) for name, count in splits.items() if not count and exists(out / name)]
    splits = {name: count for name, count in splits.items() if count}
    if not splits:
        raise UserError("nothing to simulate: " + ", ".join(names[:-1]) + f" and {names[-1]} are all 0")
    for name in splits:
        if exists(out / name) and not overwrite:
            raise UserError(f"{address(out / name)} exists; choose another --out or pass --overwrite")
    if kept:
        print(f"kept as {'it is' if len(kept) == 1 else 'they are'}: {', '.join(kept)}", file=sys.stderr)
    with WorkShown("simulate", sum(splits.values())) as shown:
        for name, count in splits.items():
            began = time.perf_counter()
            here = replace(info, provenance=made | {"split": name})
            write_store(out / name, here, episodes(name, count), overwrite)
            took[name] = time.perf_counter() - began
            shown.advance(count)
    return took


def main() -> None:
    """Entry point."""
    config = parse(SpringsConfig, __doc__)
    for name, seconds in make(config).items():
        print(f"{address(config.out / name)}: {getattr(config, name)} rollouts in {seconds:.1f} s")


if __name__ == "__main__":
    run_entry_point(main)
