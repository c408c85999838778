"""Ablations change one part each: what a line's name says, and nothing else."""

from pathlib import Path
from typing import Any

import pytest

from predictor.evaluation.ablations import ABLATIONS
from predictor.evaluation.paper_tables import SPRINGS, Line
from predictor.models import configure
from predictor.suite import SuiteConfig, line_config

BOTH = pytest.mark.parametrize("name", ["modes", "modes-driving"])


def lines(name: str) -> dict[str, Line]:
    return {line.key: line for line in ABLATIONS[name].lines}


def options(line: Line) -> dict[str, Any]:
    return dict(text.split("=") for text in line.set) | line.train


def changed(name: str, key: str, base: str) -> dict[str, tuple[Any, Any]]:
    """Options in which a line differs from another: value there, value here."""
    there, here = options(lines(name)[base]), options(lines(name)[key])
    return {o: (there.get(o), here.get(o)) for o in there.keys() | here.keys() if there.get(o) != here.get(o)}


@BOTH
def test_modes_are_added_to_a_held_graph_and_nothing_else(name: str):
    assert changed(name, "frozen", "evolving") == {"rollout_graph": (None, "frozen")}
    assert changed(name, "plural", "frozen") == {"num_modes": (None, "20")}


@BOTH
@pytest.mark.parametrize(
    ("key", "difference"),
    [
        ("agents", {"joint_energy_weight": (None, 0.0)}),
        ("scenes", {"energy_weight": (None, 0.0)}),
        ("five", {"num_modes": ("20", "5")}),
        ("no-features", {"edge_feature_dim": ("16", "0")}),
        ("unpriced", {"edge_cost": (5.0, 0.0)}),
        ("one-step", {"one_step_weight": (None, 0.0)}),
    ],
)
def test_each_line_lacks_what_its_name_says(name: str, key: str, difference: dict[str, Any]):
    assert changed(name, key, "plural") == difference


@BOTH
def test_the_plural_line_is_that_of_the_paper_tables_and_its_single_forecast_stands_beside_it(name: str):
    found = lines(name)
    assert found["plural-gaussian"].residual_of == "plural" and found["frozen-gaussian"].residual_of == "frozen"
    springs = next(line for line in SPRINGS.lines if line.key == "plural")
    if name == "modes":
        assert options(found["plural"]) == options(springs)


@pytest.mark.parametrize("name", ["recipe", "recipe-driving"])
def test_the_recipe_begins_with_the_papers_model_and_ends_with_the_enhanced_one(name: str):
    found = lines(name)
    config = configure("dgvae", "paper", found["paper"].set)
    assert (config.residual, config.innovation_rounds, config.substeps, config.gated_messages) == ("state", 0, 0, False)
    assert found["paper"].train["rollout_weight"] == 0 and not found["paper"].train["input_changes"]
    enhanced = next(line for line in SPRINGS.lines if line.key == "dgvae")
    fitted = {"fit_inputs": True} if name.endswith("driving") else {}
    assert options(found["priced"]) == options(enhanced) | fitted


def test_the_table_of_driving_has_episodes_of_its_own_for_the_test():
    table = ABLATIONS["modes-driving"]
    assert table.tests == {"test": "test/highway-fast-v0"} != {"test": table.train} and table.overlap_m == 2.0
    seeds = [command.split("--seed ")[1].split()[0] if "--seed" in command else "0" for command in table.commands]
    assert len(set(seeds)) == len(seeds) == 2


@pytest.mark.parametrize("name", ["recipe-driving", "modes-driving"])
def test_models_of_driving_are_selected_on_the_history_that_is_measured(name: Any):
    settings = SuiteConfig(name, Path(), Path(), "cpu")
    made = line_config(settings, lines(name)["priced" if name.startswith("recipe") else "plural"], Path())
    assert (made.history_steps, made.val_history_steps, made.min_history_steps) == (10, 5, 5)
    assert ABLATIONS[name].protocol.burn_in_steps == 5
