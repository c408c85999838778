"""Errors that a user can cause, printed by an entry point in one line, with exit status 2 and no traceback."""

import sys
from collections.abc import Callable

_WRONG_PATH = (FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError, PermissionError)
"""Errors of the operating system when a user gives a path that does not fit."""


class UserError(ValueError):
    """Raised for bad input; the message names what was required, what was given and what to do."""


class ProtocolError(RuntimeError):
    """Raised when methods are called in a wrong order (for example a step before the first reset)."""


MOST_LETTERS = 2000
"""Largest length of a message; a longer one is cut in the middle."""


def short(value: object, letters: int = 300) -> str:
    """Returns a value as text of at most about this many letters, cut in the middle: for names in messages."""
    text = str(value)
    return text if len(text) <= letters else f"{text[: letters // 2]}…{text[-(letters - letters // 2) :]}"


def one_line(error: BaseException) -> str:
    """Returns the message of an error as one line that a terminal shows as it is.

    Files name things: their control characters, which could move the cursor or end the line, become spaces.
    """
    shown = "".join(letter if letter.isprintable() else " " for letter in str(error))
    return short(" ".join(shown.split()), MOST_LETTERS)


def run_entry_point(main: Callable[[], None]) -> None:
    """Runs `main`; turns user errors into one line on stderr and exit status 2, Ctrl-C into status 130."""
    try:
        main()
    except (UserError, *_WRONG_PATH) as error:
        print(f"error: {one_line(error)}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("interrupted; continue with --resume where the command has it", file=sys.stderr)
        sys.exit(130)
