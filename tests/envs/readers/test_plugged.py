"""Readers that installed packages register by entry points: imported for their own environments alone."""

import sys
from pathlib import Path
from typing import Any

import pytest

from envs.readers import GROUP, reader_for
from envs.wrappers import SceneObservation
from predictor.support.errors import UserError
from tests.envs.semantics import Crowd
from tests.predictor.test_own_forecasters import install

READER = """
from envs.readers import FunctionReader, register_reader
from tests.envs.semantics import read_crowd
from tests.envs.testing.test_check_reader import SPEC
reader = FunctionReader(read_crowd, SPEC)
"""


def crowd_of(module: str) -> Any:
    """Makes a class of crowds, as if another package had it."""
    return type("Plaza", (Crowd,), {"__module__": module})


@pytest.mark.parametrize("name", ["plaza", "plaza.envs", "plaza.envs.Plaza"])
@pytest.mark.parametrize("value", ["thirdparty_reader:reader", "thirdparty_reader"])
def test_it_is_found_by_class_module_or_package(name: str, value: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    kind = crowd_of("plaza.envs")
    monkeypatch.setitem(sys.modules, "kept_plaza", kind)  # where the module below finds the class
    register = "import sys\nregister_reader(sys.modules['kept_plaza'], reader)\n" if ":" not in value else ""
    install(tmp_path, GROUP, f"{name} = {value}")
    (tmp_path / "thirdparty_reader.py").write_text(READER + register)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "thirdparty_reader", raising=False)
    with pytest.raises(UserError, match="no scene reader knows Plaza"):
        reader_for(crowd_of("plazas.envs")())
    assert "thirdparty_reader" not in sys.modules
    assert SceneObservation(kind()).reset(seed=0)[0]["scene_valid"].sum() == 5
    assert "thirdparty_reader" in sys.modules
    monkeypatch.delitem(sys.modules, "thirdparty_reader")


def test_one_that_cannot_be_imported_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    install(tmp_path, GROUP, "market = thirdparty_absent:reader")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(UserError, match=r"reader for Plaza cannot be imported from thirdparty_absent:reader"):
        reader_for(crowd_of("market")())
