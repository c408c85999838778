"""Errors a user can cause, and how an entry point shows them: one clear line, exit status 2, no traceback."""

import sys
from collections.abc import Callable


class UserError(ValueError):
    """Bad input: says what was required, what arrived and what to do."""


class ProtocolError(RuntimeError):
    """The library was driven in an order that has no meaning (for example a step before the first reset)."""


def run_entry_point(main: Callable[[], None]) -> None:
    """Run `main`; turn user errors into one line on stderr and exit status 2, Ctrl-C into status 130."""
    try:
        main()
    except (UserError, FileNotFoundError, PermissionError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("interrupted; continue with --resume where the command has it", file=sys.stderr)
        sys.exit(130)
