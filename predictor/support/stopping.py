"""What a command that is stopped says, and signals that wait for the end of a step.

Ctrl-C raises KeyboardInterrupt, SIGTERM `Terminated` (`predictor.support.errors.run_entry_point`).
"""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from predictor.support.errors import CannotWriteError, Terminated


@contextmanager
def resumable(advice: str | Callable[[], str]) -> Iterator[None]:
    """Notes at what stops the block what was saved and how to go on; the command prints it.

    Args:
        advice: one sentence without a capital, or a function that returns it; the innermost block's counts.
    """
    try:
        yield
    except (KeyboardInterrupt, Terminated, CannotWriteError, OSError) as stop:
        if not getattr(stop, "__notes__", None):
            stop.add_note(advice if isinstance(advice, str) else advice())
        raise


class Stops:
    """Signals that have come and wait.

    Attributes:
        asked: number of the signal that came; None if none came.
    """

    def __init__(self) -> None:
        """Begins without a signal."""
        self.asked: int | None = None

    def note(self, number: int, frame: FrameType | None) -> None:
        """Takes a signal; a second one stops at once."""
        if self.asked is not None:
            self.stop()
        self.asked = number

    def stop(self) -> None:
        """Raises what the signal that came stands for; does nothing if none came.

        Raises:
            KeyboardInterrupt: Ctrl-C.
            Terminated: SIGTERM.
        """
        if self.asked is not None:
            raise KeyboardInterrupt if self.asked == signal.SIGINT else Terminated


@contextmanager
def deferred_stops() -> Iterator[Stops]:
    """Lets Ctrl-C and SIGTERM wait inside the block until its body asks for them, so that no step is cut in two.

    Signals that the process ignores, or leaves to the operating system, stay as they are.
    """
    stops, before = Stops(), dict[int, Callable[[int, FrameType | None], object]]()
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            handler = signal.getsignal(number)
            if callable(handler):
                before[number] = handler
                signal.signal(number, stops.note)
    try:
        yield stops
    finally:
        for taken, handler in before.items():
            signal.signal(taken, handler)
