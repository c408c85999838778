"""Models by name: built, recognised, configured from a command line, and read back from JSON."""

import dataclasses
import json
import math
import subprocess
import sys
from typing import Any, get_args

import pytest
import torch

from predictor.baselines.lstm import LSTMConfig
from predictor.baselines.mlp import MLPConfig
from predictor.dgvae.config import PRESETS, DGVAEConfig
from predictor.forecaster import TrainableForecaster
from predictor.models import KINDS, ModelName, build, config_from_json, configure, name_of, shapes_of
from predictor.support.errors import UserError
from tests.predictor.helpers import EVERY_MODEL, spec

every_model = pytest.mark.parametrize("kind", EVERY_MODEL)


@every_model
def test_a_built_model_is_recognised_and_trainable(kind: str):
    name, config = EVERY_MODEL[kind]
    made = build(name, spec(), config, horizon_steps=4)
    assert isinstance(made, TrainableForecaster)
    assert (name_of(made), made.config, made.spec, made.horizon_steps) == (name, config, spec(), 4)


@every_model
def test_configs_come_back_from_json(kind: str):
    name, config = EVERY_MODEL[kind]
    stored = json.loads(json.dumps(dataclasses.asdict(config)))
    assert config_from_json(name, stored) == config


def test_every_name_that_can_be_asked_for_exists():
    assert set(get_args(ModelName)) == set(KINDS) == {name for name, _ in EVERY_MODEL.values()}


def test_weights_come_from_torchs_generator():
    first, again, other = [], [], []
    for seed, weights in ((0, first), (0, again), (1, other)):
        torch.manual_seed(seed)
        weights.extend(build("dnri", spec(), EVERY_MODEL["dnri"][1], 2).parameters())
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(first, other, strict=True))


# --- Presets ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", get_args(ModelName))
def test_without_overrides_a_preset_is_what_was_published(name: str):
    config = configure(name, "paper")
    assert config == KINDS[name].config()
    assert isinstance(config, KINDS[name].config)


def test_fast_presets():
    """The dG-VAE has one of its own; of the others all widths are halved, and nothing but widths."""
    assert configure("dgvae", "fast") == PRESETS["fast"]
    assert configure("lstm", "fast") == LSTMConfig(embed_dim=32, rnn_dim=64)
    assert configure("mlp", "fast") == MLPConfig(hidden_dim=128)
    paper, fast = configure("imma", "paper"), configure("imma", "fast")
    assert fast == dataclasses.replace(paper, hidden_dim=128, rnn_dim=32, decoder_dim=128, message_dim=128)


# --- Overrides --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "text", "field", "value"),
    [
        ("dgvae", "hidden_dim=7", "hidden_dim", 7),
        ("dgvae", "temperature=0.25", "temperature", 0.25),
        ("dgvae", "dropout=1e-2", "dropout", 0.01),
        ("dgvae", "gated_messages=true", "gated_messages", True),
        ("dgvae", "hard_samples=False", "hard_samples", False),
        ("dgvae", "residual=trapezoid", "residual", "trapezoid"),
        ("dgvae", "pair_matching=window", "pair_matching", "window"),
        ("dgvae", "delta_scales=0.1,0.2,3,4e-1", "delta_scales", (0.1, 0.2, 3.0, 0.4)),
        ("dgvae", "feature_labels=leader,time_gap_s", "feature_labels", ("leader", "time_gap_s")),
        ("lstm", "joint=True", "joint", True),
        ("lstm", "num_agents=5", "num_agents", 5),
        ("imma", "num_layers=3", "num_layers", 3),
        ("dnri", "num_edge_types=4", "num_edge_types", 4),
        ("mlp", "residual=constant_velocity", "residual", "constant_velocity"),
    ],
)
def test_overrides(name: str, text: str, field: str, value: Any):
    config = configure(name, "paper", [text])
    given = getattr(config, field)
    assert given == value and type(given) is type(value)
    assert config == dataclasses.replace(KINDS[name].config(), **{field: value})


def test_an_override_wins_over_what_was_fitted_and_the_last_one_over_the_others():
    fitted = {"delta_scales": (1.0, 1.0, 1.0, 1.0), "change_scales": (2.0, 2.0, 2.0, 2.0)}
    config = configure("dgvae", "fast", ["delta_scales=5,6,7,8", "rnn_dim=3", "rnn_dim=4"], **fitted)
    assert (config.delta_scales, config.change_scales) == ((5.0, 6.0, 7.0, 8.0), (2.0, 2.0, 2.0, 2.0))
    assert config.rnn_dim == 4
    assert config.head_dim == PRESETS["fast"].head_dim


def test_overrides_that_depend_on_each_other_are_checked_together():
    assert configure("dgvae", "fast", ["static_dim=12", "edge_feature_dim=16"]).static_dim == 12


# --- Refusals ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        (
            "mlp",
            "rnn_dim=3",
            "--set takes field=value with a field of MLPConfig (hidden_dim, residual, delta_scales), got 'rnn_dim=3'",
        ),
        (
            "mlp",
            "hidden_dim",
            "--set takes field=value with a field of MLPConfig (hidden_dim, residual, delta_scales), got 'hidden_dim'",
        ),
        (
            "mlp",
            "hidden_dim=",
            "--set takes field=value with a field of MLPConfig (hidden_dim, residual, delta_scales), got 'hidden_dim='",
        ),
        ("dgvae", "hidden_dim=wide", "hidden_dim of DGVAEConfig must be of type int, got 'wide'"),
        ("dgvae", "hidden_dim=2.5", "hidden_dim of DGVAEConfig must be of type int, got '2.5'"),
        ("dgvae", "temperature=warm", "temperature of DGVAEConfig must be of type float, got 'warm'"),
        ("dgvae", "gated_messages=yes", "gated_messages of DGVAEConfig must be true or false, got 'yes'"),
        (
            "dnri",
            "residual=midpoint",
            "residual of DNRIConfig must be one of state, constant_velocity, trapezoid, got 'midpoint'",
        ),
        ("dgvae", "pair_matching=x", "pair_matching of DGVAEConfig must be one of window, causal, got 'x'"),
        ("lstm", "delta_scales=1,b", "delta_scales of LSTMConfig must be comma-separated numbers, got '1,b'"),
        ("dgvae", "rnn_dim=0", "rnn_dim must be at least 1, got 0"),
        ("dgvae", "static_dim=9", "static_dim must be at most edge_feature_dim (8), got 9"),
    ],
)
def test_bad_overrides_are_named(name: str, text: str, message: str):
    with pytest.raises(UserError) as error:
        configure(name, "fast", [text])
    assert str(error.value) == message


@pytest.mark.parametrize(
    "ask", [lambda n: build(n, spec(), None, 2), lambda n: configure(n, "paper"), lambda n: config_from_json(n, {})]
)
def test_unknown_models_are_named(ask: Any):
    with pytest.raises(UserError) as error:
        ask("transformer")
    assert str(error.value) == "no model 'transformer'; there are dgvae, dnri, imma, lstm, mlp"


def test_unknown_fields_of_a_checkpoint_are_named():
    with pytest.raises(UserError, match="unknown key 'attention_heads'; there are hidden_dim"):
        config_from_json("imma", {"hidden_dim": 4, "attention_heads": 2})


def test_values_of_a_checkpoint_are_checked():
    with pytest.raises(UserError, match="num_edge_types must be at least 2"):
        config_from_json("dgvae", dataclasses.asdict(DGVAEConfig()) | {"num_edge_types": 1})


def test_a_network_that_cannot_be_trained_has_no_name():
    with pytest.raises(UserError, match="Linear is not a trainable model; there are dgvae, dnri, imma, lstm, mlp"):
        name_of(torch.nn.Linear(1, 1))


@pytest.mark.parametrize("kind", EVERY_MODEL)
def test_shapes_are_known_without_memory(kind: str):
    name, config = EVERY_MODEL[kind]
    built = build(name, spec(), config, 3).state_dict()
    assert shapes_of(name, spec(), config, 3) == {key: tuple(tensor.shape) for key, tensor in built.items()}


def test_shapes_of_a_network_that_fits_nowhere_are_known_at_once():
    """A hidden layer of 65,536 by 65,536 would take 16 GiB."""
    shapes = shapes_of("dgvae", spec(), DGVAEConfig(hidden_dim=65_536, head_dim=65_536, decoder_dim=65_536), 3)
    assert max(math.prod(shape) for shape in shapes.values()) >= 2**32


@pytest.mark.slow
def test_shapes_need_no_compiler():
    """torch loads its compiler, which takes seconds, for arithmetic on the meta device: none is done there."""
    code = (
        "import sys; from predictor.checkpoint import load_checkpoint, shipped\n"
        "for name in shipped(): load_checkpoint(name)\n"
        "print('sympy' in sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"
