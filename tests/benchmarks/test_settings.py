from pathlib import Path

import pytest

from benchmarks.optional_packages import missing
from benchmarks.settings import SECTIONS, Settings
from predictor.errors import UserError


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (Settings(only=("forecast", "forcast")), "there is no section forcast; there are machine, forecast, "),
        (Settings(threads=0), "threads must be at least 1, got 0"),
        (Settings(only=("reference",)), "section reference needs --reference PATH"),
        (Settings(only=("data",), write_baseline=Path("b.json")), "a baseline holds every section; leave --only out"),
        (Settings(out=Path()), "is a folder; name a file"),
        (Settings(write_baseline=Path()), "is a folder; name a file"),
    ],
)
def test_bad_settings_are_one_clear_line(settings: Settings, message: str):
    with pytest.raises(UserError, match=message) as caught:
        settings.check()
    assert "\n" not in str(caught.value)


def test_sections_run_in_their_order_and_the_reference_only_where_there_is_one():
    every = tuple(SECTIONS)
    assert Settings().sections == tuple(s for s in every if s != "reference")
    assert Settings(reference=Path()).sections == every
    assert Settings(only=("data", "machine")).sections == ("machine", "data")
    Settings(only=every, reference=Path()).check()


def test_absent_packages_are_named():
    assert missing("json", "torch") == ""
    assert missing("json", "no_such_package", "no_such.module") == "needs no_such_package, no_such.module"
