"""Every benchmark is a command of the same form: `python -m benchmarks.NAME`."""

import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MODULES = {path.stem: path.read_text() for path in (ROOT / "benchmarks").glob("[!_]*.py")}
COMMANDS = sorted(name for name, text in MODULES.items() if "run_entry_point(main)" in text)


def test_there_are_commands():
    assert {"wrapper_overhead", "envpool_training", "gpu_springs"} <= set(COMMANDS)


@pytest.mark.parametrize("name", sorted(MODULES))
def test_every_benchmark_imports(name: str):
    importlib.import_module(f"benchmarks.{name}")


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself(name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture):
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    with pytest.raises(SystemExit) as ended:
        importlib.import_module(f"benchmarks.{name}").main()
    assert ended.value.code == 0
    assert "usage:" in (shown := capsys.readouterr().out) and len(shown.splitlines()) > 5


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_says_how_it_is_run(name: str):
    assert f"python -m benchmarks.{name}" in MODULES[name].split('"""')[1]


def test_no_text_runs_a_benchmark_as_a_file():
    """Run as a file, it would hide modules of the standard library and miss the packages of this project."""
    texts = [*(ROOT / "benchmarks").glob("*.py"), *(ROOT / "docs").rglob("*.md"), ROOT / "README.md", ROOT / "Makefile"]
    as_file = re.compile(r"python3?\s+benchmarks/\S+")
    assert [f"{path.name}: {hit}" for path in texts for hit in as_file.findall(path.read_text())] == []


@pytest.mark.slow
def test_a_command_runs_from_the_root():
    command = [sys.executable, "-W", "ignore", "-m", "benchmarks.gpu_springs", "--help"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "usage:" in done.stdout, done.stderr
