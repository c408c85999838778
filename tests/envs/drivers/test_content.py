from pathlib import Path

import pytest

from envs.drivers.content import content_of
from predictor.own_forecasters import GROUP
from predictor.support.errors import UserError
from tests.envs.helpers import HIGHWAY_SPEC, save_tiny
from tests.predictor.test_own_forecasters import install


@pytest.mark.parametrize(
    "name", ["random", "heuristic", "planner", "planner@0.3", "planner:oracle", "planner:constant-velocity"]
)
def test_a_driver_of_this_package_has_no_content(name: str):
    assert content_of(name) is None


def test_other_code_or_weights_under_one_name_are_another_driver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A retrained policy, an edited module, a checkpoint that was trained on."""
    monkeypatch.syspath_prepend(tmp_path)
    checkpoint = Path(save_tiny(tmp_path / "tiny", HIGHWAY_SPEC))
    files = {
        str(tmp_path / "policy.zip"): tmp_path / "policy.zip",
        "own:a_driver_of_mine:drive": tmp_path / "a_driver_of_mine.py",
        "planner:own:a_forecaster_of_mine:make": tmp_path / "a_forecaster_of_mine.py",
        f"planner:{checkpoint}": checkpoint / "model.safetensors",
        f"planner@0.3:{checkpoint}": checkpoint / "model.safetensors",
    }
    for name, file in files.items():
        if not file.exists():
            file.write_text("one")
        before = content_of(name)
        assert before is not None and len(before) == 64 and content_of(name) == before
        file.write_bytes(file.read_bytes() + b"#")
        assert content_of(name) not in (before, None)


def test_other_code_of_a_registered_forecaster_is_another_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    install(tmp_path, GROUP, "mean_of_mine = registered_of_mine:Model")
    (tmp_path / "registered_of_mine.py").write_text("one")
    monkeypatch.syspath_prepend(tmp_path)
    before = content_of("own:mean_of_mine")
    assert before is not None and content_of("planner:own:mean_of_mine") == before
    (tmp_path / "registered_of_mine.py").write_text("two")
    assert content_of("own:mean_of_mine") not in (before, None)
    with pytest.raises(UserError, match="no forecaster 'nobodys' is registered"):
        content_of("own:nobodys")
