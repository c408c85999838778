"""The process that is fuzzed: `tests.fuzz` starts it with an entry, a folder for findings and libFuzzer's options.

A finding does not end it: the input is written down once for each place in the code, and the search goes on.
"""

import hashlib
import sys
import traceback
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["predictor", "agents.runs", "agents.studies", "agents.task", "agents.training",
                                         "agents.preset_settings", "envs.sb3.policy_file"]):  # fmt: skip
    from tests.fuzz.entries import ENTRY_NAMES, Target, target


class Kept:
    """Keeps one input for each place in the code that fails."""

    def __init__(self, try_one: Target, found: Path) -> None:
        """Takes what is fuzzed and the folder of the findings."""
        self._try, self._found = try_one, found
        self._places: set[str] = set()

    def __call__(self, content: bytes) -> None:
        """Tries an input."""
        try:
            self._try(content)
        except Exception as error:
            frames = traceback.extract_tb(error.__traceback__)
            ours = [f"{frame.filename}:{frame.lineno}" for frame in frames if "/site-packages/" not in frame.filename]
            place = f"{type(error).__name__} {ours[-1] if ours else ''}"
            if place in self._places:
                return
            self._places.add(place)
            name = f"{type(error).__name__}-{hashlib.sha256(content).hexdigest()[:12]}"
            (self._found / f"{name}.bin").write_bytes(content)
            (self._found / f"{name}.txt").write_text(traceback.format_exc())


def main() -> None:
    """Entry point."""
    name, found, *options = sys.argv[1:]
    (entry,) = (known for known in ENTRY_NAMES if known == name)
    with target(entry) as made:
        atheris.Setup([sys.argv[0], *options], Kept(made, Path(found)))
        atheris.Fuzz()


if __name__ == "__main__":
    main()
