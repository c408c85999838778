"""The check of installations: what it tries, and that it fails where one is wrong. Nothing is installed here."""

import importlib.util
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
SPEC = importlib.util.spec_from_file_location("install_check", ROOT / ".ci" / "install_check.py")
assert SPEC is not None and SPEC.loader is not None
install_check: Any = importlib.util.module_from_spec(SPEC)
sys.modules["install_check"] = install_check
SPEC.loader.exec_module(install_check)
OF_A_CHECKOUT = {"docs", "fuzz"}
"""Serve a checkout, not a wheel: the site, the fuzzer."""
EVERYTHING, TOOLS, EMPTY = "all", "dev", "training"


@pytest.fixture
def this_python(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Replaces fresh environments by this interpreter, without installing; returns a folder to work in."""

    def create(folder: Path, with_pip: bool) -> None:
        assert with_pip
        (folder / "bin").mkdir(parents=True)
        (folder / "bin" / "python").symlink_to(sys.executable)

    really = install_check.run
    monkeypatch.setattr(install_check.venv, "create", create)
    monkeypatch.setattr(
        install_check, "run", lambda command, folder: None if "pip" in command else really(command, folder)
    )
    return tmp_path


def test_the_repository_cannot_be_imported_through_the_callers_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "hidden.py").write_text("")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    (tmp_path / "empty").mkdir()
    with pytest.raises(RuntimeError, match="No module named 'hidden'"):
        install_check.run([sys.executable, "-c", "import hidden"], tmp_path / "empty")


def test_every_extra_is_tried():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert (
        set(install_check.EXTRAS)
        == {"core", *project["optional-dependencies"]} - {EVERYTHING, TOOLS, EMPTY} - OF_A_CHECKOUT
    )
    assert project["optional-dependencies"][EMPTY] == []
    assert all(extra.commands for extra in install_check.EXTRAS.values())


def test_a_command_that_fails_is_named_with_the_end_of_its_output(this_python: Path, monkeypatch: pytest.MonkeyPatch):
    broken = install_check.Extra(("json.tool --help", "no_such_module --option 1"))
    monkeypatch.setitem(install_check.EXTRAS, "core", broken)
    with pytest.raises(
        RuntimeError, match="-m no_such_module --option 1\n.*status 1:\n.*No module named no_such_module"
    ):
        install_check.try_extra("core", Path("some.whl"), this_python)


def test_python_code_runs_in_an_empty_folder(this_python: Path, monkeypatch: pytest.MonkeyPatch):
    code = "\nimport os\nassert os.listdir() == [], os.listdir()\nopen('made', 'w').close()\n"
    monkeypatch.setitem(install_check.EXTRAS, "core", install_check.Extra((code,)))
    install_check.try_extra("core", Path("some.whl"), this_python)
    assert (this_python / "work" / "made").exists()


def test_an_extra_that_installs_too_much_fails(this_python: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(install_check.EXTRAS, "core", install_check.Extra((), absent=("no_such_module", "json")))
    with pytest.raises(RuntimeError, match="'core' installs json, which it must not"):
        install_check.try_extra("core", Path("some.whl"), this_python)


def test_the_wheel_is_built_from_a_clean_copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Files that an earlier build left in build/ must not get into the wheel."""

    def build(command: list[Any], folder: Path) -> None:
        source = Path(command[-1])
        assert source != ROOT and not (source / "build").exists()
        assert (source / "predictor" / "pretrained").is_dir() and (source / "pyproject.toml").is_file()
        (folder / "made.whl").touch()

    monkeypatch.setattr(install_check, "run", build)
    assert install_check.build_wheel(tmp_path) == tmp_path / "made.whl"
