"""Defines the tables of ablations: what each part of the dG-VAE+ is worth, and what each part of its modes is worth.

Both exist on 5-Spring, where graph and future are known, and in driving, on recorded episodes of highway-fast-v0.
"""

from typing import Any

from predictor.evaluation.paper_tables import (
    CONTROLS,
    MODES,
    OURS,
    SMALL,
    SPRINGS,
    TEACHER_FORCED,
    TINY,
    Line,
    PaperTable,
    Protocol,
    Sizes,
)

_DRIVING = Protocol(burn_in_steps=5, horizon_steps=5, train_history_steps=10, train_horizon_steps=5)
"""Steps of 1 s; a longer burn-in would leave out the many episodes that end early, in a crash."""
_DRIVING_COMMANDS = (
    "python -m envs.collect --env-id highway-fast-v0 --episodes 400 --out {data}/train/highway-fast-v0",
    "python -m envs.collect --env-id highway-fast-v0 --episodes 100 --seed 500000 --out {data}/test/highway-fast-v0",
)
_SPRINGS_BUDGETS = {
    "smoke": Sizes(20, 8, 200, 50, 50, 20, TINY),
    "cpu": Sizes(300, 32, 10_000, 500, 500, 100, SMALL),
    "paper": Sizes(20_000, 128, 0, 2000, 0, 1000),
}
_DRIVING_BUDGETS = {
    "smoke": Sizes(20, 8, 40, 50, 50, 20, TINY),
    "cpu": Sizes(1000, 32, 0, 500, 500, 250, SMALL),
    "paper": Sizes(20_000, 128, 0, 2000, 0, 1000),
}


def _on_springs(title: str, lines: tuple[Line, ...]) -> PaperTable:
    return PaperTable(
        title=f"5-Spring: {title}", train=SPRINGS.train, val=SPRINGS.val, tests=SPRINGS.tests,
        commands=SPRINGS.commands, lines=lines, budgets=_SPRINGS_BUDGETS,
    )  # fmt: skip


def _in_driving(title: str, lines: tuple[Line, ...]) -> PaperTable:
    return PaperTable(
        title=f"highway-fast-v0: {title}", train="train/highway-fast-v0", tests={"test": "test/highway-fast-v0"},
        commands=_DRIVING_COMMANDS, lines=lines, budgets=_DRIVING_BUDGETS, test_stride=2, protocol=_DRIVING,
        overlap_m=2.0,
    )  # fmt: skip


# --- The network ------------------------------------------------------------------------------------------------------

_PLAIN = {"edge_cost": 0.0, "input_changes": False}
_SEES = ("forget_bias=2",)
_INFERS = (*_SEES, "innovation_rounds=1")
_MOVES = (*_INFERS, "residual=trapezoid", "substeps=2")
_WHOLE = (*_MOVES, "gated_messages=true")


def _recipe_lines(common: dict[str, Any], ramp_steps: int) -> tuple[Line, ...]:
    """Returns the steps from the paper's model to the dG-VAE+, then variants of it.

    Args:
        common: training options of all lines.
        ramp_steps: half of the optimiser steps of the cpu budget.
    """

    def line(key: str, name: str, sets: tuple[str, ...], **train: Any) -> Line:
        changes = {"edge_cost": 5.0, "input_changes": True} | common | train
        return Line(key, name, "dgvae", ("edge_feature_dim=16", *sets), changes)

    enhanced = line("priced", "+ price of edges (5 nats): dG-VAE+", _WHOLE)
    return (
        *CONTROLS,
        line("paper", "dG-VAE (paper): teacher-forced, Gaussian", (), **_PLAIN, **TEACHER_FORCED),
        line("free", "paper's network, free run", (), **_PLAIN),
        line("sees", "+ input changes, forget bias", _SEES, edge_cost=0.0),
        line("infers", "+ innovation", _INFERS, edge_cost=0.0),
        line("moves", "+ velocity-consistent decoding, 2 substeps", _MOVES, edge_cost=0.0),
        line("gated", "+ gated messages", _WHOLE, edge_cost=0.0),
        enhanced,
        enhanced.with_gaussian(),
        line("hard", "… hard samples", (*_WHOLE, "hard_samples=true")),
        line("warm-up", f"… KL warm-up over {ramp_steps} steps", _WHOLE, kl_warmup_steps=ramp_steps),
        line("curriculum", f"… free run grows over {ramp_steps} steps", _WHOLE, curriculum_steps=ramp_steps),
        line("sigma", "… σ = 5e-3 instead of 5e-5", _WHOLE, variance=5e-3),
        line("gaussian", "… Gaussian instead of Laplace", _WHOLE, likelihood="gaussian"),
    )


_LABELS = Line(
    "labels", "… restricted labelling", "dgvae", ("edge_feature_dim=16", *_WHOLE),
    {"edge_cost": 5.0, "input_changes": True, "label_weight": 200.0, "type_label_weight": 40.0},
)  # fmt: skip

# --- The modes --------------------------------------------------------------------------------------------------------


def _mode_lines(more: tuple[str, ...], common: dict[str, Any]) -> tuple[Line, ...]:
    """Returns the steps from the dG-VAE+ to the plural dG-VAE+, then the latter without one part each.

    Args:
        more: further options of the network.
        common: training options of all lines.
    """
    network = (*OURS, *more)

    def line(
        key: str, name: str, *sets: str, features: int = 16, base: tuple[str, ...] = network, **train: Any
    ) -> Line:
        changes = {"edge_cost": 5.0, "input_changes": True} | common | train
        return Line(key, name, "dgvae", (*base, f"edge_feature_dim={features}", *sets), changes)

    frozen = line("frozen", "no modes, graph held in a roll-out", "rollout_graph=frozen")
    plural = line("plural", "plural dG-VAE+ (20 modes, both energy scores)", *MODES)
    return (
        *CONTROLS,
        line("evolving", "dG-VAE+: no modes, types per pair alone"),
        frozen,
        frozen.with_gaussian(),
        plural,
        plural.with_gaussian(),
        line("agents", "… without the scenes' energy score", *MODES, joint_energy_weight=0.0),
        line("scenes", "… without the agents' energy score", *MODES, energy_weight=0.0),
        line("five", "… 5 modes", "num_modes=5", "rollout_graph=frozen"),
        line("no-features", "… no edge features", *MODES, features=0),
        line("unpriced", "… no price of edges", *MODES, edge_cost=0.0),
        line("one-step", "… no one-step likelihood", *MODES, one_step_weight=0.0),
        line("plain", "… network of the shipped checkpoints (preset plural) at this width", *MODES,
             base=("residual=constant_velocity",)),
    )  # fmt: skip


_TITLES = ("what each part of the dG-VAE+ is worth", "what each part of the modes is worth")
_FITTED = {"fit_inputs": True}
"""Roads are longer than wide, so inputs are divided by their spread."""

ABLATIONS: dict[str, PaperTable] = {
    "recipe": _on_springs(_TITLES[0], (*_recipe_lines({}, 150), _LABELS)),
    "recipe-driving": _in_driving(_TITLES[0], _recipe_lines(_FITTED, 500)),
    "modes": _on_springs(_TITLES[1], _mode_lines((), {})),
    "modes-driving": _in_driving(_TITLES[1], _mode_lines(("substeps=1",), _FITTED)),
}
