"""Results of studies that ship are whole, come with their study, and are those of the page on the verdict."""

import re
import tarfile
import tomllib
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.studies.results import Result, read_result

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "verdict.md").read_text()
VERDICT = " ".join(PAGE.split())
NAMES = {"none": "none: the", "forecast": "dg-vae", "constant-velocity": "constant velocity"}
"""Words of the first cell of an arm's row, where they are not its name."""
ARCHIVES = sorted((ROOT / "docs" / "studies").glob("*.tar.xz"))


def results_of(archive: Path, folder: Path) -> list[Result]:
    """Returns the results in an archive, each with its hash checked."""
    with tarfile.open(archive) as packed:
        safe: dict[str, Any] = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}  # Python 3.11.4 and later
        packed.extractall(folder, **safe)
    return [read_result(path) for path in sorted(folder.glob("cells/*/result.json"))]


def test_there_are_some():
    assert ARCHIVES


@pytest.mark.parametrize("archive", ARCHIVES, ids=lambda path: path.name.partition(".")[0])
def test_the_page_has_the_returns_of_all_runs(archive: Path, tmp_path: Path):
    results = results_of(archive, tmp_path)
    study = tomllib.loads((tmp_path / "study.toml").read_text())  # without it a folder is no study
    shipped = ROOT / "agents" / "studies" / archive.name.replace(".tar.xz", ".toml")
    if shipped.exists():
        assert study == tomllib.loads(shipped.read_text())
    means: dict[tuple[str, str, str | None], list[float]] = defaultdict(list)
    for each in sorted(results, key=lambda one: one.seed or 0):
        means[each.scenario, each.arm, each.algorithm].append(
            float(np.mean([episode["episode_return"] for episode in each.episodes]))
        )
        assert len(each.episodes) >= 200 and "/tmp" not in each.provenance["command"]
    assert means
    for (scenario, arm, algorithm), returns in means.items():
        assert scenario in study["scenarios"]
        if algorithm is not None:
            assert arm in [each if isinstance(each, str) else each["name"] for each in study["arms"]]
            printed = [", ".join(f"{value:.{digits}f}" for value in returns).replace("-", "−") for digits in (1, 2)]
            whole = "|".join(re.escape(text) for text in printed)  # a cell of a table, or in brackets
            assert re.search(rf"(\| |\()({whole})( \||\))", VERDICT), f"{scenario}, {arm}: {printed}"
            rows = [
                [cell.strip().replace("*", "") for cell in line.strip("|").split("|")] for line in PAGE.splitlines()
            ]
            rows = [row for row in rows if len(row) > 2 and row[1] in printed]
            mean = {f"{np.mean(returns):.{digits}f}".replace("-", "−") for digits in (1, 2)}
            for row in rows:  # arms that drive alike have equal rows
                assert row[2].split(" (")[0] in mean, f"{scenario}, {arm}: {row[2]}, not {mean}"
            assert not rows or any(NAMES.get(arm, arm) in row[0].lower() for row in rows), f"{scenario}, {arm}: {rows}"
