from pathlib import Path
from typing import Any

import pytest

from benchmarks.optional_packages import missing
from benchmarks.settings import SECTIONS, Settings
from predictor.support.errors import UserError


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"only": ("forecast", "forcast")}, "there is no section forcast; there are machine, forecast, "),
        ({"threads": 0}, "threads must be at least 1, got 0"),
        ({"only": ("reference",)}, "section reference needs --reference PATH"),
        ({"only": ("data",), "write_baseline": Path("b.json")}, "a baseline holds every section; leave --only out"),
        ({"out": Path()}, "is a folder; name a file"),
        ({"write_baseline": Path()}, "is a folder; name a file"),
    ],
)
def test_bad_settings_are_one_clear_line(settings: dict[str, Any], message: str):
    with pytest.raises(UserError, match=message) as caught:
        Settings(**settings).check_files()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("nonsense-v0", "no checkpoint ships for env 'nonsense-v0'"),
        ("highway-mixed-v0", "EnvPool has no copy of 'highway-mixed-v0'"),
        ("racetrack-v1", "blocks are of discrete actions, racetrack-v1 has Box"),
    ],
)
def test_an_environment_that_cannot_be_timed_is_said_before_the_first_section(env_id: str, message: str):
    settings = Settings(only=("machine", "wrappers"), env_id=env_id)
    with pytest.raises(UserError, match=message):
        settings.check_env()
    Settings(only=("machine",), env_id=env_id).check_env()
    Settings().check_env()


def test_sections_run_in_their_order_and_the_reference_only_where_there_is_one():
    every = tuple(SECTIONS)
    assert Settings().sections == tuple(s for s in every if s != "reference")
    assert Settings(reference=Path()).sections == every
    assert Settings(only=("data", "machine")).sections == ("machine", "data")
    assert Settings(only=every, reference=Path()).sections == every


def test_absent_packages_are_named():
    assert missing("json", "torch") == ""
    assert missing("json", "no_such_package", "no_such.module") == "needs no_such_package, no_such.module"
