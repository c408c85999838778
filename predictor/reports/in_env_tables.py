"""Writes measurements in live environments as Markdown tables, between the markers of a page.

A table of a page stands between `<!-- table: NAME -->` and `<!-- end -->`; what is between them is replaced.
"""

import re
from collections.abc import Callable, Mapping, Sequence

from predictor.evaluation.in_env_record import Interval, Measurement
from predictor.reports.tables import metres, percent_range
from predictor.support.errors import UserError
from predictor.support.markdown import table

MARKED = re.compile(r"(<!-- table: ([\w-]+) -->\n).*?(<!-- end -->)", re.DOTALL)
"""Pattern of a table with its markers."""

Column = Callable[[Measurement], str]


PLURAL = "plural dG-VAE"
"""Name of a model whose samples are modes, as all that ship are."""


def _per_cent(value: float | None, interval: Interval | None) -> str:
    if value is None:
        return "–"
    return f"{100 * value:.0f} %" + (
        "" if interval is None else f" ({100 * interval[0]:.0f} to {100 * interval[1]:.0f})"
    )


def _either(first: str, second: str) -> str:
    return first if second == "–" else f"{first} / {second}"


COLUMNS: dict[str, Column] = {
    "env": lambda m: m.env_id + ("*" if m.note else ""),
    "driver": lambda m: m.driver,
    "episodes": lambda m: str(m.episodes),
    "K": lambda m: str(m.samples),
    "horizon": lambda m: "–" if m.horizon_steps is None else f"{m.horizon_steps} × {m.dt_s:g} s",
    "minADE₁ / minFDE₁ [m]": lambda m: _either(metres(m.min_ade_m), metres(m.min_fde_m)),
    "minADE₁ (95 %) / minFDE₁ [m]": lambda m: _either(metres(m.min_ade_m, m.min_ade_interval_m), metres(m.min_fde_m)),
    "minADE₁ [m]": lambda m: metres(m.min_ade_m, m.min_ade_interval_m),
    "best of K [m]": lambda m: metres(m.best_of_k_m),
    "one step of history (95 %) [m]": lambda m: metres(m.one_step_m, m.one_step_interval_m),
    "nearest neighbours ADE [m]": lambda m: metres(m.neighbours_m),
    "constant velocity ADE / FDE [m]": lambda m: _either(
        metres(m.constant_velocity_ade_m), metres(m.constant_velocity_fde_m)
    ),
    "ADE below constant velocity (95 %)": lambda m: _per_cent(m.below_cv, m.below_cv_interval),
    "latency median / p95 [ms]": lambda m: "–" if m.latency_ms is None else "{:.0f} / {:.0f}".format(*m.latency_ms),
    "forecasts": lambda m: "–" if m.forecasts is None else f"{m.forecasts:,}",
}
"""Columns by heading."""

CARD = (
    "env", "driver", "episodes", "K", "minADE₁ / minFDE₁ [m]", "best of K [m]", "nearest neighbours ADE [m]",
    "constant velocity ADE / FDE [m]", "ADE below constant velocity (95 %)",
)  # fmt: skip
"""Headings of the table in a checkpoint's card."""


def measurement_table(measurements: Sequence[Measurement], headings: Sequence[str] = CARD) -> str:
    """Returns a Markdown table, one line for each measurement, and the notes below it."""
    written = table(headings, [[COLUMNS[name](m) for name in headings] for m in measurements], "-r")
    envs_of: dict[str, list[str]] = {}
    for measurement in measurements:
        if measurement.note:
            envs_of.setdefault(measurement.note, []).append(measurement.env_id)
    return written + "".join(f"\n\n\\* {', '.join(envs)}: {note}." for note, envs in envs_of.items())


SAMPLES_HEADINGS = (
    "env", "K", "forecaster", "best of K (95 %) [m]", "joint best of K (95 %) [m]", "energy score (95 %) [m]",
    "90 % covers, by step", "overlap (truth)",
)  # fmt: skip


def samples_table(measurements: Sequence[Measurement], model: str = PLURAL) -> str:
    """Returns a Markdown table of what K samples are worth: the line of `model`, then those of its controls."""
    lines = []
    for m in measurements:
        if m.energy_m is None:
            continue
        covered = "–" if m.coverage is None else percent_range(m.coverage)
        if m.mixture_coverage is not None:
            covered += f"; with spread {percent_range(m.mixture_coverage)}"
        hit = "–" if m.overlap is None else "{:.1f} ({:.1f}) %".format(*(100 * o for o in m.overlap))
        lines.append(
            [
                m.env_id,
                str(m.samples),
                model,
                metres(m.best_of_k_m, m.best_of_k_interval_m),
                metres(m.joint_best_of_k_m, m.joint_best_of_k_interval_m),
                metres(m.energy_m, m.energy_interval_m),
                covered,
                hit,
            ]
        )
        for name, control in (m.controls or {}).items():
            figures = map(metres, (control.best_of_k_m, control.joint_best_of_k_m, control.energy_m))
            share = control.coverage
            lines.append(
                [m.env_id, str(m.samples), name, *figures, "–" if share is None else f"{100 * share:.0f} %", "–"]
            )
    return table(SAMPLES_HEADINGS, lines, "-r-r")


def card_section(measurements: Sequence[Measurement], model: str = PLURAL) -> str:
    """Returns the table of a checkpoint's card, whose model has this name, and the command and commit of each line."""
    commands = "\n".join(f"* {m.env_id}: `{m.command}`, {_commit(m)}" for m in measurements)
    sampled = [m for m in measurements if m.energy_m is not None]
    several = f"\n\n{samples_table(sampled, model)}" if sampled else ""
    return f"{measurement_table(measurements)}{several}\n\n{commands}"


def _commit(measurement: Measurement) -> str:
    made = f"commit {measurement.commit}" if measurement.commit else "commit not recorded"
    later = measurement.spread_commit
    return made + (f" (coverage with spread: {later})" if later else "")


def replace_tables(page: str, tables: Mapping[str, str]) -> str:
    """Returns a page with each marked table replaced.

    Raises:
        UserError: the page marks a table that is not among `tables`.
    """
    unknown = [name for _, name, _ in MARKED.findall(page) if name not in tables]
    if unknown:
        raise UserError(f"no table is called '{unknown[0]}'; there are {', '.join(tables)}: rename the marker")
    return MARKED.sub(lambda found: f"{found[1]}\n{tables[found[2]]}\n\n{found[3]}", page)
