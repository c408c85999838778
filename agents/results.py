"""Results of several policies on the same seeds: their tables and files."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from rich.markup import escape
from rich.table import Table

from agents.differences import DRAWS, reference_policy, return_differences
from agents.episode_file import write_episodes
from agents.runs import SUMMARY_FILE
from agents.summaries import NEARLY_CONSTANT, PolicySummary, percent_digits, reports_only_events, summarize
from agents.vec_envs import EpisodeResult
from envs.registry import check_arguments, name_with
from envs.rollouts.driving_measures import HARD_BRAKING_MPS2, LONGEST_S
from predictor.evaluation.standard_errors import Estimate
from predictor.support import markdown
from predictor.support.errors import UserError, short
from predictor.support.files import finite, write_json, write_text
from predictor.support.provenance import provenance
from predictor.support.reading import read_object
from predictor.support.typed_values import converted, from_table

PACKAGES = (
    *("stable-baselines3", "sb3-contrib", "gymnasium", "pettingzoo", "highway-env", "mpe2", "envpool"),
    *("torch", "numpy"),
)
"""Packages whose versions the provenance names."""
FEW_EPISODES = 20
"""Number of episodes below which a table says that its bootstrap intervals are too narrow."""
MOST_EPISODES = 10_000
"""Largest number of episodes of a policy in a summary.json that is read."""
NOT_REPORTED = "not reported"
"""Cell of a rate of which an environment says nothing."""


@dataclass(frozen=True)
class Evaluation:
    """Results of several policies on the same seeds."""

    env_id: str
    """Gymnasium or PettingZoo id."""
    first_seed: int
    """Seed of the first episode; episode i was reset with first_seed + i."""
    results: dict[str, list[EpisodeResult]]
    """Results of the episodes, by policy."""
    has_ego: bool = True
    """Whether one agent is driven: the table then has its crash rate and speed, if the env reports them."""
    env_kwargs: str = ""
    """Arguments of the environment, as the text of a JSON object; empty if it had none."""

    @property
    def env(self) -> str:
        """Id of the environment, with its arguments where it had some."""
        return name_with(self.env_id, self.env_kwargs)

    @property
    def summaries(self) -> list[PolicySummary]:
        """Summaries, one per policy."""
        played = [e for episodes in self.results.values() for e in episodes]
        # a success with a crash counts as none, so it does not show that failures are reported
        succeeded = [e.success for e in played if not e.crashed]
        safe, failed = (reports_only_events(said) for said in ([e.crashed for e in played], succeeded))
        told = any(e.success is not None for e in played)
        return [summarize(policy, episodes, safe, failed, told) for policy, episodes in self.results.items()]

    @property
    def constant_policies(self) -> str:
        """A line on the policies that (nearly) always take one action, but for drivers that are named after it."""
        found = []
        for summary in self.summaries:
            action, share = next(iter(summary.action_shares.items()), ("", 0.0))
            if share >= NEARLY_CONSTANT and summary.policy not in (action, "idle"):
                found.append(f"{summary.policy} takes {action} in {100 * share:.1f} % of its steps")
        return f"(Nearly) constant: {'; '.join(found)}." if found else ""

    @property
    def reference(self) -> str | None:
        """Policy that the others are compared with, seed by seed (`agents.differences`)."""
        return reference_policy(self.results)

    @cached_property
    def differences(self) -> dict[str, Estimate]:
        """Mean difference of each policy's returns to those of the reference on the same seeds, with its interval."""
        return {} if self.reference is None else return_differences(self.results, self.reference)

    def write(self, folder: Path, **extra: Any) -> None:
        """Writes ``summary.json`` (with every episode and the provenance), ``summary.md`` and ``episodes.parquet``."""
        content = {
            "env_id": self.env_id,
            "env_kwargs": self.env_kwargs,
            "first_seed": self.first_seed,
            "has_ego": self.has_ego,
            **extra,
            "policies": [asdict(summary) for summary in self.summaries],
            "differences": {
                "reference": self.reference,
                "policies": {name: asdict(found) for name, found in self.differences.items()},
            },
            "episodes": {name: [asdict(e) for e in found] for name, found in self.results.items()},
            "provenance": provenance(PACKAGES),
        }
        write_json(folder / SUMMARY_FILE, finite(content))
        write_text(folder / "summary.md", self.markdown())
        write_episodes(folder, self.results)

    @property
    def parts(self) -> list["TablePart"]:
        """All tables: returns, driving, and paired differences."""
        summaries = self.summaries
        returns = _returns(summaries, self.has_ego, intervals=True)
        parts = [TablePart(*returns, f"{self.env}: {self._caption()}"), *self._driving(summaries), *self._compared()]
        return [*parts, TablePart([], [], self.constant_policies)] if self.constant_policies else parts

    def markdown(self) -> str:
        """Returns all tables as Markdown: returns, driving, and paired differences."""
        paragraphs = [p for part in self.parts for p in (part.headings and markdown.table(*part[:2]), part.told) if p]
        return "\n\n".join(paragraphs) + "\n"

    def table(self) -> Table:
        """Returns the table of returns for a terminal; with a column of success, rates have no intervals there."""
        summaries = self.summaries
        intervals = not _has_success(summaries)
        header, lines = _returns(summaries, self.has_ego, intervals)
        table = Table(title=escape(self.env), caption=self._caption(intervals))
        for i, name in enumerate(header):
            broken = escape(name.replace(" [", "\n[").replace(" (", "\n("))
            table.add_column(broken, justify="right" if i else "left", overflow="fold")
        for line in lines:
            table.add_row(*line)
        return table

    def _caption(self, intervals: bool = True) -> str:
        count = max(len(found) for found in self.results.values())
        caption = (
            f"{count} episodes each, the same seeds from {self.first_seed} on; mean ± standard error, length in policy "
            "steps"
        )
        if not self.has_ego:
            return f"{caption}; return: mean over the learners."
        if all(summary.crash_rate is None for summary in self.summaries):
            return (
                f"{caption}; crashes are not reported: no info has their key; name it, spelt as there, with "
                "--crash-key or in register_reader."
            )
        return f"{caption}, crash rate with its 95 % Wilson interval." if intervals else f"{caption}."

    def _driving(self, summaries: Sequence[PolicySummary]) -> list["TablePart"]:
        """Returns the table of driving measures and what it shows; a line where an ego's driving is not measured."""
        if not self.has_ego:
            return []
        if not any(summary.driving for summary in summaries):
            return [TablePart([], [], "Driving measures: not reported.")]
        lines = [[s.policy, *(column.cell(s.driving) for column in DRIVING)] for s in summaries]
        told = (
            f"Driving: mean over episodes ± standard error; times to contact are at most {LONGEST_S:g} s, hard braking "
            f"is above {HARD_BRAKING_MPS2:g} m/s²."
        )
        return [TablePart(["policy", *(column.heading for column in DRIVING)], lines, told)]

    def _compared(self) -> list["TablePart"]:
        """Returns the table of paired differences and what it shows; nothing if there is nothing to compare."""
        lines = [[name, _difference(found)] for name, found in self.differences.items()]
        if not lines:
            return []
        told = f"Differences: mean over the same seeds, 95 % bootstrap over episodes ({DRAWS:,} draws)."
        if min(map(len, self.results.values())) < FEW_EPISODES:
            told += f" Intervals of fewer than {FEW_EPISODES} episodes are too narrow."
        return [TablePart(["policy", f"return − return of {self.reference} (95 %)"], lines, told)]


class TablePart(NamedTuple):
    """Table of an evaluation, with what it shows."""

    headings: list[str]
    """Headings of the columns; empty if there is no table."""
    lines: list[list[str]]
    """Cells of each line."""
    told: str
    """Sentence below the table."""


def read_evaluation(file: Path) -> Evaluation:
    """Reads the summary.json that `Evaluation.write` wrote.

    Raises:
        UserError: there is no such file, or it is damaged.
    """
    content = read_object(file)
    for key in ("env_id", "first_seed", "has_ego", "episodes"):
        if key not in content:
            raise UserError(f"{file}: key '{key}' is missing; evaluate the policy again")
    episodes = converted(content["episodes"], dict[str, tuple[dict[str, Any], ...]], f"{file}: episodes")
    results = {}
    for name, found in episodes.items():
        if not found:
            raise UserError(f"{file}: episodes.{short(name, 40)} has no episode; evaluate the policy again")
        if len(found) > MOST_EPISODES:
            raise UserError(f"{file}: a policy may have at most {MOST_EPISODES:,} episodes, got {len(found):,}")
        # JSON has no NaN, which stands for a speed that is not reported
        known = [{"mean_speed_mps": None} | one for one in found]
        cleaned = [one | {"mean_speed_mps": math.nan} if one["mean_speed_mps"] is None else one for one in known]
        results[name] = [from_table(EpisodeResult, one, f"{file}: episodes.{short(name, 40)}") for one in cleaned]
    if not results:
        raise UserError(f"{file} has no episodes; evaluate the policy again")
    names = ("env_id", "first_seed", "env_kwargs", "has_ego")
    values: dict[str, Any] = {name: content[name] for name in names if name in content}
    check_arguments(values.get("env_kwargs", ""), f"{file}: env_kwargs")
    return from_table(Evaluation, values, str(file), {"results": results})


@dataclass(frozen=True)
class _Column:
    """Column of the table of driving measures."""

    heading: str
    """Heading, with the unit."""
    measure: str
    """Field of `DrivingMeasures`."""
    digits: int
    """Number of digits after the point."""
    percent: bool = False
    """Whether a share is shown in percent."""

    def cell(self, driving: dict[str, tuple[float, float]]) -> str:
        """Returns the cell of a policy; a dash if this is not measured."""
        mean, error = driving.get(self.measure, (math.nan, math.nan))
        if math.isnan(mean):
            return "–"
        scale, unit = (100.0, " %") if self.percent else (1.0, "")
        return f"{scale * mean:.{self.digits}f}{_plus_minus(scale * error, self.digits)}{unit}"


DRIVING = (
    _Column("time [s]", "time_s", 1),
    _Column("off-road", "off_road_share", 1, percent=True),
    _Column("lane changes", "lane_changes", 1),
    _Column("least time to contact [s]", "min_time_to_contact_s", 2),
    _Column("its 5 % quantile [s]", "low_time_to_contact_s", 2),
    _Column("hard braking", "hard_brake_share", 1, percent=True),
    _Column("jerk [m/s³]", "jerk_rms_mps3", 2),
)
"""Columns of the table of driving measures."""


def _returns(summaries: Sequence[PolicySummary], has_ego: bool, intervals: bool) -> tuple[list[str], list[list[str]]]:
    """Returns the header and the cells of each line; without an ego there are no columns of crashes and speed."""
    roles = list(dict.fromkeys(role for summary in summaries for role in summary.role_returns))
    header = ["policy", "return", *(f"return of {role}" for role in roles), "length"]
    lines = [_cells_of(summary, roles) for summary in summaries]
    if not has_ego:
        return header, lines
    success = _has_success(summaries)
    names = ("crash", "success") if success else ("crash",)
    header += [f"{name} rate (95 %)" if intervals else name for name in names] + ["speed [m/s]"]
    for summary, cells in zip(summaries, lines, strict=True):
        cells.append(_rate(summary.crash_rate, summary.crash_low, summary.crash_high, intervals))
        if success:
            cells.append(_rate(summary.success_rate, summary.success_low, summary.success_high, intervals))
        cells.append("–" if math.isnan(summary.mean_speed_mps) else f"{summary.mean_speed_mps:.1f}")
    return header, lines


def _has_success(summaries: Sequence[PolicySummary]) -> bool:
    return any(summary.success_rate is not None for summary in summaries)


def _cells_of(summary: PolicySummary, roles: Sequence[str]) -> list[str]:
    cells = [summary.policy, f"{summary.return_mean:.2f}{_plus_minus(summary.return_se, 2)}"]
    for role in roles:
        mean, error = summary.role_returns.get(role, (math.nan, math.nan))
        cells.append(f"{mean:.2f}{_plus_minus(error, 2)}")
    return [*cells, f"{summary.length_mean:.1f}{_plus_minus(summary.length_se, 1)}"]


def _rate(rate: float | None, low: float | None, high: float | None, interval: bool) -> str:
    if rate is None or low is None or high is None:
        return NOT_REPORTED
    digits = percent_digits(rate)
    return f"{100 * rate:.{digits}f} %" + (f" ({100 * low:.{digits}f}–{100 * high:.{digits}f} %)" if interval else "")


def _difference(found: Estimate) -> str:
    if found.interval is None:
        return _signed(found.value)
    return f"{_signed(found.value)} ({_signed(found.interval[0])} to {_signed(found.interval[1])})"


def _signed(value: float) -> str:
    return f"{value:+.2f}".replace("-", "−")


def _plus_minus(error: float, digits: int) -> str:
    return "" if math.isnan(error) else f" ± {error:.{digits}f}"
