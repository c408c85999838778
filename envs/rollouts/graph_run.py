"""Measures inferred edges against causal labels in one environment, beside rules that need no network."""

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from envs.registry import name_with
from envs.rollouts.causal_labels import CausalSettings, settings_for
from envs.rollouts.causal_scenes import EdgeScene, GraphTask, play_graph
from envs.rollouts.cause_run import CauseRun
from envs.rollouts.side_forecasts import fitting_checkpoints
from predictor.evaluation.causal_graph import CausalPairs, CausalScores, halves, score_rule
from predictor.evaluation.pair_trees import tree_scores
from predictor.support.errors import UserError
from predictor.support.progress import track

MAJORITY, DISTANCE, LEADERS, AHEAD = "the commoner answer", "distance", "the leader", "the vehicle ahead"
TREES = "trees on geometry"
"""Names of the rules that need no network; trees are fitted to the labels of the first half of the episodes."""
EDGE = 0.5
"""Probability above which a model infers an edge."""


@dataclass(frozen=True)
class EnvGraph:
    """Scores of inferred edges in one environment."""

    env_id: str
    """Id of the environment."""
    driver: str
    """Name of the driver."""
    episodes: int
    """Number of episodes played."""
    settings: CausalSettings
    """How labels were measured."""
    scores: dict[str, CausalScores]
    """Scores of each checkpoint and each rule, by name."""
    misfits: dict[str, str]
    """Reason for each checkpoint that was left out, by its name."""
    env_kwargs: str = ""
    """Arguments of the environment, as the text of a JSON object; empty for none."""
    to_ego: dict[str, CausalScores] = field(default_factory=dict)
    """Scores of edges to the ego, against labels of a driver in its place; empty without any."""

    @property
    def env(self) -> str:
        """Id of the environment, with its arguments where it had some."""
        return name_with(self.env_id, self.env_kwargs)


def measure_graph(run: CauseRun) -> EnvGraph:
    """Plays the episodes of one environment and scores all checkpoints and rules on the same pairs.

    Bounds are fitted on the first half of the episodes, all else is measured on the second.

    Raises:
        UserError: the environment cannot be perturbed or copied, checkpoints perceive differently, none fits, or no
            label is known.
    """
    world = run.open()
    spec, settings = world.spec, settings_for(world)
    world.close()
    fitting, misfits = fitting_checkpoints(run.env_id, run.checkpoints, spec)
    tasks = [GraphTask(**run.of_episode(i, fitting), settings=settings) for i in range(run.episodes)]
    with run.pool(play_graph) as pool:
        episodes = list(track(pool.results(tasks), f"graph {run.env_id}", total=len(tasks)))
    scores = scores_of(episodes, settings.threshold_m)
    if not _has_trees():
        misfits = {**misfits, TREES: "they need scikit-learn: pip install 'dgvae-rl[scores]'"}
    if not next(iter(scores.values())).pairs:
        raise UserError(
            f"{run.env_id}: no causal label is known in {run.episodes} episodes: nobody had another agent within "
            f"{settings.near_m:g} m at a measured step, or none was reached; add --episodes, or raise --max-steps "
            f"({run.max_steps})"
        )
    to_ego = scores_to_ego(episodes, settings.threshold_m)
    return EnvGraph(run.env_id, run.driver, run.episodes, settings, scores, misfits, run.env_kwargs, to_ego)


def scores_of(
    episodes: Sequence[Sequence[EdgeScene]], threshold_m: float, leader: str = LEADERS
) -> dict[str, CausalScores]:
    """Returns the scores of all checkpoints and rules, by name; `leader` names the rule of who leads."""
    scenes = [(number, step, scene) for number, found in enumerate(episodes) for step, scene in enumerate(found)]
    if not sum(len(scene.shift_m) for *_, scene in scenes):
        return {MAJORITY: CausalScores(0, 0, 0.0, None)}
    ids = np.unique(np.concatenate([scene.receiver for *_, scene in scenes]))  # of names, numbers of 62 bits
    pairs = CausalPairs.concatenate(
        [
            CausalPairs(
                scene.shift_m,
                scene.shift_m > threshold_m,
                np.full(len(scene.shift_m), number),
                step * len(ids) + np.searchsorted(ids, scene.receiver),
                scene.leads,
            )
            for number, step, scene in scenes
        ]
    )

    def joined(parts: Sequence[np.ndarray]) -> np.ndarray:
        return np.concatenate(parts).astype(np.float64)

    scores = {
        name: score_rule(joined([scene.edge_prob[name] for *_, scene in scenes]), pairs, EDGE, probability=True)
        for name in scenes[0][-1].edge_prob
    }
    fit, _ = halves(pairs)
    common = float(pairs.exists[fit].mean()) if fit.any() else 0.0
    scores[MAJORITY] = score_rule(np.full(len(pairs), common), pairs, EDGE)
    scores[DISTANCE] = score_rule(-joined([scene.distance_m for *_, scene in scenes]), pairs, None)
    if pairs.leads is not None:
        scores[leader] = score_rule(pairs.leads.astype(np.float64), pairs, EDGE)
    if _has_trees():
        found = tree_scores(joined([scene.geometry for *_, scene in scenes]), pairs.exists, fit)
        if found is not None:
            scores[TREES] = score_rule(found, pairs, EDGE, probability=True)
    return scores


def _has_trees() -> bool:
    """Returns whether scikit-learn is installed."""
    return importlib.util.find_spec("sklearn") is not None


def scores_to_ego(episodes: Sequence[Sequence[EdgeScene]], threshold_m: float) -> dict[str, CausalScores]:
    """Returns the scores of edges to the ego, by name; none without an ego or a known label."""
    scenes = [[scene.to_ego for scene in found if scene.to_ego is not None] for found in episodes]
    if not any(len(scene.shift_m) for found in scenes for scene in found):
        return {}
    return scores_of(scenes, threshold_m, AHEAD)
