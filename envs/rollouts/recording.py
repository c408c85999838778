"""Records one episode of a world: states, who follows whom, what was done to whom, and causal labels.

An episode is a function of its seed and the settings alone: the drivers, the interventions and the steps that get
labels draw from streams of their own.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from envs.readers.highway_labels import SceneLabels, with_labels
from envs.rollouts.branch_recording import BranchRecording, record_branches
from envs.rollouts.causal_labels import CausalLabels, CausalSettings, causal_labels, with_causal_labels
from envs.rollouts.interventions import interventions_of
from envs.rollouts.perturbations import Perturber
from envs.rollouts.world import World
from envs.seeding import Purpose, episode_rng
from envs.simulators.interventions import Kind
from predictor.data.store import PERTURBATIONS, Episode
from predictor.scene import Scene


@dataclass(frozen=True)
class Recording:
    """What is recorded of an episode; can be pickled."""

    max_steps: int
    """Largest length of an episode [policy steps]."""
    labels: bool = True
    """Whether to record who follows whom."""
    perturb: float = 0.0
    """Share of the steps during which one agent is perturbed."""
    perturb_kinds: tuple[Kind, ...] = ()
    """Kinds of interventions to draw from; empty takes all that are possible."""
    causal_every: int = 0
    """Number of steps from one with causal labels to the next; 0 records none."""
    causal: CausalSettings | None = None
    """How causal labels are measured; needed if they are."""
    branches: BranchRecording | None = None
    """Branches that are recorded in place of the episode."""


def record_all(world: World, seed: int, label: str, settings: Recording) -> list[Episode]:
    """Plays the episode of a seed and returns it, or its branches.

    Args:
        world: world to play; it is reset.
        seed: seed of the episode.
        label: tag of the episode.
        settings: what is recorded.

    Raises:
        UserError: the world cannot be perturbed or copied, where that is asked for.
    """
    if settings.branches is None:
        return [record(world, seed, label, settings)]
    return record_branches(world, seed, label, settings.max_steps, settings.branches)


def record(world: World, seed: int, label: str, settings: Recording) -> Episode:
    """Plays the episode of a seed and returns it.

    Args:
        world: world to play; it is reset.
        seed: seed of the episode.
        label: tag of the episode.
        settings: what is recorded.

    Raises:
        UserError: the world cannot be perturbed or copied, where that is asked for.
    """
    world.reset(seed)
    perturber = None
    if settings.perturb:
        perturber = Perturber(world, settings.perturb, settings.perturb_kinds, episode_rng(seed, Purpose.PERTURBATIONS))
    every = settings.causal_every
    first_labelled = int(episode_rng(seed, Purpose.LABELS).integers(every)) if every else 0
    scenes: list[Scene] = []
    edges: list[SceneLabels] = []
    marks: list[Mapping[int, Kind]] = []
    causal: dict[int, CausalLabels] = {}
    ended = False
    for step in range(settings.max_steps + 1):
        scenes.append(world.full_scene())
        if settings.labels and (found := world.labels()) is not None:
            edges.append(found)
        if ended or step == settings.max_steps:
            break
        if every and step % every == first_labelled:
            assert settings.causal is not None
            causal[step] = causal_labels(world, settings.causal)
        if perturber is not None:
            perturber()
            marks.append({agent: one.kind for agent, one in interventions_of(world).items()})
        ended = world.step()
    episode = Episode.from_scenes(scenes, label=label, seed=seed)
    if perturber is not None:
        episode = _with_marks(episode, marks)
    if every:
        episode = with_causal_labels(episode, causal)
    return with_labels(episode, scenes, edges) if edges else episode


def _with_marks(episode: Episode, marks: list[Mapping[int, Kind]]) -> Episode:
    """Returns the episode with what was done to each agent at each step; nothing is done at the last one."""
    column = {int(agent): i for i, agent in enumerate(episode.ids)}
    perturbed = np.zeros(episode.valid.shape, dtype=np.int8)
    for step, done in enumerate(marks):
        for agent, kind in done.items():
            perturbed[step, column[agent]] = PERTURBATIONS.index(kind)
    return replace(episode, perturbed=perturbed)
