"""Overlays recorded scenes until they hold a given number of agents: `python -m predictor.data.crowd --source STORE`.

Public recordings of crowds are small or short. An overlay has as many agents as wanted, each with a recorded motion.
Agents of different recordings do not interact, so an overlay tests a forecaster (and its time and memory) on many
agents without influence on each other, not how crowds behave.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from predictor.data.dataset_card import most_present
from predictor.data.store import Episode, StoreInfo, read_info_of, read_store, write_store
from predictor.data.store_files import check_new_store
from predictor.scene import MOST_AGENTS
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least, check_at_most
from predictor.support.errors import UserError, run_entry_point
from predictor.support.provenance import provenance
from predictor.support.remote import address


@dataclass(frozen=True)
class CrowdConfig:
    """Overlays the scenes of a store."""

    source: Path
    """Episode store whose scenes are overlaid; it has no ego."""
    out: Path
    """Folder of the new store (Zarr)."""
    num_agents: tuple[int, ...] = (2, 5, 10, 20, 50, 100, 150)
    """Numbers of agents wanted at the last observed step; each gives `episodes` episodes."""
    episodes: int = 8
    """Number of episodes for each number of agents."""
    episode_steps: int = 50
    """Length of an episode [steps]; shorter ones of the source are left out."""
    at_step: int = 39
    """Step at which agents are counted: the last step of the burn-in."""
    seed: int = 0
    """Random seed for the choice of scenes."""
    overwrite: bool = False
    """Replace an existing store."""

    def __post_init__(self) -> None:
        """Checks ranges.

        Raises:
            UserError: a value out of range.
        """
        check_at_least(self, 1, "num_agents", "episodes")
        check_at_most(self, MOST_AGENTS, "num_agents")
        check_at_least(self, 0, "seed")
        if not self.num_agents:
            raise UserError("num_agents needs at least one number; leave it out for the default ones")
        check_at_least(self, 2, "episode_steps")
        if not 0 <= self.at_step < self.episode_steps:
            raise UserError(f"at_step must lie between 0 and {self.episode_steps - 1}, got {self.at_step}")


def overlay(episodes: list[Episode], axes: int, seed: int, steps: int) -> Episode:
    """Returns one episode of `steps` with all agents of several, each recording centred on its own mean position."""
    parts, presence = [], []
    for episode in episodes:
        states, valid = episode.states[:steps].copy(), episode.valid[:steps]
        if valid.any():
            states[..., :axes] -= states[valid][:, :axes].mean(axis=0)
        parts.append(states * valid[..., None])
        presence.append(valid)
    valid = np.concatenate(presence, axis=1)
    label = f"{len(episodes)} scenes overlaid"
    return Episode(np.concatenate(parts, axis=1), valid, np.arange(valid.shape[1]), label, seed)


def make_crowds(config: CrowdConfig) -> list[Episode]:
    """Draws scenes until each crowd is large enough; one has no scene twice before it has all.

    Raises:
        UserError: no scene of the source is long enough, or no agent is present at `at_step`.
    """
    store = read_store(config.source)
    if store.info.spec.has_ego:
        raise UserError(f"{config.source} has an ego, and an episode has at most one; pass a store without an ego")
    usable = [e for e in store.episodes if len(e.states) >= config.episode_steps and e.valid[config.at_step].any()]
    if not usable:
        raise UserError(
            f"{config.source}: no episode has {config.episode_steps} steps and an agent at step {config.at_step}"
        )
    rng = np.random.default_rng(config.seed)
    crowds: list[Episode] = []
    for wanted in config.num_agents:
        for _ in range(config.episodes):
            chosen: list[Episode] = []
            order: list[int] = []
            present = 0
            while present < wanted:
                order = order or rng.permutation(len(usable)).tolist()
                chosen.append(usable[order.pop()])
                present += int(chosen[-1].valid[config.at_step].sum())
            crowds.append(overlay(chosen, store.info.spec.position_dim, len(crowds), config.episode_steps))
    return crowds


def main() -> None:
    """Entry point."""
    config = parse(CrowdConfig, __doc__)
    check_new_store(config.out, config.overwrite)
    crowds = make_crowds(config)
    source = read_info_of(config.source)
    made = provenance(("numpy", "zarr")) | {"overlaid": source.provenance}
    spec = replace(source.spec, max_agents=max(source.spec.max_agents, most_present(crowds)))
    write_store(config.out, StoreInfo(spec, f"{source.source}, overlaid", made), crowds, config.overwrite)
    counts = [int(e.valid[config.at_step].sum()) for e in crowds]
    present = f"{min(counts)} to {max(counts)} agents at step {config.at_step}"
    print(f"{address(config.out)}: {len(crowds)} episodes of {present}")


if __name__ == "__main__":
    run_entry_point(main)
