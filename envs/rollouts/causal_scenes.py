"""Plays episodes and pairs inferred edges with causal labels at some of their steps, for `envs.evaluate --graph`.

At every fifth step, from a random one on, copies of the simulator say whose future changes when another agent brakes or
is taken out (`envs.rollouts.causal_labels`). Beside each known label stand each checkpoint's probability of an edge,
the distance, and whether the simulator says that the receiver follows the sender. Pairs of which one agent is not
perceived have no inferred edge and are left out, and so are landmarks.

Pairs whose receiver is the ego are kept apart: their labels are those of a driver in its place, and what leads it is
the vehicle next ahead on its lane.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from envs.readers.highway_labels import LEADER
from envs.rollouts.causal_labels import CausalSettings, causal_labels
from envs.rollouts.cause_run import CauseTask
from envs.rollouts.moving import moving_agents
from envs.rollouts.side_forecasts import SideForecaster, checkpoint_forecasters
from envs.rollouts.world import World
from envs.seeding import Purpose
from predictor.evaluation.pair_trees import pair_features


@dataclass(frozen=True, kw_only=True)
class GraphTask(CauseTask):
    """Settings of one episode; can be pickled."""

    settings: CausalSettings
    """How labels are measured."""


@dataclass(frozen=True)
class EdgeScene:
    """Pairs of one step whose causal label is known."""

    shift_m: Float[np.ndarray, " pairs"]
    """Causal shift [m]."""
    receiver: Int[np.ndarray, " pairs"]
    """Id of the receiver."""
    distance_m: Float[np.ndarray, " pairs"]
    """Distance of the two agents [m]."""
    leads: Bool[np.ndarray, " pairs"] | None
    """Whether the simulator says that the receiver follows the sender, or drives next behind it if it is the ego; None
    where it says nothing."""
    edge_prob: dict[str, Float[np.ndarray, " pairs"]]
    """Probability of an edge of any type, by checkpoint."""
    geometry: Float[np.ndarray, "pairs geometry"]
    """How the two agents stand and move (`predictor.evaluation.pair_trees`)."""
    to_ego: "EdgeScene | None" = None
    """Pairs whose receiver is the ego; None without an ego."""


def play_graph(task: GraphTask) -> list[EdgeScene]:
    """Plays one episode and returns its scenes with labels."""
    world = task.opened()
    found = checkpoint_forecasters(task.checkpoints, world.spec, task.env_id)
    forecasters = {name: SideForecaster(forecaster, world.spec, 1) for name, forecaster in found.items()}
    measured, scenes = task.measured_steps(Purpose.LABELS), []
    for step in range(task.max_steps):
        for forecaster in forecasters.values():
            forecaster.observe(world.perceived())
        if step in measured:
            scenes.append(labelled_scene(world, forecasters, task.settings))
        if world.step():
            break
    return scenes


def labelled_scene(world: World, forecasters: dict[str, SideForecaster], settings: CausalSettings) -> EdgeScene:
    """Returns the pairs of the present scene whose causal label is known.

    Args:
        world: a running world; it is not changed.
        forecasters: forecasters that have observed the present scene.
        settings: how labels are measured.
    """
    scene, labels, lanes = world.perceived(), causal_labels(world, settings), world.labels()
    ids = np.asarray(labels.ids, dtype=np.int64)
    leads = None
    if lanes is not None:
        leads = lanes.edge_types == LEADER
        if world.spec.has_ego:
            leads[0] = np.arange(len(ids)) == (-1 if lanes.ahead is None else lanes.ahead)
    moving = moving_agents(scene, world.spec)
    seen = {int(agent): i for i, agent in enumerate(scene.ids) if moving[i]}
    place = np.array([seen.get(agent, -1) for agent in labels.ids], dtype=np.int64)
    known = np.isfinite(labels.shift_m) & (place[:, None] >= 0) & (place >= 0)
    positions = scene.states[:, : world.spec.position_dim]
    probs = {name: forecaster.forecast().edge_probs[0].cpu().numpy() for name, forecaster in forecasters.items()}

    def pairs(receivers: slice) -> EdgeScene:
        receiver, sender = np.nonzero(known[receivers])
        receiver += receivers.start
        at = place[receiver], place[sender]
        return EdgeScene(
            labels.shift_m[receiver, sender].astype(np.float64),
            ids[receiver],
            np.linalg.norm(positions[at[0]] - positions[at[1]], axis=-1),
            None if leads is None else leads[receiver, sender],
            {name: (1 - one[at[0], at[1], 0]).astype(np.float64) for name, one in probs.items()},
            pair_features(scene.states, scene.valid, *at, world.spec.position_dim),
        )

    if not world.spec.has_ego:
        return pairs(slice(0, None))
    return replace(pairs(slice(1, None)), to_ego=pairs(slice(0, 1)))
