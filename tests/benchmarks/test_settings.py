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


def test_sections_run_in_their_order_and_the_reference_only_where_there_is_one():
    every = tuple(SECTIONS)
    assert Settings().sections == tuple(s for s in every if s != "reference")
    assert Settings(reference=Path()).sections == every
    assert Settings(only=("data", "machine")).sections == ("machine", "data")
    assert Settings(only=every, reference=Path()).sections == every


def test_absent_packages_are_named():
    assert missing("json", "torch") == ""
    assert missing("json", "no_such_package", "no_such.module") == "needs no_such_package, no_such.module"
