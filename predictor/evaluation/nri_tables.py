"""Defines the tables of unsupervised graph accuracy on NRI's simulators, beside the figures that NRI reports.

As in NRI, the graph is read after 49 observed frames of a test rollout, and training sees rollouts of 49 frames: here
up to 39 of history and 10 of forecast. Figures of NRI: Table 1 of Kipf et al., ICML 2018, 5 particles.
"""

from typing import Any

from predictor.evaluation.paper_tables import CONTROLS, SMALL, TEACHER_FORCED, TINY, Line, PaperTable, Protocol, Sizes

_PROTOCOL = Protocol(burn_in_steps=49, horizon_steps=20, train_history_steps=39, train_horizon_steps=10)
_ONE_WINDOW = 99
"""Stride beyond a test rollout: its first 49 frames are observed, and no others."""

_BUDGETS: dict[str, Sizes] = {
    "smoke": Sizes(20, 8, 200, 40, 100, 10, TINY),
    "cpu": Sizes(2500, 32, 0, 200, 2000, 250, SMALL),
    "paper": Sizes(100_000, 128, 0, 2000, 0, 1000),
}

_INFERS = (
    "forget_bias=2",
    "innovation_rounds=1",
    "residual=trapezoid",
    "substeps=1",
    "rollout_graph=frozen",
)
"""The recipe of docs/training.md for a graph that does not change: a roll-out holds its edges."""


def _lines(types: int) -> tuple[Line, ...]:
    several = (f"num_edge_types={types}",)

    def enhanced(key: str, name: str, *more: str, **train: Any) -> Line:
        return Line(key, name, "dgvae", (*several, *_INFERS, *more), {"input_changes": True} | train)

    types_alone = enhanced("dvae", "dVAE+ (types alone)", "edge_feature_dim=0")
    return (
        Line("majority", "majority class, constant velocity + Gaussian", "majority"),
        *CONTROLS,
        Line("dnri", "dNRI", "dnri", several, TEACHER_FORCED),
        Line("dnri-free", "dNRI, trained in free run", "dnri", (*several, "residual=trapezoid"), {"edge_cost": 1.0}),
        Line("dgvae-paper", "dG-VAE (paper)", "dgvae", (*several, "edge_feature_dim=16"), TEACHER_FORCED),
        enhanced("dgvae", "dG-VAE+", "edge_feature_dim=16", "gated_messages=true", edge_cost=5.0),
        types_alone,
        types_alone.with_gaussian(),
        enhanced("plural", "plural dVAE+ (types alone)", "edge_feature_dim=0", "num_modes=20"),
        enhanced("supervised", "dVAE+ (types alone), trained with labels", "edge_feature_dim=0",
                 type_label_weight=40.0),
    )  # fmt: skip


NRI_TABLES: dict[str, PaperTable] = {
    "nri-springs": PaperTable(
        title="NRI's springs, 5 particles",
        train="nri-springs/train",
        val="nri-springs/val",
        tests={"test": "nri-springs/test"},
        lines=(*_lines(2), Line("least-squares", "least squares (limit) + Gaussian", "least-squares")),
        budgets=_BUDGETS,
        test_stride=_ONE_WINDOW,
        commands=("python -m predictor.data.nri --law springs --out {data}/nri-springs",),
        protocol=_PROTOCOL,
        num_label_types=2,
        smallest_constant=0.1,
        published={
            "Corr. (path)": 0.524, "Corr. (LSTM)": 0.527, "NRI (learned)": 0.999, "Supervised": 0.999,
        },
    ),
    "nri-charged": PaperTable(
        title="NRI's charged particles, 5 particles",
        train="nri-charged/train",
        val="nri-charged/val",
        tests={"test": "nri-charged/test"},
        lines=_lines(3),
        budgets=_BUDGETS,
        test_stride=_ONE_WINDOW,
        commands=("python -m predictor.data.nri --law charged --out {data}/nri-charged",),
        protocol=_PROTOCOL,
        num_label_types=3,
        published={
            "Corr. (path)": 0.558, "Corr. (LSTM)": 0.542, "NRI (learned)": 0.821, "Supervised": 0.950,
        },
    ),
}  # fmt: skip
