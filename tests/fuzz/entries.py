"""What is fuzzed: kinds of input, and the readers that are given the same bytes."""

import contextlib
import json
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from agents.preset_settings import settings_from_file
from predictor.support.errors import MOST_LETTERS, UserError, one_line
from predictor.support.reading import parse_json
from tests.hostile.samples import KINDS

EntryName = Literal["json", "toml", "csv", "amc", "tracks", "texts", "safetensors", "store", "zip"]
ENTRY_NAMES: tuple[EntryName, ...] = get_args(EntryName)
CORPUS = Path(__file__).parent / "corpus"
"""Inputs that are kept: good samples, and what was once found."""
MOST_S = 1.0
"""Time after which an input counts as a hang [s]."""
MOST_BYTES = 20_000
"""Largest input that is tried: time may grow with the size of a file."""


class Slow(Exception):
    """Raised if an input takes too long."""


@dataclass(frozen=True)
class Entry:
    """Readers that are given the same bytes."""

    kinds: tuple[str, ...]
    """Keys of `KINDS`; each reads its sample with the bytes in the place of its file."""
    also: tuple[Callable[[Path], object], ...] = ()
    """Further readers of a file with the bytes."""


def _parse(path: Path) -> None:
    """Reads JSON with finite numbers, which must come back as they are."""
    content = parse_json(path.read_bytes(), "x", finite=True)
    assert parse_json(json.dumps(content), "x") == content


ENTRIES: dict[EntryName, Entry] = {
    "json": Entry(("checkpoint", "policy run", "predictor run", "curve", "record", "sportvu", "result"), (_parse,)),
    "toml": Entry(("study",), (lambda path: settings_from_file("ppo", path),)),
    "csv": Entry(("levelx tracks", "levelx meta", "levelx recording")),
    "amc": Entry(("motion", "skeleton")),
    "tracks": Entry(("tracks",)),
    "texts": Entry(("annotations", "scales", "score")),
    "safetensors": Entry(("weights",)),
    "store": Entry(("store info", "store", "array", "chunk")),
    "zip": Entry(("policy",)),
}  # fmt: skip
"""Kinds of input by name."""


class Target:
    """Gives bytes to the readers of an entry."""

    def __init__(self, name: EntryName, folder: Path) -> None:
        """Makes a good sample of each kind in a folder."""
        self.name, self._readers = name, []
        entry = ENTRIES[name]
        for kind in entry.kinds:
            sample = folder / kind.replace(" ", "-")
            sample.mkdir()
            KINDS[kind].make(sample)
            self._readers.append((sample / KINDS[kind].file, lambda kind=kind, sample=sample: KINDS[kind].load(sample)))
        for number, read in enumerate(entry.also):
            path = folder / f"also-{number}"
            self._readers.append((path, lambda read=read, path=path: read(path)))

    def seeds(self) -> list[bytes]:
        """Returns the files of the good samples."""
        return [path.read_bytes() for path, _ in self._readers if path.is_file()]

    def __call__(self, content: bytes) -> None:
        """Lets each reader read the bytes.

        Raises:
            Slow: a reader took more than a second.
            Exception: whatever a reader raises that is no `UserError` of one line.
        """
        if len(content) > MOST_BYTES:
            return
        for path, read in self._readers:
            path.write_bytes(content)
            began = time.process_time()
            try:
                read()
            except UserError as error:
                line = one_line(error)
                assert line.isprintable() and 0 < len(line) <= MOST_LETTERS, line
            took_s = time.process_time() - began
            if took_s > MOST_S:
                raise Slow(f"{path.name} took {took_s:.1f} s")


@contextlib.contextmanager
def target(name: EntryName) -> Iterator[Target]:
    """Makes the target of an entry, in a folder in memory where there is one."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(prefix="fuzz-", dir=memory if memory.is_dir() else None) as folder:
        yield Target(name, Path(folder))


def stored(name: EntryName) -> list[Path]:
    """Returns the inputs of the corpus of an entry."""
    return sorted(path for path in (CORPUS / name).glob("*") if path.is_file())
