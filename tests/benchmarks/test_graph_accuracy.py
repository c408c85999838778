"""Cheaper graphs: which variants of a checkpoint are measured."""

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.graph_accuracy import GraphConfig, measure, variants
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.data.springs import SpringsConfig, make_episodes, spring_spec
from predictor.data.windows import Windows

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


def test_the_first_window_of_an_episode_counts_whatever_the_burn_in():
    """Windows of a stride of five whose histories have two steps, which end at steps 1, 6, …"""
    made = SpringsConfig(Path("any"))
    spec = spring_spec(made.physics)
    (whole,) = make_episodes(made, "test", 1)
    windows = Windows([replace(whole, states=whole.states[:12], valid=whole.valid[:12])], spec, 2, 3, 3, 2)
    config = GraphConfig((Path("any"),), (Path("any"),), burn_in_steps=2, horizon_steps=3, stride=5)
    assert measure(ConstantVelocity(spec, 3), windows, config)["windows"] == 2
