import errno
import os
import signal
import subprocess
import sys

import pytest

from predictor.support.errors import (
    MOST_LETTERS,
    CannotWriteError,
    ProtocolError,
    Terminated,
    UserError,
    one_line,
    run_entry_point,
    short,
)
from predictor.support.stopping import deferred_stops, resumable


def raises(error: BaseException):
    def main() -> None:
        raise error

    return main


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (UserError("steps must be at least 1, got -3"), 2, "error: steps must be at least 1, got -3\n"),
        (FileNotFoundError("no such file"), 2, "error: no such file\n"),
        (FileExistsError("there already"), 2, "error: there already\n"),
        (NotADirectoryError("a file"), 2, "error: a file\n"),
        (IsADirectoryError("a folder"), 2, "error: a folder\n"),
        (PermissionError("not yours"), 2, "error: not yours\n"),
        (KeyboardInterrupt(), 130, "stopped: what was not written yet is lost; the same command begins anew\n"),
        (Terminated(), 143, "stopped: what was not written yet is lost; the same command begins anew\n"),
        (
            OSError(errno.ENOSPC, "full", "/disk/a"),
            2,
            "error: cannot write /disk/a: No space left on device; what was there before is whole; make room or choose "
            "another disk\n",
        ),
    ],
    ids=["user", "missing", "exists", "file", "folder", "forbidden", "interrupted", "terminated", "full"],
)
def test_what_a_user_can_cause_is_one_line(
    capsys: pytest.CaptureFixture[str], error: BaseException, status: int, line: str
):
    with pytest.raises(SystemExit) as stop:
        run_entry_point(raises(error))
    assert stop.value.code == status
    assert capsys.readouterr() == ("", line)


@pytest.mark.parametrize(
    "error", [ValueError("a bug"), ProtocolError("a bug"), ZeroDivisionError(), BrokenPipeError("of a process")]
)
def test_bugs_keep_their_traceback(error: Exception):
    with pytest.raises(type(error)):
        run_entry_point(raises(error))


def unread(main: str, buffered: bool = True) -> tuple[int, str]:
    """Exit status and errors of a command whose output nobody reads."""
    reader, writer = os.pipe()
    os.close(reader)
    said = (
        f"import sys\nfrom predictor.support.errors import *\nfrom rich.console import Console\ndef main():\n {main}\n"
    )
    ended = subprocess.run(
        [sys.executable, "-c", f"{said}run_entry_point(main)"], stdout=writer, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "" if buffered else "1"},
    )  # fmt: skip
    os.close(writer)
    return ended.returncode, ended.stderr


@pytest.mark.parametrize("buffered", [True, False])
@pytest.mark.parametrize("main", ["print('x')", "print('x'); sys.exit(0)", "Console().print('x')"])
def test_a_reader_that_leaves_ends_a_command_without_a_word(buffered: bool, main: str):
    assert unread(main, buffered) == (141, "")


@pytest.mark.parametrize(
    ("end", "status", "line"),
    [
        ("raise UserError('steps must be at least 1')", 2, "error: steps must be at least 1\n"),
        ("sys.exit(1)", 1, ""),
        ("raise KeyboardInterrupt", 130, "stopped: what was not written yet is lost; the same command begins anew\n"),
    ],
)
def test_what_else_ends_a_command_is_told_where_nobody_reads_its_output(end: str, status: int, line: str):
    assert unread(f"print('to nobody'); {end}") == (status, line)


def test_a_bug_keeps_its_traceback_where_nobody_reads_the_output():
    status, errors = unread("print('to nobody'); {}['key']")
    assert status == 1 and errors.endswith("KeyError: 'key'\n")


@pytest.mark.parametrize("closed", ["sys.stdout = None", "sys.stdout.close()"])
def test_an_output_that_is_closed_changes_no_end(closed: str):
    assert unread(f"{closed}; raise UserError('no')") == (2, "error: no\n")
    status, errors = unread(f"{closed}; raise BrokenPipeError('of a process')")
    assert status == 1 and errors.endswith("BrokenPipeError: of a process\n")


@pytest.mark.parametrize("main", ["print('5 m² ± 1')", "sys.exit('5 m² ± 1')", "raise UserError('5 m² ± 1')"])
def test_a_terminal_without_unicode_shows_the_rest(main: str):
    said = f"import sys\nfrom predictor.support.errors import *\ndef main():\n {main}\nrun_entry_point(main)"
    environment = os.environ | {"PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    ended = subprocess.run([sys.executable, "-c", said], capture_output=True, text=True, env=environment)
    assert "5 m? ? 1" in ended.stdout + ended.stderr and "Traceback" not in ended.stderr


def test_a_broken_pipe_of_another_process_is_raised_while_the_output_is_read():
    said = "from predictor.support.errors import run_entry_point\ndef main(): raise BrokenPipeError('of a process')\n"
    ended = subprocess.run([sys.executable, "-c", f"{said}run_entry_point(main)"], capture_output=True, text=True)
    assert ended.returncode == 1 and "BrokenPipeError: of a process" in ended.stderr


def test_good_runs_end_as_they_are():
    run_entry_point(lambda: None)


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_a_command_in_one_line_that_says_how_to_go_on(
    capsys: pytest.CaptureFixture[str], number: signal.Signals, status: int
):
    def main() -> None:
        with resumable("outside"), resumable(lambda: "step 3 is saved; --resume goes on"):
            os.kill(os.getpid(), number)

    before = signal.getsignal(number)
    with pytest.raises(SystemExit) as stop:
        run_entry_point(main)
    assert stop.value.code == status
    assert capsys.readouterr() == ("", "stopped: step 3 is saved; --resume goes on\n")
    assert signal.getsignal(number) is before


def test_a_second_signal_during_the_end_keeps_the_line(capsys: pytest.CaptureFixture[str]):
    def main() -> None:
        try:
            with resumable("step 3 is saved"):
                raise KeyboardInterrupt
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(SystemExit):
        run_entry_point(main)
    assert capsys.readouterr().err == "stopped: step 3 is saved\n"


def test_a_full_disk_says_how_to_go_on_and_a_users_error_does_not(capsys: pytest.CaptureFixture[str]):
    def full() -> None:
        with resumable("--resume goes on"):
            raise CannotWriteError("cannot write a")

    def wrong() -> None:
        with resumable("--resume goes on"):
            raise UserError("steps must be positive")

    for main, line in ((full, "error: cannot write a; --resume goes on\n"), (wrong, "error: steps must be positive\n")):
        with pytest.raises(SystemExit):
            run_entry_point(main)
        assert capsys.readouterr().err == line


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_wait_for_the_end_of_a_step(capsys: pytest.CaptureFixture[str], number: signal.Signals):
    done: list[str] = []

    def main() -> None:
        with deferred_stops() as stops:
            os.kill(os.getpid(), number)
            done.append("step")
            assert stops.asked == number
            done.append("saved")
            stops.stop()
            done.append("never")

    with pytest.raises(SystemExit) as stop:
        run_entry_point(main)
    assert done == ["step", "saved"] and stop.value.code == 128 + number


def test_a_second_signal_does_not_wait(capsys: pytest.CaptureFixture[str]):
    def main() -> None:
        with deferred_stops():
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)
            pytest.fail("it went on")

    with pytest.raises(SystemExit):
        run_entry_point(main)


def test_signals_that_are_ignored_stay_ignored():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with deferred_stops() as stops:
            os.kill(os.getpid(), signal.SIGINT)
            assert stops.asked is None
    finally:
        signal.signal(signal.SIGINT, before)


def test_what_a_stop_leaves_undone_is_not_told():
    """Zarr hands coroutines to a thread; SIGTERM may come before one is handed over."""
    code = (
        "import os, signal\n"
        "from predictor.support.errors import run_entry_point\n"
        "async def write(): ...\n"
        "kept = []\n"
        "def main():\n"
        "    kept.append(write())\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
        "    signal.pause()\n"
        "run_entry_point(main)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 143
    assert done.stderr == "stopped: what was not written yet is lost; the same command begins anew\n"


@pytest.mark.parametrize("letters", [2, 3, 10, 11])
def test_a_long_value_is_cut_to_the_letters_asked_for(letters: int):
    assert short("a" * letters, letters) == "a" * letters
    cut = short("a" + "b" * letters + "c", letters)
    assert len(cut) == letters and "…" in cut and cut[-1] == "c"


def test_a_long_message_has_as_many_letters_as_a_message_may_have():
    assert len(one_line(UserError("x" * (MOST_LETTERS + 1)))) == MOST_LETTERS
