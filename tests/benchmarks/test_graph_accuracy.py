"""Cheaper graphs: which variants of a checkpoint are measured."""

from pathlib import Path

import pytest

from benchmarks.graph_accuracy import GraphConfig, variants

EVOLVING = str(Path(__file__).parents[1] / "golden/0.1.0/checkpoints/dgvae")


@pytest.mark.parametrize(
    ("name", "graphs"),
    [
        (EVOLVING, [(0, "evolving"), (2, "evolving"), (0, "frozen")]),
        ("merge", [(0, "frozen"), (2, "frozen")]),  # plural: its modes hold the graph
    ],
)
def test_checkpoints_are_measured_with_every_graph_that_they_can_have(name: str, graphs: list[tuple[int, str]]):
    config = GraphConfig((Path(name),), (Path("any"),), neighbours=(2,))
    found = [(each.config.num_neighbours, each.config.rollout_graph) for each in variants(Path(name), config)]
    assert found == graphs
