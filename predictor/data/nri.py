"""Simulates the springs and the charged particles of NRI (Kipf et al., ICML 2018), to compare inferred graphs with its.

`python -m predictor.data.nri --law springs --out data/nri-springs` writes train, val and test stores with true graphs.
The constants are those of github.com/ethanfetaya/NRI, data/synthetic_sim.py and generate_dataset.py; the integration is
`predictor.data.springs.simulate`. Springs: F_ij = −0.1 (r_i − r_j) for half of the pairs, all of equal strength.
Charges ±1: F_ij = q_i q_j (r_i − r_j) / |r_i − r_j|³, at most 100 per axis in sum. Nothing but the type of a pair is
unknown, so there are no edge attributes.

Two things differ from that code, neither of which a frame shows: velocities stand at the time of their positions, where
NRI's lag by half a step (0.5 ms), and the first kick is half a step, not a whole one.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from predictor.data.springs import (
    CHARGE_SUBSTEPS,
    STATE_BYTES,
    Physics,
    draw_charges,
    draw_start,
    simulate_chunks,
    spring_spec,
    stream_of,
    write_splits,
)
from predictor.data.store import Episode, StoreInfo
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least, check_choices, check_numbers
from predictor.support.errors import run_entry_point
from predictor.support.memory import check_count
from predictor.support.remote import address

Law = Literal["springs", "charged"]

SPRING_CONSTANT = 0.1
"""Constant of every spring [N/m at unit mass] (`interaction_strength`)."""
EDGE_PROBABILITY = 0.5
"""Probability of a spring (`spring_prob`)."""
DT_S = 0.1
"""Time between frames: every 100th step of 0.001 s."""
SUBSTEPS = 100
FRAMES = 49
"""Number of frames for training: 5000 steps, without the first state."""
TEST_FRAMES = 99
"""Number of frames for testing: 10,000 steps; the graph is inferred from the first 49."""


@dataclass(frozen=True)
class NRIConfig:
    """Simulates NRI's springs or charged particles into train/, val/ and test/ under one folder."""

    out: Path
    """Folder for the three stores."""
    law: Law = "springs"
    """Law of interaction: springs between half of the pairs, or charges that attract and repel."""
    train: int = 50_000
    """Number of rollouts for training (NRI: 50,000)."""
    val: int = 10_000
    """Number of rollouts for model selection (NRI: 10,000)."""
    test: int = 10_000
    """Number of rollouts for the table (NRI: 10,000)."""
    num_agents: int = 5
    """Number of particles (NRI: 5 and 10)."""
    frames: int = FRAMES
    """Number of frames of a rollout for training and model selection (NRI: 49)."""
    test_frames: int = TEST_FRAMES
    """Number of frames of a rollout for the table (NRI: 99)."""
    seed: int = 0
    """Random seed for the rollouts; each split draws from its own stream."""
    overwrite: bool = False
    """Replace existing stores."""

    def __post_init__(self) -> None:
        """Checks choices and ranges.

        Raises:
            UserError: a value out of range.
        """
        check_choices(self)
        check_numbers(self)
        check_at_least(self, 0, "train", "val", "test", "seed")
        check_at_least(self, 2, "num_agents", "frames", "test_frames")
        for name in ("train", "val", "test"):
            check_count(getattr(self, name), name, STATE_BYTES * self.num_agents * max(self.frames, self.test_frames))


def nri_physics(law: Law, num_agents: int = 5, frames: int = FRAMES) -> Physics:
    """Returns NRI's constants of the box."""
    common = Physics(num_agents=num_agents, dt_s=DT_S, frames=frames, substeps=SUBSTEPS)
    if law == "springs":
        return common
    return replace(
        common,
        kind="charged",
        position_std_m=1.0,
        softening_m=0.0,
        largest_force=100.0,
        substeps=SUBSTEPS // CHARGE_SUBSTEPS,
    )


def make_nri_episodes(config: NRIConfig, split: str, count: int) -> list[Episode]:
    """Simulates one split; the state at the start is not a frame, as in NRI."""
    physics = nri_physics(config.law, config.num_agents, config.test_frames if split == "test" else config.frames)
    generator = stream_of(split, config.seed)
    if config.law == "springs":
        joined = torch.rand(count, config.num_agents, config.num_agents, generator=generator) < EDGE_PROBABILITY
        joined = torch.triu(joined, diagonal=1)
        couplings = SPRING_CONSTANT * (joined | joined.transpose(1, 2)).float()
    else:
        couplings = draw_charges(count, config.num_agents, 1.0, generator)
    start = draw_start(count, physics, generator)
    states = simulate_chunks(replace(physics, frames=physics.frames + 1), couplings, *start)[:, 1:]
    # Springs: 0 none, 1 spring. Charges: 0 none (never), 1 attraction, 2 repulsion.
    signs = couplings.sign().numpy()
    types = (signs if config.law == "springs" else np.where(signs > 0, 2, -signs)).astype(np.int8)
    present = np.ones(states.shape[1:3], dtype=np.bool_)
    ids = np.arange(config.num_agents)
    return [Episode(states[i], present, ids, split, i, types[i][None]) for i in range(count)]


def make_nri(config: NRIConfig) -> dict[str, float]:
    """Simulates and writes every split that has rollouts; returns the time of each [s].

    Raises:
        UserError: `out` is a file, a split exists, or no split has rollouts.
    """
    spec = spring_spec(nri_physics(config.law, config.num_agents))
    info = StoreInfo(spec, f"NRI {config.num_agents}-{config.law}")
    splits = {name: getattr(config, name) for name in ("train", "val", "test")}
    return write_splits(
        config.out, splits, info, lambda split, count: make_nri_episodes(config, split, count), config.overwrite
    )


def main() -> None:
    """Entry point."""
    config = parse(NRIConfig, __doc__)
    for name, seconds in make_nri(config).items():
        print(f"{address(config.out / name)}: {getattr(config, name)} rollouts in {seconds:.1f} s")


if __name__ == "__main__":
    run_entry_point(main)
