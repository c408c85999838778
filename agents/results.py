"""Results of several policies on the same seeds: their tables and files."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from agents.summaries import PolicySummary, summarize
from agents.vec_envs import EpisodeResult
from predictor.support import markdown
from predictor.support.files import finite, write_json, write_text
from predictor.support.provenance import provenance

NEARLY_CONSTANT = 0.95
"""Least share of one action from which on a policy is called nearly constant."""
PACKAGES = ("stable-baselines3", "gymnasium", "pettingzoo", "highway-env", "mpe2", "envpool", "torch", "numpy")
"""Packages whose versions the provenance names."""


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
    """Whether one agent is driven: the table then has its crash rate and speed, "–" if the env does not report them."""

    @property
    def summaries(self) -> list[PolicySummary]:
        """Summaries, one per policy."""
        return [summarize(policy, episodes) for policy, episodes in self.results.items()]

    @property
    def constant_policies(self) -> str:
        """A line on the policies that (nearly) always take one action, but for drivers that are named after it."""
        found = []
        for summary in self.summaries:
            action, share = next(iter(summary.action_shares.items()), ("", 0.0))
            if share >= NEARLY_CONSTANT and summary.policy not in (action, "idle"):
                found.append(f"{summary.policy} takes {action} in {100 * share:.1f} % of its steps")
        return f"(Nearly) constant: {'; '.join(found)}." if found else ""

    def write(self, folder: Path, **extra: Any) -> None:
        """Writes ``summary.json`` (with every episode and the provenance) and ``summary.md``."""
        content = {
            "env_id": self.env_id,
            "first_seed": self.first_seed,
            **extra,
            "policies": [asdict(summary) for summary in self.summaries],
            "episodes": {name: [asdict(e) for e in found] for name, found in self.results.items()},
            "provenance": provenance(PACKAGES),
        }
        write_json(folder / "summary.json", finite(content))
        write_text(folder / "summary.md", self.markdown())

    def markdown(self) -> str:
        """Returns the table as Markdown."""
        header, cells = self._cells()
        paragraphs = [markdown.table(header, cells), f"{self.env_id}: {self._caption()}", self.constant_policies]
        return "\n\n".join(filter(None, paragraphs)) + "\n"

    def table(self) -> Table:
        """Returns the table for a terminal."""
        header, lines = self._cells()
        table = Table(title=self.env_id, caption=self._caption())
        for i, name in enumerate(header):
            table.add_column(escape(name), justify="right" if i else "left")
        for line in lines:
            table.add_row(*line)
        return table

    def _cells(self) -> tuple[list[str], list[list[str]]]:
        """Returns the header and the cells of each line; without an ego there are no columns of crashes and speed."""
        summaries = self.summaries
        roles = list(dict.fromkeys(role for summary in summaries for role in summary.role_returns))
        header = ["policy", "return", *(f"return of {role}" for role in roles), "length"]
        header += ["crash rate (95 %)", "speed [m/s]"] if self.has_ego else []
        return header, [_cells_of(summary, roles, self.has_ego) for summary in summaries]

    def _caption(self) -> str:
        count = max(len(found) for found in self.results.values())
        caption = (
            f"{count} episodes each, the same seeds from {self.first_seed} on; mean ± standard error, length in policy "
            "steps"
        )
        if not self.has_ego:
            return f"{caption}; return: mean over the learners."
        if all(summary.crash_rate is None for summary in self.summaries):
            return f"{caption}; the environment reports no crashes."
        return f"{caption}, crash rate with its 95 % Wilson interval."


def _cells_of(summary: PolicySummary, roles: Sequence[str], has_ego: bool) -> list[str]:
    cells = [summary.policy, f"{summary.return_mean:.2f}{_plus_minus(summary.return_se, 2)}"]
    for role in roles:
        mean, error = summary.role_returns.get(role, (math.nan, math.nan))
        cells.append(f"{mean:.2f}{_plus_minus(error, 2)}")
    cells.append(f"{summary.length_mean:.1f}{_plus_minus(summary.length_se, 1)}")
    if has_ego:
        cells.append(_crashes(summary))
        cells.append("–" if math.isnan(summary.mean_speed_mps) else f"{summary.mean_speed_mps:.1f}")
    return cells


def _crashes(summary: PolicySummary) -> str:
    if summary.crash_rate is None or summary.crash_low is None or summary.crash_high is None:
        return "–"
    return f"{100 * summary.crash_rate:.0f} % ({100 * summary.crash_low:.0f}–{100 * summary.crash_high:.0f} %)"


def _plus_minus(error: float, digits: int) -> str:
    return "" if math.isnan(error) else f" ± {error:.{digits}f}"
