"""The command `dgvae`: its help, what it calls, and what it says of a command that is not there."""

import importlib
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

from dgvae_rl.command import COMMANDS, CommandLineError, main, run

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("words", [[], ["--help"], ["-h"], ["help"]])
def test_help_lists_every_command_on_one_screen(words: list[str], capsys: pytest.CaptureFixture[str]):
    run(words)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 24 and max(map(len, lines)) <= 80
    for name, command in COMMANDS.items():
        assert any(line.split() == [name, *command.does.split()] for line in lines)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_is_the_main_of_its_module(name: str, monkeypatch: pytest.MonkeyPatch):
    module = importlib.import_module(COMMANDS[name].module)
    called: list[list[str]] = []
    monkeypatch.setattr(module, "main", lambda: called.append(sys.argv))
    monkeypatch.setattr(sys, "argv", ["dgvae"])
    run([name, "--out", "here"])
    assert called == [[f"dgvae {name}", "--out", "here"]]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["trian-policy"], "dgvae has no command 'trian-policy'; did you mean train-policy?"),
        (["fly"], f"dgvae has no command 'fly'; there are {', '.join(COMMANDS)}"),
        (["--out"], f"dgvae has no command '--out'; there are {', '.join(COMMANDS)}"),
    ],
)
def test_an_unknown_command_is_one_sentence(
    words: list[str], sentence: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(sys, "argv", ["dgvae", *words])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 2
    assert capsys.readouterr().err == f"error: {sentence}\n"


def test_a_missing_package_names_the_extra(monkeypatch: pytest.MonkeyPatch):
    found = importlib.import_module

    def absent(name: str) -> ModuleType:
        if name.endswith(".errors"):
            return found(name)
        raise ModuleNotFoundError("No module named 'highway_env'", name="highway_env")

    monkeypatch.setattr("dgvae_rl.command.importlib.import_module", absent)
    monkeypatch.setattr(sys, "argv", ["dgvae"])
    with pytest.raises(CommandLineError, match=r"dgvae collect needs highway_env; install it with pip install 'dgvae-"):
        run(["collect"])


def test_every_extra_is_one_of_the_package():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert {extra for command in COMMANDS.values() for extra in command.extra.split(",")} <= {"", *extras}


@pytest.mark.slow
def test_it_finds_modules_of_the_working_folder_and_user_errors_are_one_line(tmp_path: Path):
    """As `python -m` does; and the working folder's `envs/` hides nothing."""
    (tmp_path / "envs").mkdir()
    (tmp_path / "envs" / "__init__.py").write_text("")
    (tmp_path / "mine.py").write_text("import envs, pathlib\npathlib.Path('imported').write_text(envs.__file__)\n")
    done = subprocess.run(
        [sys.executable, "-c", "from dgvae_rl.command import main; main()", "collect", "--env-id", "mine:Absent-v0"]
        + ["--out", "data"],
        cwd=tmp_path, env={"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert (tmp_path / "imported").read_text() == str(tmp_path / "envs" / "__init__.py")
    assert done.stderr.startswith("error: cannot make env 'mine:Absent-v0'") and done.returncode == 2


@pytest.mark.slow
def test_a_stranger_s_folder_imports_nothing_where_python_is_told_so(tmp_path: Path):
    (tmp_path / "mine.py").write_text("import pathlib\npathlib.Path('imported').write_text('')\n")
    done = subprocess.run(
        [sys.executable, "-c", "from dgvae_rl.command import main; main()", "collect", "--env-id", "mine:Absent-v0"]
        + ["--out", "data"],
        cwd=tmp_path, env={"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "PYTHONSAFEPATH": "1"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert not (tmp_path / "imported").exists()
    assert "No module named 'mine'" in done.stderr and done.returncode == 2
