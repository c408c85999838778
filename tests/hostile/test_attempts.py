"""Command lines and calls with one thing wrong end in one line; `tests.hostile.all` tries all, each in its process."""

import contextlib
import importlib
import io
import re
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

from predictor.support.errors import ProtocolError, UserError, one_line, run_entry_point
from tests.hostile import all as everything
from tests.hostile import attempts, calls
from tests.hostile.argued import ARGUED, reason_of
from tests.hostile.attempts import Attempt
from tests.hostile.calls import Call
from tests.hostile.inputs import snapshot, write_inputs
from tests.hostile.trying import copy_inputs, is_clear
from tests.hostile.zoo import CASES
from tests.test_entry_points import REFUSED

pytestmark = pytest.mark.unchecked
EVERY = 12
"""The share of the slower attempts that is tried here: one of so many."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Good inputs and bad paths."""
    with contextlib.redirect_stdout(io.StringIO()):
        return write_inputs(tmp_path_factory.mktemp("inputs"))


@pytest.fixture
def here(inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A copy of the inputs, in which commands run."""
    folder = tmp_path / "here"
    copy_inputs(inputs, folder)
    monkeypatch.chdir(folder)
    monkeypatch.setattr(torch, "set_num_threads", lambda _: None)
    yield folder


def refusals(trials: list[Attempt] | list[Call]) -> list[str]:
    """Returns what is neither refused in one clear line nor argued to be fine."""
    found = []
    for trial in trials:
        try:
            with contextlib.redirect_stderr(io.StringIO()) as said:
                trial.run()
            verdict, line = "silent", ""
        except UserError as error:
            line = f"error: {one_line(error)}\n"
            verdict = "one clear line" if is_clear(line, trial.expected) else "unclear"
        except SystemExit:
            line = said.getvalue()
            verdict = "unclear"
        except (TypeError, ValueError, AttributeError, OSError, ProtocolError) as error:
            verdict, line = "traceback", repr(error)
        if verdict != "one clear line" and not reason_of(trial.title, verdict):
            found.append(f"{verdict}: {trial.title!r}: {line[-300:]}")
    return found


@pytest.mark.parametrize("command", REFUSED)
def test_numbers_and_choices_that_do_not_fit(command: str):
    trials = [trial for trial in attempts.numbers() if trial.command == command]
    assert trials or command in ("docs.draw_pictures", "predictor.card", "agents.push", "agents.report")
    assert refusals(trials) == []


def share_of(source: Callable[[], Iterator[Attempt]], every: int = EVERY) -> list[Attempt]:
    """Returns one of so many, without those that are accepted and would run."""
    return [
        trial for place, trial in enumerate(source()) if place % every == 0 and not reason_of(trial.title, "silent")
    ]


@pytest.mark.parametrize(
    "attempt",
    [*share_of(attempts.paths), *share_of(attempts.names), *share_of(attempts.contradictions, 3)],
    ids=lambda attempt: attempt.title[:60].encode("unicode_escape").decode(),
)
def test_paths_and_names_that_do_not_fit(
    attempt: Attempt, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    before = snapshot(here)
    monkeypatch.setattr(sys, "argv", ["command", *attempt.words])
    with contextlib.suppress(SystemExit):
        run_entry_point(importlib.import_module(attempt.command).main)
    said = capsys.readouterr().err
    assert is_clear(said, attempt.expected), said
    assert snapshot(here) == before, "something was written"


PARTS: dict[str, Callable[[], Iterator[Call]]] = {
    "scenes": calls.scenes, "online": calls.online, "values": calls.values, "registrations": calls.registrations,
    "paths": calls.paths, "plans": calls.plans,
}  # fmt: skip


@pytest.mark.parametrize("part", PARTS)
def test_calls_that_do_not_fit(part: str, here: Path):
    assert refusals(list(PARTS[part]())) == []


@pytest.mark.parametrize("wrapper", calls.TAKES)
def test_settings_of_wrappers_that_do_not_fit(wrapper: str, here: Path):
    trials = [trial for trial in calls.wrappers() if trial.what == wrapper]
    by_setting = defaultdict(list)
    for trial in trials:
        by_setting[trial.name.partition("=")[0]].append(trial)
    # the same checks serve all wrappers: of each setting two values here, all of ForecastObservation
    some = [one for many in by_setting.values() for one in (many if wrapper == "ForecastObservation" else many[:2])]
    assert refusals(some) == []


def test_the_zoo_has_more_than_a_thousand_different_inputs():
    sources = (attempts.numbers, attempts.paths, attempts.names, attempts.contradictions, attempts.environment)
    titles = [case.title for case in CASES] + [trial.title for source in sources for trial in source()]
    titles += [call.title for call in calls.calls()]
    assert len(titles) > 4000
    assert len(set(titles)) > 4000
    kinds = {
        re.sub(r"^[\w.]+: ", "", title) for title in titles
    }  # the same thing wrong in several commands counts once
    assert len(kinds) > 1500


@pytest.mark.parametrize(("pattern", "verdict", "reason"), ARGUED, ids=[pattern[:40] for pattern, _, _ in ARGUED])
def test_what_is_argued_is_there_and_has_a_reason(pattern: str, verdict: str, reason: str):
    sources = (
        attempts.numbers,
        attempts.paths,
        attempts.names,
        attempts.contradictions,
        attempts.environment,
        calls.calls,
    )
    assert any(re.fullmatch(pattern, trial.title) for source in sources for trial in source())
    assert verdict in ("silent", "traceback", "unclear", "files changed") and len(reason) > 20


def test_a_line_that_does_not_name_what_is_wrong_is_not_clear():
    assert is_clear("error: steps must be at least 1, got 0\n", ("steps",))
    assert not is_clear("error: something is wrong\n", ("steps",))
    assert not is_clear("error: steps must be\nat least 1\n", ("steps",))
    assert not is_clear("Traceback (most recent call last)\n", ("",))
    assert not is_clear("error: \x1b[31mred\n", ("",))


def test_a_beginning_that_no_title_has_is_refused(monkeypatch: pytest.MonkeyPatch):
    """A mistyped --of tried nothing, and passed."""
    monkeypatch.setattr(everything, "REFUSED", ())
    monkeypatch.setattr(everything, "write_inputs", lambda _: None)
    with pytest.raises(UserError, match=r"of must begin the title of a trial, got 'predictor\.trian'"):
        everything.try_all(everything.AllConfig(only=("numbers",), of="predictor.trian"))
