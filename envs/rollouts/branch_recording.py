"""Records what follows an intervention: at random moments of an episode the world is copied, and perturbed in the copy.

Each branch is an episode of its own: undisturbed steps, then the moment at which one agent is slower, faster or gone at
once, then what all agents make of it. So nothing that happens after the moment is unforeseeable, which cannot be said
of an episode that is perturbed again and again. The same moment without the intervention gives the causal labels of the
perturbed agent. All draws are a function of the episode's seed alone.

With `twins`, each branch is followed by what happens without the intervention (`predictor.data.twins` finds them).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from envs.rollouts.branches import Branch, Branches, BranchPoint, copied
from envs.rollouts.causal_labels import CausalSettings, direct_shift_m, farthest, senders_of
from envs.rollouts.interventions import is_on_roads
from envs.rollouts.world import World
from envs.seeding import Purpose, episode_rng
from envs.simulators.interventions import Intervention, Kind, NotAllowedError
from predictor.data.store import PERTURBATIONS, Episode
from predictor.scene import Scene

SHARES: dict[Kind, float] = {"brake": 0.55, "accelerate": 0.2, "remove": 0.25}
"""Probability of each kind; a kind that an agent does not allow is drawn anew."""
FREE = 0.6
"""Probability that a driver is free after its speed has changed; otherwise it holds the speed for a while."""
EGO_SHARE = 0.3
"""Probability that a draw is of the ego, if others are possible too: policies ask what they cause. Of the branches that
are kept fewer are, where the ego seldom moves anybody (`TRIES`)."""
AT_REST = 0.25
"""Share of the least loss of speed below which an agent's speed is too low for it to brake."""
TRIES = 3
"""Largest number of interventions that are tried until one moves another agent; the last one is kept in any case."""


@dataclass(frozen=True)
class BranchMix:
    """Distribution of the interventions of recorded branches."""

    brake_mps: tuple[float, float]
    """Range of the loss of speed, to rest at most [m/s]."""
    accelerate_mps: tuple[float, float]
    """Range of the gain of speed [m/s]."""
    horizon_s: float
    """Time that is played after the moment [s]."""


ON_ROADS = BranchMix((2.0, 10.0), (2.0, 6.0), 5.0)
"""Mix for highway-env."""
IN_ARENAS = BranchMix((0.2, 1.2), (0.2, 0.8), 1.5)
"""Mix for mpe2, whose agents move at about 1 m/s."""


@dataclass(frozen=True)
class BranchRecording:
    """What is recorded of an episode in branches; can be pickled."""

    branches: int
    """Number of branches of an episode."""
    history_steps: int
    """Largest number of undisturbed steps before the moment."""
    mix: BranchMix
    """Distribution of interventions."""
    causal: CausalSettings
    """Which agents are perturbed, and how their causal labels are measured."""
    twins: bool = False
    """Whether each branch is followed by its twin, an episode of the same agents without the intervention."""


def branch_mix_for(world: World) -> BranchMix:
    """Returns the mix of the world's family.

    Raises:
        UserError: the world cannot be perturbed.
    """
    return ON_ROADS if is_on_roads(world) else IN_ARENAS


def record_branches(world: World, seed: int, label: str, max_steps: int, settings: BranchRecording) -> list[Episode]:
    """Plays the episode of a seed and returns its branches, each with its twin if asked for.

    There are fewer than asked for if no agent can be perturbed.

    Args:
        world: world to play; it is reset.
        seed: seed of the episode.
        label: tag of the episodes.
        max_steps: largest length of the episode [policy steps].
        settings: what is recorded.

    Raises:
        UserError: the world cannot be copied or perturbed.
    """
    rng = episode_rng(seed, Purpose.BRANCHES)
    scenes, moments = _play(world, seed, max_steps, settings.branches, rng)
    found = []
    for step, moment in moments:
        before = scenes[max(0, step - settings.history_steps) : step]
        found += [replace(e, label=label, seed=seed) for e in _branch(moment, before, settings, rng)]
    return found


def _play(
    world: World, seed: int, max_steps: int, branches: int, rng: np.random.Generator
) -> tuple[list[Scene], list[tuple[int, World]]]:
    """Plays the episode; returns all its scenes, and copies of the world at moments drawn evenly, with their steps."""
    world.reset(seed)
    scenes = [world.full_scene()]
    moments: list[tuple[int, World]] = []
    for step in range(1, max_steps):
        if world.step():
            break
        scenes.append(world.full_scene())
        # the k-th moment replaces each kept one with probability 1 / k, so that all are equally likely in the end
        replaced = np.flatnonzero(rng.random(branches) < 1 / step)
        if len(replaced):
            moment = (step, copied(world))
            moments = [moment if i in replaced else kept for i, kept in enumerate(moments or [moment] * branches)]
    return scenes, moments


def _branch(
    moment: World, before: Sequence[Scene], settings: BranchRecording, rng: np.random.Generator
) -> list[Episode]:
    """Returns a branch of a moment, and its twin if asked for; nothing if no agent can be perturbed."""
    horizon = max(1, round(settings.mix.horizon_s / moment.spec.dt_s))
    point = BranchPoint(moment, horizon)
    labelled = min(horizon, max(1, round(settings.causal.horizon_s / moment.spec.dt_s)))
    seen = set(before[-1].ids[before[-1].valid].tolist())
    senders = [agent for agent in senders_of(moment, settings.causal) if agent in seen]
    if not senders:  # nobody who is there for more than this moment
        return []
    kept: Branches | None = None
    axes = moment.spec.position_dim
    for _ in range(TRIES):
        sender = _sender(senders, int(point.ids[0]) if moment.spec.has_ego else None, rng)
        velocity = point.plain.states[0, point.ids == sender, axes : 2 * axes]
        found = _perturbed(point, sender, float(np.linalg.norm(velocity)), horizon, settings.mix, rng)
        if found is None:
            continue
        kept = found
        moved_m = farthest(found, settings.causal.threshold_m, labelled)
        moved_m[point.ids == sender] = 0
        if np.nanmax(moved_m, initial=0.0) > settings.causal.threshold_m:
            break
    if kept is None:
        return []
    has_ego = moment.spec.has_ego
    episode = _episode(point, kept, before, settings.causal.threshold_m, labelled, has_ego)
    return _with_twin(episode, kept, before, has_ego) if settings.twins else [episode]


def _sender(senders: Sequence[int], ego: int | None, rng: np.random.Generator) -> int:
    """Draws the agent of an intervention."""
    others = [agent for agent in senders if agent != ego]
    if ego is not None and ego in senders and (not others or rng.random() < EGO_SHARE):
        return ego
    return int(rng.choice(others))


def _perturbed(
    point: BranchPoint, sender: int, speed_mps: float, horizon: int, mix: BranchMix, rng: np.random.Generator
) -> Branches | None:
    """Plays a random intervention on an agent of this speed; None if it allows none."""
    kinds = list(SHARES)
    shares = np.array([SHARES[kind] for kind in kinds])
    for kind in rng.choice(kinds, len(kinds), replace=False, p=shares / shares.sum()):
        try:
            drawn = _drawn(sender, kind, horizon, mix, rng)
            if kind == "brake" and speed_mps < AT_REST * mix.brake_mps[0]:
                continue  # nothing would change
            return point.perturbed(drawn)
        except NotAllowedError:
            continue  # an ego that cannot be taken out
    return None


def _drawn(sender: int, kind: Kind, horizon: int, mix: BranchMix, rng: np.random.Generator) -> Intervention:
    if kind == "remove":
        return Intervention(sender, kind, horizon + 1)  # mpe2's last step would show it again
    change_mps = rng.uniform(*(mix.brake_mps if kind == "brake" else mix.accelerate_mps))
    steps = 0 if rng.random() < FREE else int(rng.integers(1, horizon + 1))
    return Intervention(sender, kind, steps, change_mps, at_once=True)


def _episode(
    point: BranchPoint, found: Branches, before: Sequence[Scene], threshold_m: float, labelled: int, has_ego: bool
) -> Episode:
    """Returns the episode of a branch, with the mark and the causal labels of the perturbed agent."""
    episode = Episode.from_scenes([*before, *_scenes(found.ids, found.perturbed)])
    sender = found.intervention.agent
    column = {int(agent): i for i, agent in enumerate(episode.ids)}
    now = len(before)
    perturbed = np.zeros(episode.valid.shape, dtype=np.int8)
    perturbed[now - 1, column[sender]] = PERTURBATIONS.index(found.intervention.kind)
    shift_m = np.full((*episode.valid.shape, len(column)), np.nan, dtype=np.float32)
    direct_m = direct_shift_m(point, found, threshold_m, labelled)
    for agent, moved_m in zip(point.ids, direct_m, strict=True):
        if int(agent) in column and agent != sender:
            shift_m[now - 1 : now + 1, column[int(agent)], column[sender]] = moved_m
    if has_ego:
        shift_m[:, 0] = np.nan  # its future is the policy's choice
    return replace(episode, perturbed=perturbed, causal_shift_m=shift_m)


def _with_twin(episode: Episode, found: Branches, before: Sequence[Scene], has_ego: bool) -> list[Episode]:
    """Returns a branch and its twin, with equal columns.

    Agents that crash in one of the two are absent from the twin after the moment, the ego apart: whether two cars touch
    turns on centimetres, and the difference of the two futures is then no reaction.
    """
    plain = _scenes(found.ids, found.plain)
    crashed = found.crashed
    if has_ego:
        crashed -= {int(found.ids[0])}
    kept = [replace(scene, valid=scene.valid & ~np.isin(scene.ids, list(crashed))) for scene in plain[1:]]
    twin = Episode.from_scenes([*before, plain[0], *kept])
    ids = list(dict.fromkeys([*episode.ids.tolist(), *twin.ids.tolist()]))
    unmarked = replace(
        twin,
        perturbed=np.zeros(twin.valid.shape, dtype=np.int8),
        causal_shift_m=np.full((*twin.valid.shape, len(twin.ids)), np.nan, dtype=np.float32),
    )
    return [_with_columns(episode, ids), _with_columns(unmarked, ids)]


def _scenes(ids: np.ndarray, branch: Branch) -> list[Scene]:
    """Returns the scenes of a branch, up to the last one that has an agent."""
    scenes = [Scene(states, ids, valid) for states, valid in zip(branch.states, branch.valid, strict=True)]
    while not scenes[-1].valid.any():  # the environment could not go on
        scenes.pop()
    return scenes


def _with_columns(episode: Episode, ids: Sequence[int]) -> Episode:
    """Returns the episode with a column for each id; agents that it lacks are absent."""
    assert episode.perturbed is not None and episode.causal_shift_m is not None
    place = [list(ids).index(agent) for agent in episode.ids.tolist()]
    steps, count = len(episode.states), len(ids)
    states = np.zeros((steps, count, episode.states.shape[2]), dtype=episode.states.dtype)
    valid, perturbed = np.zeros((steps, count), dtype=np.bool_), np.zeros((steps, count), dtype=np.int8)
    shift_m = np.full((steps, count, count), np.nan, dtype=np.float32)
    states[:, place], valid[:, place], perturbed[:, place] = episode.states, episode.valid, episode.perturbed
    shift_m[np.ix_(range(steps), place, place)] = episode.causal_shift_m
    return replace(
        episode,
        states=states,
        valid=valid,
        ids=np.array(ids, dtype=np.int64),
        perturbed=perturbed,
        causal_shift_m=shift_m,
    )
