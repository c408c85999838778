"""Parts common to the dataset loaders: strict reading, splits by name, checksums, progress.

A loader reads a published file format, refuses broken input with one sentence that names file and line number, and
writes one episode store with a data card beside it (`predictor.data.dataset_card`).
"""

import hashlib
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from predictor.data.store_files import check_new_store
from predictor.scene import LARGEST
from predictor.support.config_checks import check_choices
from predictor.support.errors import UserError, short
from predictor.support.files import check_place
from predictor.support.reading import read_text
from predictor.support.remote import address, exists

Split = Literal["train", "val", "test", "all"]
SPLIT_SHARES = {"test": 0.1, "val": 0.1}
"""Shares of the splits; the rest is for training."""
LARGEST_WHOLE = 10**15 - 1
"""Largest whole number that is read; float64 holds all up to it."""
NO_LIMIT_M = 1e6
"""Perception range of scenes without an ego [m]."""


@dataclass(frozen=True)
class LoaderConfig:
    """Options of every dataset loader."""

    source: Path
    """Folder of the published files."""
    out: Path
    """Folder of the new store (Zarr); its data card is written beside it as <out>.md."""
    split: Split = "all"
    """Part of the dataset to write: a fixed function of names (trial, game, video, recording), see docs/datasets."""
    overwrite: bool = False
    """Replace an existing store and its card."""

    @property
    def card_path(self) -> Path:
        """Path of the data card."""
        return self.out.with_name(f"{self.out.name}.md")

    def __post_init__(self) -> None:
        """Checks choices.

        Raises:
            UserError: an unknown split.
        """
        check_choices(self)

    def check_paths(self) -> None:
        """Checks, before any work is done, that the source is there and the output does not exist yet.

        Raises:
            UserError: no source, or an existing output that may not be replaced.
        """
        if not self.source.exists():
            raise UserError(f"no source at {self.source}; pass the unpacked dataset")
        check_new_store(self.out, self.overwrite)
        check_place(self.card_path)
        if exists(self.card_path) and not self.overwrite:
            raise UserError(f"{address(self.card_path)} exists; choose another path or pass --overwrite")
        if exists(self.card_path) and not exists(self.out):
            raise UserError(f"{address(self.card_path)} belongs to no store; delete it, or choose another path")


def bad_line(path: Path, line: int, problem: str, advice: str = "repair the line or get the file anew") -> UserError:
    """Returns an error that names file and line."""
    return UserError(f"{path}, line {line}: {problem}; {advice}")


def read_lines(path: Path) -> list[str]:
    """Reads the lines of a text file, without line ends.

    Raises:
        UserError: the file is not text or cannot be read.
    """
    return read_text(path).splitlines()


def finite(text: str, name: str, path: Path, line: int) -> float:
    """Returns a finite number from text, at most `LARGEST`, so that states keep it as float32.

    Raises:
        UserError: the text is anything else, NaN included.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise bad_line(path, line, f"{name} must be a finite number, got '{short(text, 60)}'")
    if abs(value) > LARGEST:
        raise bad_line(path, line, f"{name} must be at most {LARGEST:g}, got '{short(text, 60)}'")
    return value


def whole(text: str, name: str, path: Path, line: int, least: int | None = None) -> int:
    """Returns a whole number from text, at least `least`.

    Raises:
        UserError: the text is anything else.
    """
    try:
        number = int(text)
    except ValueError:
        raise bad_line(path, line, f"{name} must be a whole number, got '{short(text, 60)}'") from None
    if abs(number) > LARGEST_WHOLE:
        raise bad_line(path, line, f"{name} must have at most 15 digits, got '{short(text, 60)}'")
    if least is not None and number < least:
        raise bad_line(path, line, f"{name} must be at least {least}, got {number}")
    return number


def frames_per_step(dt_s: float, frames_per_s: float, source: str) -> int:
    """Returns the number of recorded frames in one step.

    Args:
        dt_s: wanted time between steps [s].
        frames_per_s: rate of the recording [Hz].
        source: name of the recording, for the message.

    Raises:
        UserError: a step is not a whole number of frames.
    """
    frames = dt_s * frames_per_s
    if not math.isfinite(frames) or round(frames) < 1 or abs(frames - round(frames)) > 1e-6:
        raise UserError(
            f"dt_s must be a whole number of frames: {source} has {frames_per_s:g} per second, so dt_s={dt_s:g} would "
            f"be {frames:g}; pass a multiple of {1 / frames_per_s:g}"
        )
    return round(frames)


def split_of(name: str, seed: int) -> str:
    """Returns the split of a name by a hash of seed and name, so adding files changes no other split."""
    digest = hashlib.sha256(f"{seed}:{name}".encode("utf-8", "surrogateescape")).digest()
    position = int.from_bytes(digest[:8], "big") / 2**64
    for split, share in SPLIT_SHARES.items():
        if position < share:
            return split
        position -= share
    return "train"


def in_split(name: str, split: Split, seed: int) -> bool:
    """Returns whether a name belongs to the wanted split."""
    return split == "all" or split_of(name, seed) == split


def find_files(source: Path, pattern: str, what: str) -> list[Path]:
    """Returns the files under a folder, sorted by path; a source that is a file gives that file.

    Raises:
        UserError: no file matches, or the pattern is none.
    """
    try:
        files = [source] if source.is_file() else sorted(p for p in source.glob(pattern) if p.is_file())
    except (ValueError, NotImplementedError) as error:
        raise UserError(f"pattern must match paths below {source}, got '{short(pattern)}': {error}") from error
    if not files:
        raise UserError(f"{source} holds no {what} ({pattern}); pass the folder of the unpacked dataset")
    return files


def checksum(root: Path, files: Iterable[Path]) -> str:
    """Computes the SHA-256 over the files' paths (relative to `root`, sorted) and contents.

    For each file the digest takes the path in UTF-8 (other bytes as they are), a zero byte and the SHA-256 of the
    content.
    """
    root = root.parent if root.is_file() else root
    total = hashlib.sha256()
    for name, path in sorted((path.relative_to(root).as_posix(), path) for path in files):
        with path.open("rb") as file:
            content = hashlib.file_digest(file, "sha256").digest()
        total.update(name.encode("utf-8", "surrogateescape") + b"\0" + content)
    return total.hexdigest()
