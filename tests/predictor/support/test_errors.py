import pytest

from predictor.support.errors import ProtocolError, UserError, run_entry_point


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
        (KeyboardInterrupt(), 130, "interrupted; continue with --resume where the command has it\n"),
    ],
    ids=["user", "missing", "exists", "file", "folder", "forbidden", "interrupted"],
)
def test_what_a_user_can_cause_is_one_line(
    capsys: pytest.CaptureFixture[str], error: BaseException, status: int, line: str
):
    with pytest.raises(SystemExit) as stop:
        run_entry_point(raises(error))
    assert stop.value.code == status
    assert capsys.readouterr() == ("", line)


@pytest.mark.parametrize("error", [ValueError("a bug"), ProtocolError("a bug"), ZeroDivisionError()])
def test_bugs_keep_their_traceback(error: Exception):
    with pytest.raises(type(error)):
        run_entry_point(raises(error))


def test_good_runs_end_as_they_are():
    run_entry_point(lambda: None)
