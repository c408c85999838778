import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

from predictor import interpret as interpretation
from predictor.baselines.mlp import MLP, MLPConfig
from predictor.checkpoint import CheckpointInfo, save_checkpoint
from predictor.data.springs import Physics, SpringsConfig, make_episodes, spring_spec
from predictor.data.store import Episode, StoreInfo, read_store, write_store
from predictor.data.windows import Windows
from predictor.dgvae import DGVAE
from predictor.dgvae.config import DGVAEConfig
from predictor.evaluation.edge_findings import infer_edges, labelled_pairs, measure
from predictor.evaluation.edge_scores import (
    StillnessTally,
    chance_correlation,
    correlations,
    disentanglement,
    rank_statistic,
    score_factor,
    separation,
    shuffled_by_group,
)
from predictor.evaluation.outcomes import run_window_batch
from predictor.forecaster import Belief, Memory
from predictor.interpret import InterpretConfig, interpret
from predictor.reports import edge_plots as pictures
from predictor.reports.tables import _graph_lines, _stillness_note
from predictor.scene import KINEMATIC_FEATURES_3D, SceneSpec
from predictor.support.errors import UserError, run_entry_point
from tests.predictor.helpers import RICH, circling_episode, model, spec, write_circles

PAIRS = 600


def drawn(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape)


# --- One property -----------------------------------------------------------------------------------------------------


def test_correlations_have_a_sign_and_dead_dimensions_have_none():
    factor = drawn(0, PAIRS)
    noise = 0.3 + 1e-9 * drawn(1, PAIRS)
    features = np.stack([factor, -3 * factor + 7, np.full(PAIRS, 2.0), noise], axis=1)
    assert correlations(features, factor) == pytest.approx((1.0, -1.0, 0.0, 0.0))
    assert correlations(features, np.ones(PAIRS)) == (0.0, 0.0, 0.0, 0.0)


@given(st.integers(0, 10**6))
def test_correlations_against_numpy(seed: int):
    features, factor = drawn(seed, 30, 2), drawn(seed + 1, 30)
    assert correlations(features, factor) == pytest.approx([np.corrcoef(c, factor)[0, 1] for c in features.T])


def test_a_feature_that_is_the_attribute():
    factor, groups = 1.0 + drawn(0, PAIRS), np.arange(PAIRS) // 2
    features = np.stack([drawn(1, PAIRS), factor], axis=1)
    score = score_factor("k", features, factor, groups, np.abs(drawn(2, PAIRS)), labelled_dimension=1)
    assert (score.name, score.pairs, score.dimension) == ("k", PAIRS, 1)
    assert score.correlation == pytest.approx(1.0) and score.r2 == pytest.approx(1.0)
    assert score.direct_r2 == pytest.approx(1.0) and score.linear_r2 == pytest.approx(1.0, abs=1e-4)
    assert score.chance is not None and score.chance < 0.2
    assert score.distance_correlation is not None and abs(score.distance_correlation) < 0.2
    assert score.correlations[1] == score.correlation


def test_a_feature_that_is_the_attribute_upside_down():
    factor = 1.0 + drawn(0, PAIRS)
    score = score_factor("k", -2 * factor[:, None], factor, np.arange(PAIRS), drawn(1, PAIRS), labelled_dimension=0)
    assert score.correlation == pytest.approx(-1.0) and score.r2 == pytest.approx(1.0)
    assert score.direct_r2 is not None and score.direct_r2 < 0
    beyond = score_factor("k", -2 * factor[:, None], factor, np.arange(PAIRS), drawn(1, PAIRS), labelled_dimension=1)
    assert beyond.direct_r2 is None


def test_features_that_know_nothing_stay_about_at_chance():
    score = score_factor("k", drawn(0, PAIRS, 8), drawn(1, PAIRS), np.arange(PAIRS), drawn(2, PAIRS))
    assert score.correlation is not None and score.chance is not None
    assert abs(score.correlation) < 1.2 * score.chance < 0.2
    assert score.linear_r2 is not None and score.linear_r2 < 0.05


@pytest.mark.parametrize("factor", [np.zeros(0), np.array([1.0, 2.0]), np.full(50, 3.0)], ids=["none", "two", "alike"])
def test_nothing_is_said_of_a_property_that_does_not_vary(factor: np.ndarray):
    pairs = len(factor)
    score = score_factor("k", drawn(0, pairs, 2), factor, np.arange(pairs), np.ones(pairs), labelled_dimension=0)
    assert (score.pairs, score.dimension, score.correlation, score.direct_r2) == (pairs, None, None, None)


# --- Chance -----------------------------------------------------------------------------------------------------------


@given(st.integers(0, 10**6), st.integers(1, 7), st.sampled_from([2, 4, 6]))
def test_dealing_out_is_a_permutation_that_keeps_couples(seed: int, groups: int, size: int):
    couples = np.arange(groups * size) // 2  # both directions of a pair have one value
    dealt = shuffled_by_group(couples.astype(float), np.arange(groups * size) // size, np.random.default_rng(seed))
    assert sorted(dealt.tolist()) == sorted(couples.tolist())
    assert (dealt[::2] == dealt[1::2]).all()
    homes = dealt.reshape(groups, size) // (size // 2)
    assert (homes == homes[:, :1]).all()  # a group's values stay together


def test_dealing_out_fills_longer_groups_by_repeating():
    groups, factor = np.array([0, 1, 1, 1, 1, 1]), np.array([9.0, 1.0, 2.0, 3.0, 4.0, 5.0])
    seen = {tuple(shuffled_by_group(factor, groups, np.random.default_rng(seed)).tolist()) for seed in range(50)}
    swapped = {values for values in seen if values[0] != 9.0}
    assert all(values[1:] == (9.0,) * 5 for values in swapped) and len(swapped) > 1
    assert all(sorted(values) == [1.0, 2.0, 3.0, 4.0, 5.0, 9.0] for values in seen - swapped)


def test_chance_is_that_of_the_episodes_not_of_the_pairs():
    """Twenty episodes of one value each have twenty things to compare, however many pairs they have."""
    groups = np.repeat(np.arange(20), 50)
    factor, features = drawn(0, 20)[groups], drawn(1, 20)[groups][:, None]
    alike = chance_correlation(features, factor, groups)
    single = chance_correlation(features, factor, np.arange(1000))
    assert single == pytest.approx(2 / np.sqrt(1000), rel=0.3)
    assert alike == pytest.approx(2 / np.sqrt(20), rel=0.3)


# --- Edges ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "share"),
    [
        ([1.0, 2.0, 3.0, 4.0], 1.0),
        ([4.0, 3.0, 2.0, 1.0], 0.0),
        ([1.0, 1.0, 1.0, 1.0], 0.5),
        ([1.0, 3.0, 2.0, 4.0], 0.75),
    ],
    ids=["above", "below", "alike", "one couple of four"],
)
def test_rank_statistic_closed_form(values: list[float], share: float):
    assert rank_statistic(np.array(values)[:, None], np.array([False, False, True, True])) == [share]


@given(st.integers(0, 10**6))
def test_rank_statistic_is_that_of_all_couples(seed: int):
    rng = np.random.default_rng(seed)
    values, exists = rng.integers(5, size=(40, 2)).astype(float), rng.random(40) < 0.4
    exists[:2] = False, True
    difference = values[exists][:, None] - values[~exists][None]
    share = ((difference > 0) + 0.5 * (difference == 0)).mean(axis=(0, 1))
    assert rank_statistic(values, exists) == pytest.approx(share.tolist(), abs=1e-12)


def test_rank_statistic_needs_both_kinds():
    with pytest.raises(ValueError, match="pairs with and without an edge are needed, got 3 with and 0 without"):
        rank_statistic(np.zeros((3, 1)), np.ones(3, dtype=np.bool_))


def test_separation_finds_a_dimension_that_is_small_on_edges():
    exists = np.arange(PAIRS) % 3 == 0
    features = np.stack([drawn(0, PAIRS), -1.0 * exists, drawn(1, PAIRS)], axis=1)
    found = separation(features, 0.1 + 0.8 * exists, exists)
    assert found is not None and (found.dimension, found.auc, found.edge_prob_auc) == (1, 0.0, 1.0)
    assert separation(features, np.ones(PAIRS), np.ones(PAIRS, dtype=np.bool_)) is None


# --- Disentanglement --------------------------------------------------------------------------------------------------


def test_copies_of_two_attributes_are_disentangled():
    factors = drawn(0, 2000, 2)
    found = disentanglement(factors[:, ::-1].copy(), factors, np.arange(2000) // 10)
    assert found.dci is not None and found.note == ""
    assert found.dci.disentanglement == pytest.approx(1.0) and found.mig is not None and found.mig > 0.95


def test_attributes_that_do_not_vary_are_left_out():
    factors = np.concatenate([drawn(0, PAIRS, 1), np.full((PAIRS, 1), 1.5)], axis=1)
    each = np.arange(PAIRS)
    found = disentanglement(drawn(1, PAIRS, 2), factors, each)
    assert found.dci is not None and found.dci.disentanglement is None  # one factor is left
    assert disentanglement(drawn(1, PAIRS, 2), np.ones((PAIRS, 1)), each).note == "no attribute varies"
    assert disentanglement(drawn(1, 3, 2), drawn(2, 3, 1), each[:3]).note == "needs at least 4 edges, got 3"
    alone = disentanglement(drawn(1, PAIRS, 2), factors, 0 * each)
    assert alone.note == f"dci needs at least 2 points in each half, got 0 and {PAIRS}" and alone.mig is not None


# --- Stillness --------------------------------------------------------------------------------------------------------


def stillness(features: np.ndarray) -> tuple[float | None, ...]:
    tally = StillnessTally()
    tally.add(features)
    return tally.results().within


def test_features_that_stand_still_move_or_are_dead():
    edges, steps = 40, 7
    still = np.broadcast_to(drawn(0, edges, 1), (edges, steps))
    moving = np.broadcast_to(drawn(1, 1, steps), (edges, steps))
    dead = np.full((edges, steps), 0.3, dtype=np.float32) + 1e-9
    assert stillness(np.stack([still, moving, dead], axis=-1)) == (pytest.approx(0.0), pytest.approx(1.0), None)


def test_half_of_the_variance_is_over_time():
    sides = np.array([[[0.0], [2.0]], [[2.0], [4.0]]])  # around means 1 and 3, by ±1 each
    assert stillness(sides) == (pytest.approx(0.5),)


@given(st.integers(0, 10**6))
def test_stillness_adds_up_over_batches(seed: int):
    features = drawn(seed, 12, 5, 3) + 10 * drawn(seed + 1, 12, 1, 3)
    tally = StillnessTally()
    for part in np.array_split(features, 4):
        tally.add(part)
    found = tally.results()
    within = features.var(axis=1).mean(axis=0) / features.var(axis=(0, 1))
    assert (found.edges, found.steps) == (12, 5)
    assert found.within == pytest.approx(within.tolist())
    assert found.spread == pytest.approx(features.std(axis=(0, 1)).tolist())


def test_one_step_or_no_edge_says_nothing_of_stillness():
    assert stillness(drawn(0, 9, 1, 2)) == (None, None)
    assert stillness(np.zeros((0, 5, 2))) == (None, None)
    assert StillnessTally().results().within == ()


# --- Inferred edges ---------------------------------------------------------------------------------------------------


class DistanceModel:
    """Gives the distance of every pair as a feature, and an edge if the sender is ahead on x."""

    horizon_steps, num_edge_types, edge_feature_dim = 2, 2, 2

    def __init__(self) -> None:
        self.spec = spec(has_ego=False)

    def empty_memory(self, batch: int, agents: int) -> Memory:
        return Memory()

    def observe(self, memory: Memory, states: torch.Tensor, valid: torch.Tensor) -> tuple[Memory, Belief]:
        gap = states[:, None, :, :2] - states[:, :, None, :2]
        ahead = (gap[..., 0] > 0).float()
        features = torch.stack([torch.linalg.vector_norm(gap, dim=-1), gap[..., 0]], dim=-1)
        return memory, Belief(states, valid, torch.stack([1 - ahead, ahead], dim=-1), features, None)

    def rollout(self, *_: Any, **__: Any) -> torch.Tensor:
        raise AssertionError("no forecast is needed")


def labelled_episode(seed: int, steps: int = 8, agents: int = 4) -> Episode:
    """Labels at every step: the sender leads who is behind it on x, at a known distance; nothing known of agent 3."""
    episode = circling_episode(seed, steps, agents)
    gap = episode.states[:, None, :, :2] - episode.states[:, :, None, :2]
    types = (gap[..., 0] > 0).astype(np.int8)
    types[:, 3] = -1
    return replace(episode, edge_types=types, edge_attributes=np.linalg.norm(gap, axis=-1)[..., None])


def labelled_windows() -> Windows:
    return Windows([labelled_episode(i) for i in range(6)], spec(has_ego=False), 4, 2, 2, 4)


def test_watching_ends_with_what_the_forecaster_believes():
    windows, forecaster = labelled_windows(), model("rich", has_ego=False)
    batch = windows.batch(np.array([0, 3, 7]))
    inferred = infer_edges(forecaster, batch)
    outcome = run_window_batch(forecaster, batch, 2, keep_beliefs=True)
    assert inferred.features.shape[:2] == (3, 4) and inferred.pairs.sum() == 3 * 4 * 12
    np.testing.assert_array_equal(inferred.features[:, -1], outcome.edge_features)
    np.testing.assert_array_equal(inferred.edge_probs[:, -1], outcome.edge_probs)
    static = slice(0, forecaster.config.static_dim)
    first = infer_edges(forecaster, windows.batch(np.array([0]), history_steps=4)).features[:, 0]
    # a batch of three against a batch of one: float32 products round by the size of their batch
    np.testing.assert_allclose(inferred.features[:1, 0, ..., static], first[..., static], rtol=1e-5, atol=1e-6)


def test_known_pairs_are_read_at_the_last_observed_step():
    windows = labelled_windows()
    batch = windows.batch(np.array([1, 2]))
    pairs = labelled_pairs(infer_edges(DistanceModel(), batch), batch, windows.index[[1, 2], 0], 2)
    assert pairs is not None and len(pairs.group) == 2 * 9  # of 12 pairs, three have agent 3 as receiver
    np.testing.assert_allclose(pairs.features[:, 0], pairs.attributes[:, 0], rtol=1e-5)
    np.testing.assert_allclose(pairs.distance_m, pairs.attributes[:, 0], rtol=1e-5)
    np.testing.assert_array_equal(pairs.exists, pairs.features[:, 1] > 0)
    np.testing.assert_array_equal(pairs.exists, pairs.edge_prob > 0.5)
    assert pairs.group.tolist() == [0] * 18


def test_no_labels_no_pairs():
    windows = Windows([circling_episode(0)], spec(has_ego=False), 3, 2, 2, 3)
    batch = windows.batch(np.array([0]))
    assert labelled_pairs(infer_edges(DistanceModel(), batch), batch, np.array([0]), 2) is None


def test_a_forecaster_that_knows_everything_scores_it():
    windows = labelled_windows()
    parts = np.array_split(np.arange(len(windows)), 3)
    found, accuracies = measure(DistanceModel(), windows, parts, ("distance_m",))
    assert (found.windows, found.episodes) == (len(windows), 6)
    assert found.graph is not None and found.graph.accuracy == 1.0 and (accuracies == 1.0).all()
    assert found.separation is not None and found.separation.edge_prob_auc == found.separation.auc == 1.0
    assert found.edges is not None and found.edges.dimension == 1
    (distance,) = found.attributes
    assert (distance.name, distance.dimension) == ("distance_m", 0)
    assert distance.correlation == pytest.approx(1.0) and distance.direct_r2 == pytest.approx(1.0)
    assert distance.distance_correlation == pytest.approx(1.0)
    assert found.reading is not None and (found.reading.dimension, found.reading.slope) == (0, 1.0)
    assert found.stillness.edges > 0 and found.stillness_late.steps == 2


def test_batches_do_not_matter():
    windows, forecaster = labelled_windows(), model("rich", has_ego=False)
    whole, one = measure(forecaster, windows, [np.arange(len(windows))], ("distance_m",))
    parts, two = measure(forecaster, windows, np.array_split(np.arange(len(windows)), 5), ("distance_m",))
    assert one.tolist() == two.tolist() and whole.graph is not None and parts.graph is not None
    assert whole.graph.confusion == parts.graph.confusion
    assert whole.attributes[0].correlations == pytest.approx(parts.attributes[0].correlations, abs=1e-5)
    assert whole.stillness.within == pytest.approx(parts.stillness.within, abs=1e-5)


def test_drivers_that_yield_do_not_count_as_wishing_to_stand():
    """As in training: 0 m/s is what highway-env writes while a driver yields, not what it wishes."""

    def scored(name: str) -> Any:
        episodes = [labelled_episode(i) for i in range(6)]
        for episode in episodes:
            assert episode.edge_attributes is not None
            episode.edge_attributes[:, 0] = 0.0
        windows = Windows(episodes, spec(has_ego=False), 4, 2, 2, 4)
        return measure(DistanceModel(), windows, [np.arange(len(windows))], (name,))[0].attributes[0]

    wish, other = scored("desired_speed_mps"), scored("distance_m")
    assert wish.direct_r2 == pytest.approx(1.0) and other.direct_r2 < 0.9
    assert 0 < wish.pairs < other.pairs


def test_a_feature_in_another_unit_is_read_with_a_line():
    class Inches(DistanceModel):
        def observe(self, memory: Memory, states: torch.Tensor, valid: torch.Tensor) -> tuple[Memory, Belief]:
            memory, belief = super().observe(memory, states, valid)
            return memory, replace(belief, edge_features=5 - belief.edge_features[..., :1] / 0.0254)

    windows = labelled_windows()
    found, _ = measure(Inches(), windows, [np.arange(len(windows))], ("distance_m",))
    assert found.reading is not None and found.attributes[0].correlation == pytest.approx(-1.0)
    assert (found.reading.slope, found.reading.offset) == pytest.approx((-0.0254, 5 * 0.0254), rel=1e-3)


def test_a_feature_that_learned_an_attribute_is_read_in_its_unit():
    """The second dimension learned the distance less 4 m, over 2 m; the first one what the data does not have."""

    class Labelled(DistanceModel):
        config = DGVAEConfig(
            feature_labels=("time_gap_s", "distance_m"), label_means=(7.0, 4.0), label_scales=(3.0, 2.0)
        )

        def observe(self, memory: Memory, states: torch.Tensor, valid: torch.Tensor) -> tuple[Memory, Belief]:
            memory, belief = super().observe(memory, states, valid)
            distance = (belief.edge_features[..., :1] - 4) / 2
            return memory, replace(belief, edge_features=torch.cat([torch.zeros_like(distance), distance], dim=-1))

    windows = labelled_windows()
    found, _ = measure(Labelled(), windows, [np.arange(len(windows))], ("distance_m",))
    assert found.attributes[0].direct_r2 == pytest.approx(1.0)
    assert found.reading is not None and (found.reading.dimension, found.reading.slope) == (1, 1.0)
    unknown, _ = measure(Labelled(), windows, [np.arange(len(windows))], ("headway_m",))
    assert unknown.attributes[0].direct_r2 is None
    assert unknown.reading is not None and (unknown.reading.dimension, unknown.reading.slope) == (1, pytest.approx(1.0))


# --- Pictures ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def ax() -> Iterator[Axes]:
    yield Figure().add_subplot()


def mask(*pairs: tuple[int, int]) -> np.ndarray:
    found = np.zeros((3, 3), dtype=np.bool_)
    for receiver, sender in pairs:
        found[receiver, sender] = True
    return found


def test_symmetric_graphs_are_lines_that_mark_what_is_wrong(ax: Axes):
    truth, said = mask((0, 1), (1, 0), (0, 2), (2, 0)), mask((0, 1), (1, 0), (1, 2), (2, 1))
    values = np.array([[0.0, 2.0, 5.0], [2.0, 0.0, 1.0], [5.0, 1.0, 0.0]])
    assert pictures.plot_graph(ax, pictures.circle(3), said, "abc", values, truth, (1.0, 2.0)) is ax
    lines = {line.get_color(): line for line in ax.lines}
    assert set(lines) == {pictures.RIGHT, pictures.MISSED, pictures.INVENTED} and len(ax.lines) == 3
    assert lines[pictures.MISSED].get_linestyle() == ":"
    assert (lines[pictures.INVENTED].get_linewidth(), lines[pictures.RIGHT].get_linewidth()) == pictures.WIDTHS
    assert sorted(text.get_text() for text in ax.texts) == ["1.00", "2.00", "a", "b", "c"]


def test_one_way_graphs_are_arrows_to_the_receiver(ax: Axes):
    places = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
    pictures.plot_graph(ax, places, mask((0, 1)), "abc", np.full((3, 3), 1.5), mask((0, 1), (1, 2)))
    arrows = [text for text in ax.texts if getattr(text, "arrow_patch", None) is not None]
    assert {(tuple(a.xy), tuple(a.xyann)) for a in arrows} == {((0.0, 0.0), (1.0, 0.0)), ((1.0, 0.0), (2.0, 0.0))}
    assert not ax.lines and [t.get_text() for t in ax.texts].count("1.50") == 1  # none on the one that was missed


def test_matrices_are_receivers_by_senders(ax: Axes):
    matrix = np.array([[np.nan, 1.0], [2.0, np.nan]])
    pictures.plot_matrix(ax, matrix, (1.0, 2.0), ["left", "right"], mask((0, 1))[:2, :2])
    (image,) = ax.images
    np.testing.assert_array_equal(image.get_array().filled(-1.0), [[-1.0, 1.0], [2.0, -1.0]])
    assert (
        [t.get_text() for t in ax.get_yticklabels()]
        == [t.get_text() for t in ax.get_xticklabels()]
        == ["left", "right"]
    )
    assert ax.lines[0].get_xydata().tolist() == [[1.0, 0.0]]


def test_a_matrix_without_contrast_shows_none(ax: Axes):
    pictures.plot_matrix(ax, np.full((2, 2), 1.5), (1.5, 1.5 + 1e-9), ["a", "b"])
    assert ax.images[0].get_clim() == pytest.approx((1.0, 2.0))


def test_three_axes_are_seen_along_the_one_that_varies_least():
    assert pictures.shown_axes(np.array([[0.0, 0.0, 0.0], [1.0, 0.1, 3.0]])) == [2, 0]
    assert pictures.shown_axes(np.array([[0.0, 0.0], [1.0, 3.0]])) == [0, 1]


# --- Entry point ------------------------------------------------------------------------------------------------------


def test_several_edge_types_are_compared_with_the_commonest():
    graph = {"accuracy": 0.6, "f1": 1.0, "pairs": 960, "commonest": 0.625, "true_connectivity": 1.0}
    text = _graph_lines({"graph": graph, "separation": None})
    assert text.endswith("the commonest type for all pairs has accuracy 0.625; 1.000 of them have an edge")


def run(monkeypatch: pytest.MonkeyPatch, *words: object) -> None:
    monkeypatch.setattr(sys, "argv", ["interpret", *map(str, words)])
    run_entry_point(interpretation.main)


def refuse(constant: str) -> None:
    raise AssertionError(f"{constant} is not JSON")


def saved(path: Path, layout: SceneSpec, **changes: Any) -> Path:
    config = replace(RICH, change_scales=(3.0,) * layout.num_features, **changes)
    torch.manual_seed(0)
    save_checkpoint(path, DGVAE(layout, config, 2), CheckpointInfo(layout, config, 2))
    return path


@pytest.fixture
def springs(tmp_path: Path) -> Path:
    physics = Physics(num_agents=4, frames=10)
    episodes = make_episodes(SpringsConfig(tmp_path, physics=physics), "test", 12)
    info = StoreInfo(spring_spec(physics), "springs", edge_attribute_names=("spring_constant",))
    write_store(tmp_path / "springs", info, episodes)
    return tmp_path / "springs"


SHORT = ("--burn-in-steps", 4, "--horizon-steps", 3, "--num-samples", 3, "--max-windows", 20)


@pytest.mark.slow
def test_smoke_with_labels(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], springs: Path, tmp_path: Path
):
    checkpoint, out = saved(tmp_path / "toy", spring_spec(Physics(num_agents=4))), tmp_path / "new" / "out"
    run(monkeypatch, "--checkpoint", checkpoint, "--data", springs, "--out", out, *SHORT)
    assert "spring_constant" in capsys.readouterr().out
    assert sorted(p.name for p in out.iterdir()) == sorted(interpretation.FILES)
    assert [p.name for p in out.parent.iterdir()] == ["out"]  # nothing half-written beside it
    for name in ("graph.png", "features.png", "trajectories.png"):
        picture = (out / name).read_bytes()
        assert picture.startswith(b"\x89PNG") and len(picture) > 10_000
    content = json.loads((out / "scores.json").read_text(), parse_constant=refuse)
    assert (content["windows"], content["episodes"], content["static_dim"]) == (20, 10, 3)
    assert content["graph"]["pairs"] == content["edges"]["pairs"] == 20 * 12
    (score,) = content["attributes"]
    assert score["name"] == "spring_constant" and 0 < score["pairs"] < 20 * 12
    assert len(score["correlations"]) == len(content["stillness"]["within"]) == 6
    assert score["direct_r2"] < 0 < score["chance"] < 1  # it is not trained
    assert content["config"]["burn_in_steps"] == 4 and content["provenance"]["command"]
    text = (out / "scores.md").read_text()
    assert "| property | pairs | best | r |" in text and "* DCI: disentanglement – (not defined for one" in text
    assert "| 2 | static |" in text and "| 3 | dynamic |" in text and "nan" not in text


@pytest.mark.slow
def test_titles_of_pictures_hold_names_and_no_paths(monkeypatch: pytest.MonkeyPatch, springs: Path, tmp_path: Path):
    texts: dict[str, list[str]] = {}

    def keep(figure: Figure, file: Path, **_: Any) -> None:
        texts[file.name] = [text.get_text() for text in figure.findobj(Text)]

    monkeypatch.setattr(Figure, "savefig", keep)
    checkpoint = saved(tmp_path / "toy", spring_spec(Physics(num_agents=4)))
    interpret(InterpretConfig(str(checkpoint), springs, tmp_path / "out", 5, 4, 3, 2))
    assert sorted(texts) == ["features.png", "graph.png", "trajectories.png"]
    for shown in texts.values():
        assert any("toy on springs" in text for text in shown)
        assert not any(str(tmp_path) in text for text in shown)


def test_without_scikit_learn_labels_are_refused_before_anything_is_measured(
    monkeypatch: pytest.MonkeyPatch, springs: Path, tmp_path: Path
):
    checkpoint, out = saved(tmp_path / "toy", spring_spec(Physics(num_agents=4))), tmp_path / "out"
    for name in [name for name in sys.modules if name.split(".")[0] == "sklearn"]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setattr(interpretation, "measure", lambda *_: pytest.fail("measured"))
    with pytest.raises(UserError, match=r"need scikit-learn: pip install 'dgvae-rl\[scores\]'"):
        interpret(InterpretConfig(str(checkpoint), springs, out, 5, 4, 3, 2))
    assert not out.exists()


@pytest.mark.slow
def test_smoke_without_labels_and_with_an_ego(springs: Path, tmp_path: Path):
    data, out = write_circles(tmp_path / "circles", episodes=3, steps=8, agents=3), tmp_path / "out"
    interpret(
        InterpretConfig(str(saved(tmp_path / "toy4", spring_spec(Physics(num_agents=4)))), springs, out, 5, 4, 3, 2)
    )
    assert (out / "graph.png").exists()
    (out / "notes.txt").write_text("mine")
    found = interpret(InterpretConfig(str(saved(tmp_path / "toy", spec())), data, out, 5, 4, 3, num_samples=1))
    assert (found.graph, found.edges, found.attributes, found.disentanglement) == (None, None, [], None)
    assert found.stillness.edges == 5 * 6
    names = {"features.png", "trajectories.png", "scores.json", "scores.md", "notes.txt"}
    assert {p.name for p in out.iterdir()} == names  # the other store's graph.png is gone
    text = (out / "scores.md").read_text()
    assert "In words" not in text and "Dimension by dimension" in text


@pytest.mark.slow
def test_smoke_of_driving_where_agents_come_and_go(tmp_path: Path):
    episodes = []
    for seed in range(4):
        episode = labelled_episode(seed, steps=9, agents=5)
        assert episode.edge_types is not None
        episode.edge_types[:, 0] = -1  # nothing is known of whom the ego follows
        episode.valid[:3, 2] = False
        episode.valid[6:, 4] = False
        episode.states[~episode.valid] = 0
        episodes.append(episode)
    layout, out = spec(max_agents=5), tmp_path / "out"
    write_store(tmp_path / "road", StoreInfo(layout, "road", edge_attribute_names=("headway_m",)), episodes)
    found = interpret(
        InterpretConfig(str(saved(tmp_path / "toy", layout)), tmp_path / "road", out, 8, 4, 3, num_samples=2)
    )
    assert found.attributes[0].distance_correlation == pytest.approx(1.0)
    assert found.graph is not None and 0 < found.graph.pairs < 8 * 20
    assert "An edge exists where the sender is the receiver's leader." in (out / "scores.md").read_text()
    assert (out / "graph.png").exists()


@pytest.mark.slow
@pytest.mark.parametrize("joints", [["hip", "toe"], 7, None])
def test_types_without_attributes_and_joints_with_names(joints: Any, tmp_path: Path):
    layout = SceneSpec(
        1.0, ("world",) * 3, feature_names=KINEMATIC_FEATURES_3D, feature_scales=(1.0,) * 6, has_ego=False, max_agents=9
    )
    states = np.random.default_rng(0).normal(size=(8, 2, 6)).astype(np.float32)
    types = np.zeros((1, 2, 2), dtype=np.int8)
    types[0, 0, 1] = 1
    episode = Episode(states, np.ones((8, 2), dtype=np.bool_), np.arange(2), edge_types=types)
    write_store(tmp_path / "solid", StoreInfo(layout, "solid", {"joints": joints}), [episode])
    checkpoint = saved(tmp_path / "toy", layout, static_dim=6)  # all of them: no dynamic block
    found = interpret(InterpretConfig(str(checkpoint), tmp_path / "solid", tmp_path / "out", 3, 4, 2, num_samples=1))
    assert found.attributes == [] and found.disentanglement is None and found.reading is None
    assert found.edges is not None and found.edges.pairs == 2 * 3
    assert (tmp_path / "out" / "graph.png").exists()


@pytest.mark.slow
def test_equal_seeds_give_equal_findings(monkeypatch: pytest.MonkeyPatch, springs: Path, tmp_path: Path):
    monkeypatch.setattr(interpretation, "_draw", lambda *_, **__: None)
    config = InterpretConfig(
        str(saved(tmp_path / "toy", spring_spec(Physics(num_agents=4)))), springs, tmp_path, 6, 4, 3, 2
    )
    assert interpret(config) == interpret(config)


# --- Refusals ---------------------------------------------------------------------------------------------------------


def no_features(springs: Path, folder: Path) -> list[Any]:
    return [
        "--checkpoint",
        saved(folder / "dvae", spring_spec(Physics(num_agents=4)), edge_feature_dim=0, static_dim=0),
    ]


def another_model(springs: Path, folder: Path) -> list[Any]:
    layout = spring_spec(Physics(num_agents=4))
    save_checkpoint(folder / "mlp", MLP(layout, MLPConfig(), 2), CheckpointInfo(layout, MLPConfig(), 2, model="mlp"))
    return ["--checkpoint", folder / "mlp"]


def another_store(springs: Path, folder: Path) -> list[Any]:
    return ["--checkpoint", saved(folder / "toy", spec(dt_s=0.5))]


def fitting(folder: Path) -> list[Any]:
    return ["--checkpoint", saved(folder / "toy", spring_spec(Physics(num_agents=4)))]


def alone(springs: Path, folder: Path) -> list[Any]:
    store = read_store(springs)
    lonely = [replace(e, valid=e.valid & (np.arange(4) == 1)) for e in store.episodes]
    write_store(folder / "lonely", store.info, lonely)
    return [*fitting(folder), "--data", folder / "lonely"]


def out_is_a_file(springs: Path, folder: Path) -> list[Any]:
    (folder / "file").write_text("mine")
    return [*fitting(folder), "--out", folder / "file"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            lambda s, f: ["--checkpoint", "constant-velocity"],
            "'constant-velocity' has no edge features to interpret; pass",
        ),
        (lambda s, f: ["--checkpoint", "highwy"], "no checkpoint 'highwy': neither a folder nor a shipped name"),
        (no_features, "dvae' was trained with edge_feature_dim=0 and has no edge features to interpret; pass a dG-VAE"),
        (
            another_model,
            "mlp' is a model 'mlp' and has no edge features to interpret; pass a dG-VAE with edge_feature_dim",
        ),
        (another_store, "toy' was trained at dt_s=0.5 but store "),
        (alone, "none of 20 windows has two agents at once, so there are no edges"),
        (lambda s, f: [*fitting(f), "--data", f / "nowhere"], "no episode store at "),
        (
            lambda s, f: [*fitting(f), "--burn-in-steps", 8],
            "springs: no window fits: episodes have at most 10 steps, a window needs 11; lower --burn-in-steps or",
        ),
        (lambda s, f: [*fitting(f), "--max-windows", 0], "max_windows must be at least 1, got 0"),
        (lambda s, f: [*fitting(f), "--num-samples", -1], "num_samples must be at least 1, got -1"),
        (out_is_a_file, "file is a file; choose another --out"),
    ],
)
def test_bad_input_is_one_line(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    springs: Path,
    tmp_path: Path,
    words: Any,
    message: str,
):
    given = ["--data", springs, "--out", tmp_path / "out", *SHORT, *words(springs, tmp_path)]
    with pytest.raises(SystemExit) as stop:
        run(monkeypatch, *given)
    assert stop.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    assert captured.err.startswith("error: ") and message in captured.err
    assert not (tmp_path / "out").exists() and not list(tmp_path.glob(".*partial"))


def test_the_longest_window_that_fits_is_watched(monkeypatch: pytest.MonkeyPatch, springs: Path, tmp_path: Path):
    monkeypatch.setattr(interpretation, "_draw", lambda *_, **__: None)
    checkpoint = saved(tmp_path / "toy", spring_spec(Physics(num_agents=4)))
    found = interpret(InterpretConfig(str(checkpoint), springs, tmp_path / "out", 20, 7, 3, num_samples=1))
    assert (found.windows, found.episodes, found.stillness.steps) == (12, 12, 7)
    with pytest.raises(UserError, match="a window needs 11"):
        interpret(InterpretConfig(str(checkpoint), springs, tmp_path / "out", 20, 7, 4, num_samples=1))


def test_one_observed_step_shows_no_change():
    content = {"stillness": {"steps": 1}, "stillness_late": {}, "edges": None}
    assert (
        _stillness_note(content) == "changing, static and spread: with one observed step there is no change to measure."
    )
