from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envs.rollouts import causal_scenes, graph_run
from envs.rollouts.causal_labels import CausalLabels, CausalSettings
from envs.rollouts.causal_scenes import EdgeScene
from envs.rollouts.cause_run import CauseRun
from envs.rollouts.graph_run import (
    AHEAD,
    DISTANCE,
    LEADERS,
    MAJORITY,
    TREES,
    measure_graph,
    scores_of,
    scores_to_ego,
)
from envs.rollouts.world import World
from predictor.evaluation.causal_graph import CausalScores
from predictor.support.errors import UserError
from tests.envs.evaluation import TAG, forget, no_processes, save_tag


@pytest.fixture(autouse=True)
def in_process(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    no_processes(monkeypatch)
    forget()
    yield
    forget()


def scene(seed: int, leads: bool = True) -> EdgeScene:
    """Four pairs, of which the first is an edge, the nearest, and the leader's."""
    rng = np.random.default_rng(seed)
    shift_m = np.array([2.0 + rng.random(), 0.1, 0.2, 0.9])
    return EdgeScene(
        shift_m,
        np.array([1, 1, 2, 2]),
        np.array([10.0, 30.0, 40.0, 50.0]) + rng.random(4),
        np.array([True, False, False, False]) if leads else None,
        {"right": np.array([0.9, 0.1, 0.2, 0.3]), "wrong": np.array([0.1, 0.9, 0.9, 0.9])},
        np.array([[0.0], [1.0], [2.0], [3.0]]),
    )


def f1(scores: dict[str, CausalScores], name: str) -> float:
    found = scores[name].f1
    assert found is not None
    return found.value


def test_each_rule_is_scored_on_the_same_pairs():
    episodes = [[scene(2 * i), scene(2 * i + 1)] for i in range(6)]
    scores = scores_of(episodes, 1.0)
    assert list(scores) == ["right", "wrong", MAJORITY, DISTANCE, LEADERS, TREES]
    assert {(s.pairs, s.episodes, s.share) for s in scores.values()} == {(24, 3, 0.25)}
    assert [f1(scores, name) for name in scores] == [1.0, 0.0, 0.0, 1.0, 1.0, 0.0]  # 24 pairs are too few for a tree
    majority = scores[MAJORITY]
    assert majority.accuracy is not None and majority.accuracy.value == 0.75
    assert majority.auc is not None and majority.auc.value == 0.5
    assert scores[DISTANCE].bound == pytest.approx(-20.0, abs=3.0)
    assert scores["right"].bins and not scores[DISTANCE].bins


def test_trees_see_the_geometry_of_the_first_half_and_are_scored_on_the_second():
    episodes = [[scene(4 * i + k) for k in range(4)] for i in range(20)]
    found = scores_of(episodes, 1.0)[TREES]
    assert f1(scores_of(episodes, 1.0), TREES) == 1.0
    assert found.episodes == 10 and found.bins, "their score is a probability"
    swapped = [[replace(one, geometry=one.geometry[::-1]) for one in steps] for steps in episodes[10:]]
    assert f1(scores_of(episodes[:10] + swapped, 1.0), TREES) == 0.0, "what they saw is not what follows"


def test_without_scikit_learn_the_trees_are_left_out_and_the_reason_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(causal_scenes, "causal_labels", quick_labels)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    found = measure_graph(run(save_tag(tmp_path / "tag")))
    assert list(found.scores) == ["tag", MAJORITY, DISTANCE]
    assert TREES not in scores_of([[scene(4 * i + k) for k in range(4)] for i in range(20)], 1.0)
    assert found.misfits == {TREES: "they need scikit-learn: pip install 'dgvae-rl[scores]'"}


def test_receivers_of_different_steps_are_apart():
    """At one step all probabilities of a receiver are high, at the next all are low: it makes no difference whose."""
    high, low = scene(0), scene(1)
    both = [replace(one, edge_prob={"flat": np.full(4, p)}) for one, p in ((high, 0.9), (low, 0.1))]
    assert scores_of([both] * 4, 1.0)["flat"].spread_between_senders == pytest.approx(0.0, abs=1e-9)


def test_ids_of_names_are_told_apart():
    """Whole numbers of 62 bits (`envs.readers.agent_ids`)."""
    small = [[scene(3 * i + j) for j in range(3)] for i in range(6)]
    large = [[replace(one, receiver=one.receiver + 2**62 - 4) for one in found] for found in small]
    assert scores_of(large, 1.0) == scores_of(small, 1.0)


def test_the_commoner_answer_may_be_an_edge():
    episodes = [[scene(i)] for i in range(4)]
    scores = scores_of(episodes, 0.05)
    assert scores[MAJORITY].accuracy is not None and scores[MAJORITY].accuracy.value == 1.0
    assert f1(scores, MAJORITY) == 1.0


def test_where_the_simulator_names_no_leaders_there_is_no_such_rule():
    assert LEADERS not in scores_of([[scene(0, leads=False)], [scene(1, leads=False)]], 1.0)


def test_edges_to_the_ego_are_scored_apart():
    """Those to the ego are inferred the wrong way round."""
    episodes = [[replace(scene(i), to_ego=scene(i + 50)) for i in (2 * j, 2 * j + 1)] for j in range(6)]
    swapped = [
        [replace(one, to_ego=replace(to_ego, edge_prob={"right": to_ego.edge_prob["wrong"]}))]
        for one, to_ego in ((found[0], found[0].to_ego) for found in episodes)
        if to_ego is not None
    ]
    scores = scores_to_ego(episodes, 1.0)
    assert list(scores) == ["right", "wrong", MAJORITY, DISTANCE, AHEAD, TREES]
    assert {(s.pairs, s.episodes, s.share) for s in scores.values()} == {(24, 3, 0.25)}
    assert f1(scores, "right") == f1(scores, AHEAD) == 1.0
    assert f1(scores_to_ego(swapped, 1.0), "right") == 0.0
    assert f1(scores_of(swapped, 1.0), "right") == 1.0


def test_without_a_known_label_the_edges_to_the_ego_have_no_score():
    assert scores_to_ego([[scene(0)], [scene(1)]], 1.0) == {}
    none = np.zeros(0)
    nobody = EdgeScene(none, none.astype(int), none, none.astype(bool), {"right": none}, np.zeros((0, 1)))
    assert scores_to_ego([[replace(scene(0), to_ego=nobody)]], 1.0) == {}


def run(checkpoint: str, **changes: Any) -> CauseRun:
    settings: dict[str, Any] = {"episodes": 3, "seed": 900_000, "max_steps": 9, "workers": 1, **changes}
    return CauseRun(env_id=TAG, driver="heuristic", checkpoints=(checkpoint,), **settings)


def quick_labels(world: World, settings: CausalSettings) -> CausalLabels:
    """Labels without copies of the simulator: who is near depends on whom."""
    scene = world.full_scene()
    apart = np.linalg.norm(scene.states[:, None, :2] - scene.states[:, :2], axis=-1)
    shift_m = (2 * settings.threshold_m * (apart < 1.0)).astype(np.float32)
    np.fill_diagonal(shift_m, np.nan)
    return CausalLabels(scene.ids.tolist(), shift_m)


def test_an_environment_is_measured_whatever_the_number_of_workers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(causal_scenes, "causal_labels", quick_labels)
    checkpoint = save_tag(tmp_path / "tag")
    one, three = (measure_graph(run(checkpoint, workers=workers)) for workers in (1, 3))
    assert one == three
    assert list(one.scores) == ["tag", MAJORITY, DISTANCE], "the first half, one episode, has one answer alone"
    found = one.scores["tag"]
    assert found.pairs > 10 and found.auc is not None and found.calibration_error is not None
    assert (one.settings.horizon_s, one.settings.threshold_m) == (1.0, 0.05)
    near = one.scores[DISTANCE].auc
    assert near is not None and near.value == 1.0


def test_no_label_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(graph_run, "play_graph", lambda task: [])
    with pytest.raises(
        UserError, match=f"{TAG}: no causal label is known in 3 episodes: nobody had another agent within"
    ):
        measure_graph(run(save_tag(tmp_path / "tag")))


def test_what_cannot_be_perturbed_is_said():
    with pytest.raises(UserError, match="cannot be perturbed"):
        measure_graph(replace(run("constant-velocity"), env_id="pursuit_v5", driver="random"))
