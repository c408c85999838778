"""Defines the paper's tables: their stores, their lines with a recipe each, budgets, and the paper's figures.

A line is a model and the training options in which it differs from its table; all others (data, steps, batch, history,
horizon, selection) are equal for all lines of a table. `predictor.suite` runs them.
"""

from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from predictor.models import ModelName

Budget = Literal["smoke", "cpu", "paper"]
Untrained = Literal["constant-velocity", "constant-velocity-noise", "least-squares", "majority"]
"""Forecasters without a training run."""
BURN_IN_STEPS = 40
HORIZON_STEPS = 10
NUM_SAMPLES = 20
"""Number of samples K of a stochastic model; the others have one forecast."""


@dataclass(frozen=True)
class Line:
    """One line of a table."""

    key: str
    """Short name, for folders."""
    name: str
    """Name in the table."""
    model: ModelName | Untrained
    """Name of the forecaster."""
    set: tuple[str, ...] = ()
    """Fields of the model's config (name=value), in addition to the sizes of the budget."""
    train: dict[str, Any] = field(default_factory=dict)
    """Fields of the training config that differ from those of the table."""
    paper: dict[str, float] = field(default_factory=dict)
    """The paper's figures, by column: "rmse", "ade", "fde", "ood_ade", "ood_fde" [m], and "graph", an accuracy."""

    @property
    def is_trained(self) -> bool:
        """Whether the line needs a training run."""
        return self.model not in get_args(Untrained)

    @property
    def num_samples(self) -> int:
        """Number of forecasts per window, K."""
        return NUM_SAMPLES if self.model in ("dgvae", "dnri", "constant-velocity-noise") else 1


@dataclass(frozen=True)
class Sizes:
    """Sizes of training and measuring in one budget of a table, equal for all its lines."""

    steps: int
    """Number of optimiser steps."""
    batch_size: int
    """Number of windows per step."""
    max_episodes: int
    """Number of training episodes used; 0 is all."""
    val_windows: int
    """Number of windows for model selection."""
    test_windows: int
    """Number of windows measured of each test store; 0 is all."""
    eval_every: int
    """Number of steps between validations."""
    widths: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Fields of the config (name=value) by model; empty takes the sizes of the papers."""


@dataclass(frozen=True)
class Protocol:
    """Lengths of the windows of a table; the defaults are those of docs/protocol.md."""

    burn_in_steps: int = BURN_IN_STEPS
    """Number of steps observed before the free run that is measured."""
    horizon_steps: int = HORIZON_STEPS
    """Number of steps of this free run."""
    train_history_steps: int = BURN_IN_STEPS
    """Largest number of observed steps of a window in training."""
    train_horizon_steps: int = HORIZON_STEPS
    """Number of steps forecast in training."""


@dataclass(frozen=True)
class Table:
    """One table of the paper."""

    title: str
    """Heading of the table."""
    train: str
    """Training store, below the data folder."""
    tests: dict[str, str]
    """Test stores by kind: "test", and if there is one, "ood" or "crowd"."""
    lines: tuple[Line, ...]
    """Lines in the order of the table."""
    budgets: dict[str, Sizes]
    """Sizes by name of the budget."""
    val: str | None = None
    """Validation store; None holds out training episodes."""
    test_stride: int = 1
    """Number of steps between two test windows of one episode."""
    commands: tuple[str, ...] = ()
    """Commands that make the stores."""
    protocol: Protocol = Protocol()
    """Lengths of the windows."""
    num_label_types: int = 0
    """Number of types in the stores' graphs, "no edge" included, where the inferred types are renamed by the
    permutation that is best on the whole test set, except of lines that were trained with labels; 0 renames nothing."""
    smallest_constant: float = 0.5
    """Smallest spring constant of the data [N/m], for least squares; pairs below half of it have no spring."""
    published: dict[str, float] = field(default_factory=dict)
    """Graph accuracies that another paper reports for this data, by its names."""


_SMALL = {
    "dgvae": ("hidden_dim=32", "rnn_dim=32", "head_dim=48", "message_dim=48", "decoder_dim=48"),
    "dnri": ("hidden_dim=64", "rnn_dim=32", "head_dim=64", "message_dim=64", "decoder_dim=64"),
    "imma": ("hidden_dim=64", "rnn_dim=32", "message_dim=64", "decoder_dim=64"),
}
"""Widths of a quarter to a half of the published ones, so that both graph models take about equal time on a CPU."""

_TINY = {
    "dgvae": ("hidden_dim=12", "rnn_dim=8", "head_dim=12", "message_dim=12", "decoder_dim=12"),
    "dnri": ("hidden_dim=12", "rnn_dim=8", "head_dim=12", "message_dim=12", "decoder_dim=12"),
    "imma": ("hidden_dim=12", "rnn_dim=8", "message_dim=12", "decoder_dim=12"),
}

_OURS = ("innovation_rounds=1", "forget_bias=2", "residual=trapezoid", "substeps=2", "gated_messages=true")
"""Options of the recipe in docs/training.md, in addition to the paper's network."""
_TEACHER_FORCED = {"rollout_weight": 0.0, "one_step_weight": 1.0, "likelihood": "gaussian"}
"""Training options of the NRI family: one-step likelihood under the posterior, no free run."""


def _dgvae(key: str, name: str, features: int, *more: str, paper: dict[str, float] | None = None, **train: Any) -> Line:
    changes = {"input_changes": True} | train
    return Line(key, name, "dgvae", (*_OURS, f"edge_feature_dim={features}", *more), changes, paper or {})


def _figures(rmse: float, ade: float, fde: float, ood_ade: float = 0.0, ood_fde: float = 0.0) -> dict[str, float]:
    figures = {"rmse": rmse, "ade": ade, "fde": fde}
    return figures | ({"ood_ade": ood_ade, "ood_fde": ood_fde} if ood_ade else {})


_LSTM_JOINT = ("joint=true",)

SPRINGS = Table(
    title="5-Spring",
    train="springs/train",
    val="springs/val",
    tests={"test": "springs/test", "ood": "springs/ood"},
    commands=("python -m predictor.data.springs --out {data}/springs",),
    lines=(
        Line("constant-velocity", "constant velocity", "constant-velocity"),
        Line("constant-velocity-noise", "constant velocity + noise", "constant-velocity-noise"),
        Line("mlp", "Linear (MLP)", "mlp", paper=_figures(0.196, 0.202, 0.446, 2.158, 3.541)),
        Line("lstm-joint", "LSTM (all agents)", "lstm", _LSTM_JOINT, paper=_figures(0.037, 0.024, 0.159, 0.406, 1.485)),
        Line("lstm", "LSTM (per agent)", "lstm"),
        Line("imma", "IMMA", "imma", paper=_figures(0.162, 0.176, 0.350, 1.389, 1.934)),
        Line(
            "dnri", "dNRI", "dnri", train=_TEACHER_FORCED,
            paper=_figures(0.114, 0.058, 0.469, 0.379, 1.372) | {"graph": 0.877},
        ),
        Line("dnri-free", "dNRI, trained in free run", "dnri", ("residual=trapezoid",), {"edge_cost": 1.0}),
        _dgvae("dvae", "dVAE (no edge features)", 0, edge_cost=5.0),
        _dgvae("dgvae", "dG-VAE", 16, edge_cost=5.0, paper=_figures(0.019, 0.011, 0.048, 0.302, 1.063)),
        _dgvae("dgvae-pm", "dG-VAE + pair matching", 24, "static_dim=16", edge_cost=5.0),
        _dgvae(
            "dgvae-pm-window", "dG-VAE + pair matching, whole window in training", 24,
            "static_dim=16", "pair_matching=window", edge_cost=5.0,
        ),
        _dgvae(
            "dgvae-rl", "dG-VAE + restricted labelling", 16, label_weight=200.0, type_label_weight=40.0,
            paper=_figures(0.016, 0.010, 0.063, 0.309, 1.032) | {"graph": 0.984},
        ),
        Line("least-squares", "least squares (limit)", "least-squares"),
    ),
    budgets={
        "smoke": Sizes(60, 16, 500, 100, 200, 30, _TINY),
        "cpu": Sizes(1500, 32, 10_000, 500, 2000, 250, _SMALL),
        "paper": Sizes(150 * 50_000 // 128, 128, 0, 2000, 0, 1000),
    },
)  # fmt: skip

_REAL_BUDGETS = {
    "smoke": Sizes(40, 4, 40, 20, 40, 20, _TINY),
    "cpu": Sizes(800, 8, 0, 200, 400, 200, _SMALL),
}


def _real_lines(
    features: int, static: int, paper: dict[str, dict[str, float]], more: tuple[str, ...] = ()
) -> tuple[Line, ...]:
    free = ("residual=trapezoid",)
    return (
        Line("constant-velocity", "constant velocity", "constant-velocity"),
        Line("constant-velocity-noise", "constant velocity + noise", "constant-velocity-noise"),
        Line("mlp", "Linear (MLP)", "mlp", paper=paper.get("mlp", {})),
        Line("lstm-joint", "LSTM (all agents)", "lstm", _LSTM_JOINT, paper=paper.get("lstm", {})),
        Line("lstm", "LSTM (per agent)", "lstm"),
        Line("imma", "IMMA", "imma", paper=paper.get("imma", {})),
        Line("dnri", "dNRI", "dnri", train=_TEACHER_FORCED, paper=paper.get("dnri", {})),
        Line("dnri-free", "dNRI, trained in free run", "dnri", free),
        _dgvae("dgvae", "dG-VAE", features, "substeps=1", *more, paper=paper.get("dgvae", {})),
        _dgvae(
            "dgvae-pm", "dG-VAE + pair matching", features, "substeps=1", *more, f"static_dim={static}",
            paper=paper.get("dgvae-pm", {}),
        ),
    )  # fmt: skip


MOCAP = Table(
    title="Motion capture, subjects 35 and 39",
    train="mocap35_train",
    val="mocap35_val",
    tests={"test": "mocap35_test", "ood": "mocap39"},
    test_stride=5,
    commands=(
        "python -m predictor.data.mocap --source CMU/35 --split train --all-phases --out {data}/mocap35_train",
        "python -m predictor.data.mocap --source CMU/35 --split val --out {data}/mocap35_val",
        "python -m predictor.data.mocap --source CMU/35 --split test --out {data}/mocap35_test",
        "python -m predictor.data.mocap --source CMU/39 --split all --out {data}/mocap39",
    ),
    lines=_real_lines(
        32, 16,
        {
            "mlp": _figures(2.726, 3.989, 4.493, 5.466, 5.750),
            "lstm": _figures(0.208, 0.167, 0.829, 0.291, 1.398),
            "imma": _figures(0.418, 0.583, 1.081, 1.274, 2.328),
            "dnri": _figures(0.161, 0.145, 0.699, 0.228, 1.124),
            "dgvae": _figures(0.068, 0.075, 0.294, 0.168, 0.790),
            "dgvae-pm": _figures(0.088, 0.083, 0.344, 0.167, 0.786),
        },
        ("zero_start=true",),
    ),
    budgets=_REAL_BUDGETS | {
        "cpu": Sizes(400, 2, 0, 40, 40, 100, _SMALL),
        "paper": Sizes(150 * 64, 64, 0, 200, 0, 500),
    },
)  # fmt: skip

NBA = Table(
    title="NBA",
    train="nba_train",
    tests={"test": "nba_test"},
    commands=(
        "python -m predictor.data.nba --source score/train --out {data}/nba_train",
        "python -m predictor.data.nba --source score/test --out {data}/nba_test",
    ),
    lines=_real_lines(
        32, 16,
        {
            "mlp": _figures(1.027, 1.038, 4.118),
            "lstm": _figures(0.884, 0.830, 2.895),
            "imma": _figures(1.036, 0.965, 2.922),
            "dnri": _figures(1.140, 0.802, 4.080),
            "dgvae": _figures(0.876, 0.547, 3.199),
            "dgvae-pm": _figures(0.579, 0.381, 2.166),
        },
    ),
    budgets=_REAL_BUDGETS | {"paper": Sizes(150 * 4000 // 128, 128, 0, 1000, 0, 500)},
)  # fmt: skip


def _crowd_lines(paper: dict[str, dict[str, float]]) -> tuple[Line, ...]:
    """Returns the lines for variable N(t): without those that need a fixed set of agents."""
    return tuple(
        line
        for line in _real_lines(64, 16, paper)
        if line.key
        in ("constant-velocity", "constant-velocity-noise", "lstm", "dnri", "dnri-free", "dgvae", "dgvae-pm")
    )


_CROWD_BUDGETS = _REAL_BUDGETS | {
    "cpu": Sizes(600, 4, 0, 60, 200, 150, _SMALL),
    "paper": Sizes(40_000, 1, 0, 300, 0, 1000),
}

SDD = Table(
    title="Stanford Drone Dataset",
    train="sdd_train",
    val="sdd_val",
    tests={"test": "sdd_test", "crowd": "sdd_crowd"},
    test_stride=5,
    commands=(
        *(
            f"python -m predictor.data.sdd --source SDD --split {split} --dt-s 0.2 --out {{data}}/sdd_{split}"
            for split in ("train", "val", "test")
        ),
        "python -m predictor.data.crowd --source {data}/sdd_test --episodes 3 --out {data}/sdd_crowd",
    ),
    lines=_crowd_lines({}),
    budgets=_CROWD_BUDGETS,
)

IND = Table(
    title="inD, out of distribution rounD",
    train="ind_train",
    val="ind_val",
    tests={"test": "ind_test", "ood": "round"},
    test_stride=5,
    commands=(
        "python -m predictor.data.levelx --source inD --split train --out {data}/ind_train",
        "python -m predictor.data.levelx --source inD --split val --out {data}/ind_val",
        "python -m predictor.data.levelx --source inD --split test --out {data}/ind_test",
        "python -m predictor.data.levelx --source rounD --split all --out {data}/round",
    ),
    lines=_crowd_lines(
        {
            "dnri": _figures(1.080, 0.561, 4.290, 4.831, 37.077),
            "dgvae": _figures(1.056, 0.486, 4.285, 4.958, 38.985),
            "dgvae-pm": _figures(1.104, 0.558, 4.441, 4.384, 34.848),
        }
    ),
    budgets=_CROWD_BUDGETS | {"cpu": Sizes(600, 1, 0, 60, 200, 100, _SMALL)},
)

_PLAIN = {"edge_cost": 0.0, "input_changes": False}
_SEES = ("forget_bias=2",)
_INFERS = (*_SEES, "innovation_rounds=1")
_MOVES = (*_INFERS, "residual=trapezoid", "substeps=2")
_WHOLE = (*_MOVES, "gated_messages=true")


def _recipe(key: str, name: str, sets: tuple[str, ...], **train: Any) -> Line:
    return Line(key, name, "dgvae", ("edge_feature_dim=16", *sets), {"edge_cost": 5.0, "input_changes": True} | train)


RECIPE = Table(
    title="5-Spring: what each part of the recipe is worth",
    train="springs/train",
    val="springs/val",
    tests={"test": "springs/test", "ood": "springs/ood"},
    commands=SPRINGS.commands,
    lines=(
        _recipe("paper", "paper's network, teacher-forced, Gaussian", (), **_PLAIN, **_TEACHER_FORCED),
        _recipe("free", "paper's network, free run", (), **_PLAIN),
        _recipe("sees", "+ input changes, forget bias", _SEES, edge_cost=0.0),
        _recipe("infers", "+ innovation", _INFERS, edge_cost=0.0),
        _recipe("moves", "+ velocity-consistent decoding, 2 substeps", _MOVES, edge_cost=0.0),
        _recipe("gated", "+ gated messages", _WHOLE, edge_cost=0.0),
        _recipe("priced", "+ price of edges (5 nats)", _WHOLE),
        _recipe("hard", "… hard samples", (*_WHOLE, "hard_samples=true")),
        _recipe("warm-up", "… KL warm-up over half of the steps", _WHOLE, kl_warmup_steps=150),
        _recipe("curriculum", "… free run grows over half of the steps", _WHOLE, curriculum_steps=150),
        _recipe("sigma", "… σ = 5e-3 instead of 5e-5", _WHOLE, variance=5e-3),
        _recipe("gaussian", "… Gaussian instead of Laplace", _WHOLE, likelihood="gaussian"),
        _recipe("labels", "… restricted labelling", _WHOLE, label_weight=200.0, type_label_weight=40.0),
    ),
    budgets={
        "smoke": Sizes(20, 8, 200, 50, 50, 20, _TINY),
        "cpu": Sizes(300, 32, 10_000, 500, 500, 100, _SMALL),
        "paper": Sizes(20_000, 128, 0, 2000, 0, 1000),
    },
)

TABLES: dict[str, Table] = {
    "springs": SPRINGS,
    "recipe": RECIPE,
    "mocap": MOCAP,
    "nba": NBA,
    "sdd": SDD,
    "ind": IND,
}
