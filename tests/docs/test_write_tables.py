"""The tables of README.md, docs/ and the cards are what the checkpoints' records say."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from docs import write_tables
from predictor.evaluation.in_env_record import read_record
from predictor.reports.in_env_tables import MARKED
from predictor.support.errors import UserError

ROOT = Path(__file__).resolve().parents[2]
RECORDS = {
    path.parent.name: read_record(path.parent) for path in (ROOT / write_tables.PRETRAINED).glob("*/in_env.json")
}


@pytest.fixture
def copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository with the pages and the records alone."""
    for path in write_tables.pages(ROOT):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / path, tmp_path / path)
    for name in RECORDS:
        record = write_tables.PRETRAINED / name / "in_env.json"
        shutil.copyfile(ROOT / record, tmp_path / record)
    monkeypatch.setattr(write_tables, "ROOT", tmp_path)
    return tmp_path


def run(monkeypatch: pytest.MonkeyPatch, *words: str) -> None:
    monkeypatch.setattr("sys.argv", ["write_tables.py", *words])
    write_tables.main()


def test_every_page_says_what_the_records_say():
    differing = [str(path) for path, (old, new) in write_tables.pages(ROOT).items() if old != new]
    assert differing == [], "run python -m docs.write_tables"


def test_every_page_has_its_tables():
    named = {
        path.name: [name for _, name, _ in MARKED.findall((ROOT / path).read_text())] for path in write_tables.PAGES
    }
    assert named == {
        "README.md": ["first"],
        "checkpoints.md": ["checkpoints", "forecasts"],
        "in_env.md": ["forecasts-long", "samples", "transfer"],
    }
    cards = list((ROOT / write_tables.PRETRAINED).glob("*/README.md"))
    assert len(cards) == len(RECORDS) == len(set(write_tables.SERVED_BY.values()))
    assert all([name for _, name, _ in MARKED.findall(card.read_text())] == ["accuracy"] for card in cards)


def test_a_number_changed_by_hand_is_found_and_put_right(
    copy: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    page = copy / "README.md"
    before = page.read_text()
    page.write_text(before.replace("| merge-v1 | varied | 50 |", "| merge-v1 | idle | 50 |"))
    assert page.read_text() != before
    with pytest.raises(UserError, match=r"README.md differ from the records; run python -m docs\.write_tables"):
        run(monkeypatch, "--check")
    run(monkeypatch)
    assert page.read_text() == before and "1 pages rewritten" in capsys.readouterr().out
    run(monkeypatch, "--check")
    with pytest.raises(UserError, match="takes --check or nothing"):
        run(monkeypatch, "--fix")


def test_a_missing_line_of_the_transfer_matrix_is_named():
    env_id = next(m.env_id for m in RECORDS["highway"] if m.samples == 1)
    lacking = RECORDS | {"highway": [m for m in RECORDS["highway"] if (m.env_id, m.samples) != (env_id, 1)]}
    with pytest.raises(UserError, match=f"transfer to {env_id}: no measurement with K = 1 in the records of highway;"):
        write_tables.tables(lacking)


def test_two_drivers_cannot_stand_in_one_line_of_the_transfer_matrix():
    first = next(m for m in RECORDS["highway"] if m.samples == 1)
    with pytest.raises(UserError, match="two measurements with K = 1 in one environment"):
        write_tables.tables(RECORDS | {"highway": [*RECORDS["highway"], replace(first, driver="idle")]})


def test_every_id_with_a_checkpoint_has_a_line():
    measured = {
        m.env_id for name, found in RECORDS.items() for m in found if write_tables.SERVED_BY.get(m.env_id) == name
    }
    assert measured == set(write_tables.SERVED_BY)


def test_lines_of_a_table_have_the_same_k_and_a_driver_each():
    """One driver per id: an `idle` run cannot stand in a line that says `varied`."""
    for name, found in RECORDS.items():
        own = [m for m in found if m.samples == write_tables.SAMPLES]
        assert len({m.env_id for m in own}) == len(own), name
        for m in own:
            named = [word for word in ("idle", "random") if f"--ego {word}" in m.command]
            assert m.driver in ("varied", "heuristic", "keep-lane") and not named, (name, m.env_id)


def test_what_a_line_says_fits_together():
    for name, found in RECORDS.items():
        for m in found:
            if m.min_ade_m is None or m.constant_velocity_ade_m is None:
                continue
            assert m.below_cv == pytest.approx(1 - m.min_ade_m / m.constant_velocity_ade_m, abs=0.012), (name, m.env_id)
            for value, interval in ((m.min_ade_m, m.min_ade_interval_m), (m.below_cv, m.below_cv_interval)):
                assert interval is None or interval[0] <= value <= interval[1], (name, m.env_id)
            assert m.best_of_k_m is None or m.best_of_k_m <= m.min_ade_m, (name, m.env_id)
            assert m.min_fde_m is None or m.min_fde_m > m.min_ade_m, (name, m.env_id)
