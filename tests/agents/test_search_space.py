from dataclasses import asdict, fields
from typing import get_args

import pytest
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from agents.preset_settings import changed
from agents.presets import Algorithm, PPOPreset, SACPreset, preset_for
from agents.search_space import CHOICES, RANGES, search_space, tuned_names
from envs.registry import ENVS


@pytest.mark.parametrize("algorithm", get_args(Algorithm))
def test_every_preset_is_a_point_of_its_space(algorithm: Algorithm):
    for env_id in ENVS:
        preset = preset_for(env_id, algorithm)
        space = search_space(preset)
        assert {"learning_rate", "gamma"} < space.keys() < {field.name for field in fields(preset)}
        assert "net_arch" not in space
        for name, values in space.items():
            value = getattr(preset, name)
            assert values._contains(values.to_internal_repr(value)), (env_id, name)
        values = {name: getattr(preset, name) for name in space}
        assert changed(preset, values, "here") == preset


def test_every_point_is_a_valid_preset():
    for algorithm in get_args(Algorithm):
        preset = preset_for("highway-fast-v0", algorithm)
        for end in ("low", "high"):
            values = {name: getattr(RANGES[name], end) for name in tuned_names(preset) if name in RANGES}
            values = {name: type(getattr(preset, name))(value) for name, value in values.items()}
            values |= {
                name: CHOICES[name][0 if end == "low" else -1] for name in tuned_names(preset) if name in CHOICES
            }
            found = changed(preset, values, "here")
            assert asdict(found) != asdict(preset)


def test_kinds_of_values():
    space = search_space(PPOPreset(n_steps=100))
    assert isinstance(space["n_epochs"], IntDistribution)
    assert isinstance(space["learning_rate"], FloatDistribution) and space["learning_rate"].log
    assert isinstance(space["n_steps"], CategoricalDistribution) and 100 in space["n_steps"].choices
    assert "ent_coef" not in search_space(SACPreset()), "it is learned"
    assert isinstance(search_space(SACPreset(ent_coef=0.01))["ent_coef"], FloatDistribution)
