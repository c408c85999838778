"""Defines the paper's tables: their stores, their lines with a recipe each, budgets, and the paper's figures.

A line is a model and the training options in which it differs from its table; all others (data, steps, batch, history,
horizon, selection) are equal for all lines of a table. `predictor.suite` runs them.
"""

from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

from predictor.models import ModelName

Budget = Literal["smoke", "cpu", "paper"]
Untrained = Literal["constant-velocity", "constant-velocity-noise", "nearest-neighbours", "least-squares", "majority"]
"""Forecasters without a training run."""
STOCHASTIC = ("dgvae", "dnri", "constant-velocity-noise", "nearest-neighbours")
"""Models with samples of their own; the others draw theirs around their single forecast, from a fitted Gaussian."""
BURN_IN_STEPS = 40
HORIZON_STEPS = 10
NUM_SAMPLES = 20
"""Number of samples K, the same for every line of every table."""
MOST_FIT_WINDOWS = 2000
"""Largest number of training windows to which noise is fitted."""


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
    residual_of: str = ""
    """Key of the line whose trained model this line measures by its single forecast with fitted Gaussian noise."""

    @property
    def is_trained(self) -> bool:
        """Whether the line needs a training run, its own or that of `residual_of`."""
        return self.model not in get_args(Untrained)

    @property
    def draws_residuals(self) -> bool:
        """Whether samples are the single forecast with fitted Gaussian noise."""
        return bool(self.residual_of) or self.model not in STOCHASTIC

    def with_gaussian(self) -> "Line":
        """Returns the control of a stochastic line: its single forecast, with fitted Gaussian noise."""
        name = f"{self.name}, single forecast + Gaussian"
        return replace(self, key=f"{self.key}-gaussian", name=name, paper={}, residual_of=self.key)


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

    @property
    def fit_windows(self) -> int:
        """Number of training windows to which noise is fitted."""
        return min(self.test_windows or MOST_FIT_WINDOWS, MOST_FIT_WINDOWS)


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
class PaperTable:
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
    overlap_m: float = 0.0
    """Distance of two centres below which agents overlap [m]; 0 leaves the column out: points pass through another."""
    overlap_of: str = "agents"
    """Who overlaps, for the caption."""
    published: dict[str, float] = field(default_factory=dict)
    """Graph accuracies that another paper reports for this data, by its names."""


SMALL = {
    "dgvae": ("hidden_dim=32", "rnn_dim=32", "head_dim=48", "message_dim=48", "decoder_dim=48"),
    "dnri": ("hidden_dim=64", "rnn_dim=32", "head_dim=64", "message_dim=64", "decoder_dim=64"),
    "imma": ("hidden_dim=64", "rnn_dim=32", "message_dim=64", "decoder_dim=64"),
}
"""Widths of a quarter to a half of the published ones, so that both graph models take about equal time on a CPU."""

TINY = {
    "dgvae": ("hidden_dim=12", "rnn_dim=8", "head_dim=12", "message_dim=12", "decoder_dim=12"),
    "dnri": ("hidden_dim=12", "rnn_dim=8", "head_dim=12", "message_dim=12", "decoder_dim=12"),
    "imma": ("hidden_dim=12", "rnn_dim=8", "message_dim=12", "decoder_dim=12"),
}

OURS = ("innovation_rounds=1", "forget_bias=2", "residual=trapezoid", "substeps=2", "gated_messages=true")
"""Options of the dG-VAE+ (docs/training.md), in addition to the paper's network."""
MODES = ("num_modes=20", "rollout_graph=frozen")
"""Options of the plural dG-VAE+, in addition to those of the dG-VAE+."""
TEACHER_FORCED = {"rollout_weight": 0.0, "one_step_weight": 1.0, "likelihood": "gaussian"}
"""Training options of the NRI family: one-step likelihood under the posterior, no free run."""


CONTROLS = (
    Line("constant-velocity", "constant velocity + Gaussian", "constant-velocity"),
    Line("constant-velocity-noise", "constant velocity + noise", "constant-velocity-noise"),
    Line("nearest-neighbours", "nearest neighbours", "nearest-neighbours"),
)
"""Lines that learn nothing but the spread of errors, or nothing."""


def _dgvae(key: str, name: str, features: int, *more: str, paper: dict[str, float] | None = None, **train: Any) -> Line:
    """Returns a line of the dG-VAE+, the enhanced model."""
    changes = {"input_changes": True} | train
    return Line(key, name, "dgvae", (*OURS, f"edge_feature_dim={features}", *more), changes, paper or {})


def _papers(features: int, paper: dict[str, float]) -> Line:
    """Returns the line of the paper's own model, trained as the paper does."""
    return Line("dgvae-paper", "dG-VAE (paper)", "dgvae", (f"edge_feature_dim={features}",), TEACHER_FORCED, paper)


def _figures(rmse: float, ade: float, fde: float, ood_ade: float = 0.0, ood_fde: float = 0.0) -> dict[str, float]:
    figures = {"rmse": rmse, "ade": ade, "fde": fde}
    return figures | ({"ood_ade": ood_ade, "ood_fde": ood_fde} if ood_ade else {})


_LSTM_JOINT = ("joint=true",)
_LABELLED: dict[str, Any] = {"label_weight": 200.0, "type_label_weight": 40.0}
_SPRINGS_PLUS = _dgvae("dgvae", "dG-VAE+", 16, edge_cost=5.0)

SPRINGS = PaperTable(
    title="5-Spring",
    train="springs/train",
    val="springs/val",
    tests={"test": "springs/test", "ood": "springs/ood"},
    commands=("python -m predictor.data.springs --out {data}/springs",),
    lines=(
        *CONTROLS,
        Line("mlp", "Linear (MLP) + Gaussian", "mlp", paper=_figures(0.196, 0.202, 0.446, 2.158, 3.541)),
        Line(
            "lstm-joint", "LSTM (all agents) + Gaussian", "lstm", _LSTM_JOINT,
            paper=_figures(0.037, 0.024, 0.159, 0.406, 1.485),
        ),
        Line("lstm", "LSTM (per agent) + Gaussian", "lstm"),
        Line("imma", "IMMA + Gaussian", "imma", paper=_figures(0.162, 0.176, 0.350, 1.389, 1.934)),
        Line(
            "dnri", "dNRI", "dnri", train=TEACHER_FORCED,
            paper=_figures(0.114, 0.058, 0.469, 0.379, 1.372) | {"graph": 0.877},
        ),
        Line("dnri-free", "dNRI, trained in free run", "dnri", ("residual=trapezoid",), {"edge_cost": 1.0}),
        _papers(16, _figures(0.019, 0.011, 0.048, 0.302, 1.063)),
        _dgvae("dvae", "dVAE+ (no edge features)", 0, edge_cost=5.0),
        _SPRINGS_PLUS,
        _SPRINGS_PLUS.with_gaussian(),
        _dgvae("dgvae-sparse", "dG-VAE+, price of an edge 20 instead of 5 nats", 16, edge_cost=20.0),
        _dgvae("dgvae-pm", "dG-VAE+ with pair matching", 24, "static_dim=16", edge_cost=5.0),
        _dgvae(
            "dgvae-pm-window", "dG-VAE+ with pair matching, whole window in training", 24,
            "static_dim=16", "pair_matching=window", edge_cost=5.0,
        ),
        _dgvae(
            "dgvae-rl", "dG-VAE+ with restricted labelling", 16, **_LABELLED,
            paper=_figures(0.016, 0.010, 0.063, 0.309, 1.032) | {"graph": 0.984},
        ),
        _dgvae("plural", "plural dG-VAE+", 16, *MODES, edge_cost=5.0),
        _dgvae("plural-rl", "plural dG-VAE+ with restricted labelling", 16, *MODES, **_LABELLED),
        Line("least-squares", "least squares (limit) + Gaussian", "least-squares"),
    ),
    budgets={
        "smoke": Sizes(60, 16, 500, 100, 200, 30, TINY),
        "cpu": Sizes(1500, 32, 10_000, 500, 2000, 250, SMALL),
        "paper": Sizes(150 * 50_000 // 128, 128, 0, 2000, 0, 1000),
    },
)  # fmt: skip

_REAL_BUDGETS = {
    "smoke": Sizes(40, 4, 40, 20, 40, 20, TINY),
    "cpu": Sizes(800, 8, 0, 200, 400, 200, SMALL),
}


def _real_lines(
    features: int, static: int, paper: dict[str, dict[str, float]], more: tuple[str, ...] = ()
) -> tuple[Line, ...]:
    plus = _dgvae("dgvae", "dG-VAE+", features, "substeps=1", *more)
    return (
        *CONTROLS,
        Line("mlp", "Linear (MLP) + Gaussian", "mlp", paper=paper.get("mlp", {})),
        Line("lstm-joint", "LSTM (all agents) + Gaussian", "lstm", _LSTM_JOINT, paper=paper.get("lstm", {})),
        Line("lstm", "LSTM (per agent) + Gaussian", "lstm"),
        Line("imma", "IMMA + Gaussian", "imma", paper=paper.get("imma", {})),
        Line("dnri", "dNRI", "dnri", train=TEACHER_FORCED, paper=paper.get("dnri", {})),
        Line("dnri-free", "dNRI, trained in free run", "dnri", ("residual=trapezoid",)),
        _papers(features, paper.get("dgvae", {})),
        plus,
        plus.with_gaussian(),
        _dgvae(
            "dgvae-pm", "dG-VAE+ with pair matching", features, "substeps=1", *more, f"static_dim={static}",
            paper=paper.get("dgvae-pm", {}),
        ),
        _dgvae("plural", "plural dG-VAE+", features, "substeps=1", *more, *MODES),
    )  # fmt: skip


MOCAP = PaperTable(
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
        "cpu": Sizes(400, 2, 0, 40, 40, 100, SMALL),
        "paper": Sizes(150 * 64, 64, 0, 200, 0, 500),
    },
)  # fmt: skip

NBA = PaperTable(
    title="NBA",
    overlap_m=0.5,
    overlap_of="players",
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
    return tuple(line for line in _real_lines(64, 16, paper) if line.key not in ("mlp", "lstm-joint", "imma"))


_CROWD_BUDGETS = _REAL_BUDGETS | {
    "cpu": Sizes(600, 4, 0, 60, 200, 150, SMALL),
    "paper": Sizes(40_000, 1, 0, 300, 0, 1000),
}

SDD = PaperTable(
    title="Stanford Drone Dataset",
    overlap_m=0.5,
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

IND = PaperTable(
    title="inD, out of distribution rounD",
    overlap_m=2.0,
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
    budgets=_CROWD_BUDGETS | {"cpu": Sizes(600, 1, 0, 60, 200, 100, SMALL)},
)

TABLES: dict[str, PaperTable] = {
    "springs": SPRINGS,
    "mocap": MOCAP,
    "nba": NBA,
    "sdd": SDD,
    "ind": IND,
}
