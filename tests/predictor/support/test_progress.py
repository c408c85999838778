"""Progress: a bar on a terminal of 80 columns, plain lines in a file."""

import io

import pytest
from rich.console import Console

from predictor.support import progress
from predictor.support.progress import WorkShown, track


class Clock:
    """Time that a test sets."""

    now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(progress, "time", made)
    return made


def into_a_file() -> Console:
    return Console(file=io.StringIO(), width=80)


def printed(console: Console) -> str:
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_a_file_gets_a_plain_line_at_each_tenth(clock: Clock):
    console = into_a_file()
    with WorkShown("train", 200, 100, console) as shown:
        for done in range(101, 201):
            clock.now += 1.0
            shown.to(done, f"loss {done}")
            if done == 150:
                shown.say("step 150: return 21.30 over 20 episodes (best [bold]22.40)")
    assert printed(console).splitlines() == [
        "train: 120 of 200, 20 s, about 80 s left, loss 120",
        "train: 140 of 200, 40 s, about 60 s left, loss 140",
        "step 150: return 21.30 over 20 episodes (best [bold]22.40)",
        "train: 160 of 200, 60 s, about 40 s left, loss 160",
        "train: 180 of 200, 80 s, about 20 s left, loss 180",
        "train: 200 of 200, 100 s, loss 200",
    ]


def test_quick_work_is_one_line_and_slow_work_a_line_a_minute(clock: Clock):
    quick, slow = into_a_file(), into_a_file()
    with WorkShown("evaluate", 7, console=quick) as shown:
        for _ in range(7):
            shown.advance()
    assert printed(quick) == "evaluate: 7 of 7, 0 s\n"
    with WorkShown("evaluate", 1000, console=slow) as shown:
        for _ in range(5):
            clock.now += 30.0
            shown.advance()
    assert printed(slow).splitlines()[:2] == [
        "evaluate: 2 of 1000, 60 s, about 29940 s left", "evaluate: 4 of 1000, 120 s, about 29880 s left",
    ]  # fmt: skip


def test_work_that_fails_is_not_said_to_have_ended(clock: Clock):
    console = into_a_file()
    with pytest.raises(KeyError), WorkShown("train", 10, console=console) as shown:
        shown.advance()
        raise KeyError
    assert printed(console) == ""


def test_a_terminal_of_80_columns_shows_the_numbers_and_the_note():
    console = Console(file=io.StringIO(), width=80, force_terminal=True, color_system=None)
    with WorkShown("evaluate intersection-v2", 20_000, console=console) as shown:
        shown.to(12_345, "nll 1.23")
        shown.say("step 12,000: return 21.30")
    text = printed(console)
    assert "evaluate intersection-v2" in text and "12345/20000" in text and "nll 1.23" in text and "…" not in text
    assert "step 12,000: return 21.30" in text


def test_items_are_counted_as_they_are_done(capsys: pytest.CaptureFixture[str]):
    assert list(track(iter("abc"), "read", 3)) == ["a", "b", "c"]
    assert capsys.readouterr().out == "read: 3 of 3, 0 s\n"
