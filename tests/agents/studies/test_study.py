"""The command: whole studies of a toy, in processes, stopped in several ways."""

import fcntl
import json
import multiprocessing
import os
import re
import signal
import sys
import time
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow.parquet as parquet
import pytest

import agents.study
from agents.studies.plan import Scenario, read_study
from agents.studies.pool import run_cells
from agents.studies.results import write_result
from agents.study import StudyConfig, _has_settings_of, run_study
from predictor.support.errors import UserError, run_entry_point
from predictor.support.jobs import SERVED
from tests.agents.studies import helpers as studies
from tests.agents.studies.helpers import DEADLY_TOY, SLOW_TOY, TOY, study_path, study_text

LEFT_OUT = re.compile(r"(## Time\n|<h2>Time</h2>).*", re.DOTALL)
"""What differs between two runs of one study."""


STOPPED = "stopped: the same command goes on: finished cells are kept, others continue\n"
PATIENCE_S = 600.0
"""Longest time that is waited for something on a busy machine [s]."""


def config(folder: Path, text: str, workers: int = 2) -> StudyConfig:
    return StudyConfig(str(study_path(folder, text)), folder / "out", workers)


def start(folder: Path, text: str) -> Any:
    """Starts the command in a process that is forked from the pool's server, which has imported everything."""
    words = ["--study", str(study_path(folder, text)), "--out", str(folder / "out"), "--workers", "2"]
    context: Any = multiprocessing.get_context(SERVED)
    process = context.Process(target=run_command, args=(words, folder / "errors"))
    process.start()
    return process


def run_command(words: list[str], errors: Path) -> None:
    """Runs the command in its process, with what it says of errors in a file."""
    sys.argv = ["study.py", *words]
    with errors.open("a") as file:
        os.dup2(file.fileno(), 2)
        sys.stderr = file
        run_entry_point(agents.study.main)


def results(folder: Path) -> dict[str, str]:
    return {path.parent.name: path.read_text() for path in (folder / "out").glob("cells/*/result.json")}


def reports(folder: Path) -> list[str]:
    return [LEFT_OUT.sub("", (folder / "out" / name).read_text()) for name in ("report.md", "report.html")]


def ended_cells(folder: Path) -> Counter[str]:
    """Returns how often the log says that a cell ended."""
    log = (folder / "out" / "study.log").read_text()
    return Counter(re.findall(r"\] (corridor, .*?): return", log))


def wait_for(folder: Path, pattern: str, process: Any) -> None:
    until = time.monotonic() + PATIENCE_S
    while not list((folder / "out").glob(pattern)):
        assert process.is_alive() and time.monotonic() < until, (folder / "errors").read_text()
        time.sleep(0.02)


def running_cells(folder: Path) -> list[str]:
    """Returns the cells whose lock a process holds."""
    found = []
    for path in (folder / "out").glob("cells/*/.lock"):
        with path.open("a") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                found.append(path.parent.name)
    return found


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a study of the slow toy that nothing interrupted."""
    folder = tmp_path_factory.mktemp("whole")
    assert run_study(config(folder, study_text(SLOW_TOY))) == 0
    return folder


@pytest.mark.slow
def test_a_study_has_tables_a_report_and_a_log(whole: Path):
    assert len(results(whole)) == 5 and set(ended_cells(whole).values()) == {1}
    episodes = parquet.read_table(whole / "out" / "episodes.parquet").to_pylist()
    assert len(episodes) == 5 * 4 and max(e["length"] for e in episodes) == 6
    assert {e["episode_seed"] for e in episodes} == {2_000_000_000 + i for i in range(4)}
    curves = parquet.read_table(whole / "out" / "curves.parquet").to_pylist()
    assert [c["steps"] for c in curves if c["seed"] == 1] == [128, 256, 384, 512]
    assert "| none | 2 |" in (whole / "out" / "report.md").read_text()
    assert "5 cells, 0 of them finished before" in (whole / "out" / "study.log").read_text()


@pytest.mark.slow
def test_finished_cells_are_not_run_again(whole: Path, monkeypatch: pytest.MonkeyPatch):
    before, report = results(whole), reports(whole)
    monkeypatch.setattr("predictor.support.jobs._started", lambda *_: pytest.fail("nothing is missing"))
    assert run_study(config(whole, study_text(SLOW_TOY))) == 0
    assert results(whole) == before and reports(whole) == report


@pytest.mark.slow
def test_a_study_that_was_stopped_and_killed_ends_as_one_that_was_not(whole: Path, tmp_path: Path):
    """Stopped while policies train, then killed; nothing is lost or doubled, no process stays, the report is equal."""
    text, kept = study_text(SLOW_TOY), dict[str, str]()
    stages = {
        "cells/corridor.none*/run/checkpoint.zip": signal.SIGTERM,
        "cells/corridor.none*/result.json": signal.SIGKILL,
    }
    for pattern, number in stages.items():
        process = start(tmp_path, text)
        try:
            wait_for(tmp_path, pattern, process)
            os.kill(process.pid, number)
            process.join(PATIENCE_S)
            assert process.exitcode == (128 + number if number == signal.SIGTERM else -number)
        finally:
            process.kill()
        until = time.monotonic() + (PATIENCE_S if number == signal.SIGKILL else 0)
        while running_cells(tmp_path) and time.monotonic() < until:
            time.sleep(0.05)
        assert running_cells(tmp_path) == []
        now = results(tmp_path)
        assert kept.items() <= now.items(), "a finished cell stays as it is"
        kept = now
    assert (tmp_path / "errors").read_text() == STOPPED
    assert 3 < len(kept) <= 5
    assert run_study(config(tmp_path, text)) == 0
    assert kept.items() <= results(tmp_path).items()
    assert results(tmp_path).keys() == results(whole).keys()
    assert set(ended_cells(tmp_path).values()) <= {1}
    assert reports(tmp_path) == reports(whole)
    assert (tmp_path / "out" / "episodes.parquet").read_bytes() == (whole / "out" / "episodes.parquet").read_bytes()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_in_one_line(
    number: signal.Signals, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    before = signal.getsignal(number)
    monkeypatch.setattr(sys, "argv", ["study.py"])
    monkeypatch.setattr("agents.study.run_study", lambda _: os.kill(os.getpid(), number))
    with pytest.raises(SystemExit) as stop:
        run_entry_point(agents.study.main)
    assert stop.value.code == 128 + number and capsys.readouterr().err == STOPPED
    assert signal.getsignal(number) is before


@pytest.mark.slow
def test_two_studies_in_one_folder_are_refused(whole: Path):
    with (whole / "out" / ".lock").open("w") as lock:
        lock.write("123")
        lock.flush()
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(UserError, match=r"another study runs in .*out \(process 123\); wait for its end or choose"):
            run_study(config(whole, study_text(SLOW_TOY)))
    assert run_study(config(whole, study_text(SLOW_TOY))) == 0, "the lock ends with the process that holds it"


@pytest.mark.slow
def test_a_damaged_result_stops_the_study_and_keeps_the_rest(whole: Path):
    before = results(whole)
    name = next(name for name in before if "random" in name)
    file = whole / "out" / "cells" / name / "result.json"
    file.write_text(before[name][:50])
    with pytest.raises(UserError, match=f"{name}/result.json is damaged .* delete this file"):
        run_study(config(whole, study_text(SLOW_TOY)))
    file.unlink()
    assert run_study(config(whole, study_text(SLOW_TOY))) == 0
    after = results(whole)
    assert {k: v for k, v in after.items() if k != name} == {k: v for k, v in before.items() if k != name}
    assert json.loads(after[name])["episodes"] == json.loads(before[name])["episodes"]


@pytest.mark.slow
def test_a_cell_that_fails_does_not_stop_the_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    text = study_text(steps="64", selections="1")
    run = config(tmp_path, text)
    cells = agents.study.cells_of(agents.study.read_study(Path(run.study)), "corridor.toml")
    broken = tmp_path / "out" / "cells" / cells[3].name / "run"
    broken.mkdir(parents=True)
    (broken / "config.json").write_text("{")
    (tmp_path / "out" / "study.toml").write_text(text)
    assert run_study(run) == 1
    out = capsys.readouterr()
    assert f"failed: corridor, none, ppo, seed 0: error: {broken}/config.json is damaged (line 1" in out.err
    assert f"its log is {broken.parent}/log.txt" in out.err
    assert len(results(tmp_path)) == 4
    report = (tmp_path / "out" / "report.md").read_text()
    assert "Without a result: corridor, none, ppo, seed 0." in report and "| none | 1 |" in report


@pytest.mark.slow
def test_a_cell_that_is_killed_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    run = config(tmp_path, study_text(DEADLY_TOY, references="[]", seeds="1"))
    assert run_study(run) == 1
    err = capsys.readouterr().err
    assert "failed: corridor, none, ppo, seed 0: its process was killed by SIGKILL (by the system, if memory ran" in err
    assert re.search("its log is .*log.txt\n$", err)


@pytest.mark.slow
def test_a_result_tells_of_the_start_of_the_study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Cells start one after another, perhaps hours later: another commit may be checked out, the file edited."""
    run = config(tmp_path, text := study_text(steps="64", selections="1", seeds="1"))

    def edited_meanwhile(*arguments: Any) -> None:
        Path(run.study).write_text(study_text(steps="65"))
        run_cells(*arguments)

    monkeypatch.setattr("agents.study.commit_at_start", lambda: "as-at-the-start")
    monkeypatch.setattr("agents.study.run_cells", edited_meanwhile)
    assert run_study(run) == 0
    assert {json.loads(found)["provenance"]["commit"] for found in results(tmp_path).values()} == {"as-at-the-start"}
    assert (tmp_path / "out" / "study.toml").read_text() == text
    assert (tmp_path / "out" / "report.md").read_text().endswith(f"{text}```\n")


@pytest.mark.slow
@pytest.mark.parametrize("curve", [None, [{"steps": 64, "return": 1.0}]])
def test_a_run_whose_curve_was_removed_or_cut_still_has_a_result(curve: list[dict[str, float]] | None, tmp_path: Path):
    """A message says to remove it where it is damaged."""
    run = config(tmp_path, study_text(steps="64", selections="1", seeds="1", references="[]"))
    assert run_study(run) == 0
    (cell,) = (tmp_path / "out" / "cells").iterdir()
    before = json.loads((cell / "result.json").read_text())
    (cell / "result.json").unlink()
    (cell / "run" / "curve.json").unlink()
    if curve is not None:
        (cell / "run" / "curve.json").write_text(json.dumps(curve))
    (cell / ".result.json.0123456789abcdef.partial.json").write_text("{")  # what a kill left
    assert run_study(run) == 0
    after = json.loads((cell / "result.json").read_text())
    assert after["episodes"] == before["episodes"] and after["curve"] == (curve or []) and after["train_seconds"] == 0
    assert not list(cell.glob(".*partial*"))


@pytest.mark.slow
def test_a_part_of_a_study_is_run_and_the_rest_later(tmp_path: Path):
    """Cells of a part are those of the whole, and a report of a part says so."""
    text = study_text(steps="64", selections="1") + f'[scenarios.longer]\nenv_id = "{TOY}"\n'
    part = replace(config(tmp_path, text), scenarios=("longer",), seeds=1)
    report = tmp_path / "out" / "report.md"
    assert run_study(part) == 0
    first = results(tmp_path)
    assert sorted(name.split(".")[0] for name in first) == ["longer"] * 4
    assert len([name for name in first if ".none." in name]) == 1
    assert "Not run yet: 6 cells of the study." in report.read_text() and "## corridor" not in report.read_text()
    assert run_study(replace(part, scenarios=("corridor",))) == 0
    assert "Not run yet: 2 cells" in report.read_text()
    assert "## longer" in report.read_text() and "## corridor" in report.read_text()
    assert run_study(config(tmp_path, text)) == 0
    assert "Not run yet" not in report.read_text()
    assert len(results(tmp_path)) == 10 and first.items() <= results(tmp_path).items()
    began = re.findall("10 cells, (.*);", (tmp_path / "out" / "study.log").read_text())
    assert began == [f"{done} of them finished before, {left} to run" for done, left in ((0, 4), (4, 4), (8, 2))]
    with pytest.raises(UserError, match="study corridor has no scenario 'wide'; it has corridor, longer"):
        run_study(replace(part, scenarios=("longer", "wide")))
    with pytest.raises(UserError, match="has 2 training seeds, got --seeds 3; change seeds in a copy of its file"):
        run_study(replace(part, seeds=3))


def test_the_file_of_another_study_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(agents.study, "_run_missing", lambda *given: [])
    monkeypatch.setattr(agents.study, "_write", lambda *given: None)
    first, second = study_text(steps="64"), study_text(steps="65")
    out = tmp_path / "out"
    for _ in range(2):
        assert run_study(config(tmp_path, first)) == 0
        assert not (out / "study.before.toml").exists() and "kept as" not in capsys.readouterr().err
    assert run_study(config(tmp_path, second)) == 0
    assert [(out / name).read_text() for name in ("study.before.toml", "study.toml")] == [first, second]
    assert f"{out}/study.toml was of another study or an earlier version; kept as study.before.toml" in (
        capsys.readouterr().err
    )


def test_a_file_of_another_study_that_is_no_text_is_kept_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(agents.study, "_run_missing", lambda *given: [])
    monkeypatch.setattr(agents.study, "_write", lambda *given: None)
    out = tmp_path / "out"
    out.mkdir()
    (out / "study.toml").write_bytes(b'title = "\xff"\n')
    assert run_study(config(tmp_path, study_text())) == 0
    assert (out / "study.before.toml").read_bytes() == b'title = "\xff"\n'
    assert (out / "study.toml").read_text() == study_text()


@pytest.mark.parametrize("alike", [True, False])
def test_it_says_where_all_training_episodes_begin_alike(
    alike: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    pytest.importorskip("envpool")
    monkeypatch.setattr(agents.study, "begins_alike", lambda task: alike and task == "Merge-v0")
    monkeypatch.setattr(agents.study, "_run_missing", lambda *_: [])
    text = study_text(arms='["none"]').replace(f'env_id = "{TOY}"', 'env_id = "merge-v1"\nbackend = "envpool"')
    run_study(config(tmp_path, text))
    said = "note: EnvPool's Merge-v0 begins every training episode in the same state; the original does not"
    assert (said in capsys.readouterr().out) == alike


def test_a_folder_with_something_else_is_refused(tmp_path: Path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("mine")
    with pytest.raises(UserError, match=r"out holds thesis.tex but no study \(study.toml\); choose another --out"):
        run_study(config(tmp_path, study_text()))
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["thesis.tex"]


def test_the_report_alone_takes_results_of_earlier_versions_and_runs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    run = replace(config(tmp_path, study_text(seeds="3", env_id="nowhere:Gone-v0")), report=True)
    result = partial(studies.result, env_id="nowhere:Gone-v0")
    monkeypatch.setattr("agents.study.run_cells", lambda *_: pytest.fail("nothing is run"))
    with pytest.raises(UserError, match=r"out holds no result of this study \(cells/NAME/result.json\); run it"):
        run_study(run)
    made = [
        result("none", [2.0, 2.0], seed=1, scenario="corridor", provenance={"commit": "new", "time": "2026-02"}),
        result("none", [9.0, 9.0], seed=1, scenario="corridor", provenance={"commit": "old", "time": "2026-01"}),
        result("none", [4.0, 4.0], seed=0, scenario="corridor", provenance={"commit": "old", "time": "2026-01"}),
        result("none", [70.0], seed=3, scenario="corridor"),
        result("zeros", [80.0], seed=0, scenario="corridor"),
        result("none", [90.0], seed=0, scenario="elsewhere"),
        result("random", [1.0, 1.0], scenario="corridor", provenance={"commit": "old", "time": "2026-01"}),
        result("keep-lane", [-60.0], scenario="corridor"),  # no reference of the file any more
        result("none", [50.0], seed=2, scenario="corridor", env_id="merge-v1"),
    ]
    for i, each in enumerate(made):
        folder = tmp_path / "out" / "cells" / f"of-another-version-{i}"
        folder.mkdir(parents=True)
        write_result(folder / "result.json", each)
    (tmp_path / "out" / "study.toml").write_text("")
    assert run_study(run) == 0
    episodes = parquet.read_table(tmp_path / "out" / "episodes.parquet").to_pylist()
    assert [(e["arm"], e["seed"], e["return"]) for e in episodes] == [
        ("random", None, 1.0), ("random", None, 1.0), ("none", 0, 4.0), ("none", 0, 4.0), ("none", 1, 2.0),
        ("none", 1, 2.0),
    ]  # fmt: skip
    report = (tmp_path / "out" / "report.md").read_text()
    assert "Not run yet: 1 training of the study" in report and "Commits of the results: 2 of old, 1 of new." in report
    assert "study.before.toml" in capsys.readouterr().err


def test_the_report_alone_says_what_to_do_with_a_damaged_result(tmp_path: Path):
    cells = tmp_path / "out" / "cells"
    for name in ("one", "two"):
        (cells / name).mkdir(parents=True)
        write_result(cells / name / "result.json", studies.result("none", [1.0], seed=0, scenario="corridor"))
    (cells / "two" / "result.json").write_text('{"arm":')
    (tmp_path / "out" / "study.toml").write_text("")
    said = r"two/result.json is damaged \(line 1: no JSON \([^()]*\)\); move it away for a report of the others; the"
    with pytest.raises(UserError, match=said):
        run_study(replace(config(tmp_path, study_text()), report=True))


def test_references_are_in_the_order_of_the_file():
    found = Scenario("one", "merge-v1", {}, 1, 1, ("random", "constant-actions", "planner", "idle"))
    measured = ["slower", "planner", "planner:constant-velocity", "idle", "faster", "keep-lane", "random"]
    assert found.references_among(measured) == ["random", "faster", "idle", "slower", "planner"]


def test_the_report_alone_leaves_out_results_of_other_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """Of other steps, another environment or other episodes; they stood beside those of the file as if equal."""
    text = study_text(seeds="2", env_id="merge-v1")
    run = replace(config(tmp_path, text), report=True)
    before = read_study(study_path(tmp_path, text.replace("steps = 512", "steps = 1024")))
    study = read_study(study_path(tmp_path, text))
    monkeypatch.setattr("agents.study.run_cells", lambda *_: pytest.fail("nothing is run"))
    ours, theirs = (of.settings_of(of.scenarios[0], of.arms[0], "ppo") for of in (study, before))
    result = partial(studies.result, env_id="merge-v1", scenario="corridor")
    made = [
        result("none", [2.0], seed=0, settings=ours, provenance={"time": "2026-01"}),
        result("none", [9.0], seed=0, settings=theirs, provenance={"time": "2026-02"}),
        result("none", [9.0], seed=1, settings=theirs),
        result("random", [1.0], settings=study.settings_of(study.scenarios[0])),
        result("gone", [5.0], seed=0, settings=theirs),
    ]
    for i, each in enumerate(made):
        (tmp_path / "out" / "cells" / str(i)).mkdir(parents=True)
        write_result(tmp_path / "out" / "cells" / str(i) / "result.json", each)
    (tmp_path / "out" / "study.toml").write_text(text)
    assert run_study(run) == 0
    episodes = parquet.read_table(tmp_path / "out" / "episodes.parquet").to_pylist()
    assert [(e["arm"], e["seed"], e["return"]) for e in episodes] == [("random", None, 1.0), ("none", 0, 2.0)]
    assert "left out: 2 results of other settings than corridor's file has now" in capsys.readouterr().err
    assert "Not run yet: 1 training of" in (tmp_path / "out" / "report.md").read_text()


@pytest.mark.parametrize(
    ("more", "same"),
    [
        ('device = "auto"', True),
        ('backend = "gymnasium"', True),
        ("num_samples = 1", True),
        ("num_samples = 2", False),
        ('[[arms]]\nname = "zeros"\nobserve = "zeros"\nnum_samples = 1', True),
        ('[[arms]]\nname = "zeros"\nobserve = "zeros"\nnum_samples = 2', False),
        ("[algorithms.ppo]\ngamma = 0.8", True),
        ("[algorithms.ppo]\ngamma = 0.7", False),
    ],
)
def test_a_default_that_is_written_down_changes_no_setting(tmp_path: Path, more: str, same: bool):
    text = '{}[scenarios.corridor]\nenv_id = "merge-v1"\n{}'
    arms = 'arms = ["zeros"]\n'
    before = read_study(study_path(tmp_path, text.format(arms, "")))
    table, option = (f"{more}\n", "") if more.startswith("[") else ("", f"{more}\n")
    now = read_study(study_path(tmp_path, text.format(table if "[[arms" in more else arms + table, option)))
    found = studies.result("zeros", [1.0], seed=0, env_id="merge-v1", scenario="corridor")
    found = replace(found, settings=before.settings_of(before.scenarios[0], before.arms[0], "ppo"))
    assert _has_settings_of(found, now) is same


@pytest.mark.parametrize("other", [{"scenarios": ("corridor",)}, {"seeds": 1}, {"cluster": "auto"}])
def test_the_report_alone_is_of_everything(other: dict[str, Any]):
    with pytest.raises(UserError, match="leave out --scenarios, --seeds and --cluster"):
        StudyConfig(report=True, **other)


@pytest.mark.slow
def test_headroom_runs_floor_and_ceiling_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    arms = '["none", {name = "all", observe = "none"}, {name = "other", observe = "none"}]'
    text = study_text(arms=arms, floor='"none"', ceiling='"all"', steps="64", selections="1")
    run = StudyConfig(str(study_path(tmp_path, text)), tmp_path / "out", 2, headroom=True)
    assert run_study(run) == 0
    lines = {re.split(r"[.]|-[0-9a-f]{10}$", name)[1] for name in results(tmp_path)}
    assert lines == {"none", "all", "action-0", "action-1"}
    printed = capsys.readouterr().out
    assert "| scenario | best constant action | planner | planner:oracle | none | all | headroom |" in printed
    assert (tmp_path / "out" / "headroom.md").exists() and not (tmp_path / "out" / "report.md").exists()


def test_without_pyarrow_nothing_begins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"need pyarrow; pip install 'dgvae-rl\[study\]'"):
        run_study(config(tmp_path, study_text()))
    assert not (tmp_path / "out").exists()
