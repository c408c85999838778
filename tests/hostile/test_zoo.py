"""Every bad input of the zoo ends in one line that says what was wrong; nothing waits, runs code or is accepted."""

import dataclasses
import shutil
import signal
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from predictor.support.errors import MOST_LETTERS, UserError, one_line
from tests.hostile.samples import KINDS
from tests.hostile.zoo import ACCEPTED, CASES, EXECUTED, Case

MOST_S = 20
"""Time after which an input counts as a hang [s]."""


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A good sample of each kind."""
    folders = {kind: tmp_path_factory.mktemp("good") / "sample" for kind in KINDS}
    for kind, folder in folders.items():
        folder.mkdir()
        KINDS[kind].make(folder)
    return folders


@pytest.fixture(autouse=True)
def ends_in_time() -> Iterator[None]:
    """Raises in the test if it waits, for example for a pipe."""

    def hangs(*_: Any) -> None:
        raise TimeoutError(f"not done after {MOST_S} s")

    before = signal.signal(signal.SIGALRM, hangs)
    signal.alarm(MOST_S)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("kind", KINDS)
def test_good_samples_load(kind: str, good: dict[str, Path], tmp_path: Path):
    shutil.copytree(good[kind], tmp_path / "sample")
    KINDS[kind].load(tmp_path / "sample")


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.title)
def test_bad_inputs_are_one_line(case: Case, good: dict[str, Path], tmp_path: Path):
    folder = tmp_path / "sample"
    shutil.copytree(good[case.kind], folder)
    case.spoil(folder)
    EXECUTED.unlink(missing_ok=True)
    with pytest.raises(UserError) as error:
        KINDS[case.kind].load(folder)
    line = one_line(error.value)
    file = Path(KINDS[case.kind].file)
    expected = case.expected.split("|") if case.expected else [file.name, f"sample/{file.parts[0]}"]  # or its store
    assert any(part in line for part in expected), line
    assert line.isprintable() and len(line) <= MOST_LETTERS
    assert not EXECUTED.exists(), "a hostile file ran code"


@pytest.mark.parametrize(("kind", "name"), ACCEPTED)
def test_what_is_no_damage_loads(kind: str, name: str, good: dict[str, Path], tmp_path: Path):
    shutil.copytree(good[kind], tmp_path / "sample")
    (tmp_path / "sample" / KINDS[kind].file).write_bytes(b"")
    assert name == "empty"
    KINDS[kind].load(tmp_path / "sample")


def test_the_zoo_is_large_and_has_no_case_twice():
    titles = [case.title for case in CASES]
    assert len(titles) > 700 and len(set(titles)) == len(titles)
    assert {case.kind for case in CASES} == set(KINDS)
    assert dataclasses.is_dataclass(Case)


def test_a_guard_that_is_gone_would_be_seen(good: dict[str, Path], tmp_path: Path):
    """What unpickles the policy of format 2 runs its code: the zoo's pickles are live."""
    import pickle

    from tests.hostile.zoo import Evil

    EXECUTED.unlink(missing_ok=True)
    with warnings.catch_warnings():
        pickle.loads(pickle.dumps(Evil()))
    assert EXECUTED.exists()
    EXECUTED.unlink()
