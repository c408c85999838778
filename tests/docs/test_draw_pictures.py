import re
from pathlib import Path

import pytest
from matplotlib import pyplot as plt

from docs import draw_pictures
from tests.envs.helpers import run_command


def test_pictures_of_a_moment_are_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture):
    monkeypatch.setattr(draw_pictures, "DOCS", tmp_path)
    code, errors, _ = run_command(draw_pictures.main, ["--only", "braking_leader"], monkeypatch, capsys)
    assert (code, errors) == (0, [])
    assert [path.name for path in tmp_path.iterdir()] == ["braking_leader.png"]
    assert plt.imread(tmp_path / "braking_leader.png")[..., :3].std() > 0.03


def test_an_unknown_picture_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture):
    monkeypatch.setattr(draw_pictures, "DOCS", tmp_path)
    code, errors, _ = run_command(draw_pictures.main, ["--only", "film"], monkeypatch, capsys)
    assert (code, errors) == (
        2,
        [
            "error: only must be among highway, what_if, seen, braking_leader, causal_graph, calibration, "
            "fans_roundabout, fans_intersection, got film"
        ],
    )
    assert not list(tmp_path.iterdir())


def test_every_picture_is_shown_on_a_page():
    root = Path(draw_pictures.__file__).resolve().parents[1]
    pages = (root / "README.md").read_text() + "".join(path.read_text() for path in (root / "docs").glob("*.md"))
    for name in draw_pictures.PICTURES:
        assert f"{name}.png)" in pages and (root / "docs" / f"{name}.png").exists()


def test_coverage_without_modes_is_that_of_the_page():
    page = (Path(__file__).parents[2] / "docs" / "checkpoint_history.md").read_text()
    table = page.split("the checkpoints without modes had (K = 20):")[1].split("\n\n")[1]
    found = {}
    for line in table.splitlines()[2:]:
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        shares = [int(share) for share in re.findall(r"\d+", cells[-1])]
        found[cells[0]] = (shares[0], shares[-1])
    assert found == draw_pictures.BEFORE
