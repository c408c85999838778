from pathlib import Path

import pytest

from envs.drivers.content import content_of
from tests.envs.helpers import HIGHWAY_SPEC, save_tiny


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
