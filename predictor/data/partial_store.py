"""Keeps the finished episodes of a long recording on disk, so that one that was stopped goes on where it stopped.

Beside the store that is being made, under a hidden name, are the parts that are finished, each an episode store of its
own, and the settings that they were made with. When all episodes are there, they become one store and the parts are
deleted. A recording that is shorter than `PART_S` writes no parts. Those of a store on another file system (`s3://…`)
are in the folder in which the command runs, under a name that its address determines.
"""

import hashlib
import json
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

from predictor.data.store import Episode, StoreInfo, read_store, write_store
from predictor.support.errors import UserError
from predictor.support.files import delete_folder, delete_leftovers, write_json
from predictor.support.reading import read_object
from predictor.support.remote import address, is_remote
from predictor.support.stopping import deferred_stops

PART_S = 30.0
"""Time after which the episodes that have been recorded since the last part are written [s]."""
SETTINGS = "settings.json"


def beside(path: Path) -> Path:
    """Returns the path beside which the parts of a store are: its own, or one in this folder for an address."""
    if not is_remote(path):
        return path
    return Path(f"{path.name}-{hashlib.sha256(address(path).encode()).hexdigest()[:8]}")


def parts_of(path: Path) -> Path:
    """Returns the folder of the parts of a store that is being recorded."""
    kept = beside(path)
    return kept.with_name(f".{kept.name}.unfinished")


class PartialStore:
    """Episodes of a store that is being recorded, in their order; a context manager, which writes what it has at exit.

    Nobody else may write `beside(path)` meanwhile.

    Args:
        path: path of the store.
        settings: everything that the episodes depend on, as JSON; parts with the same settings are taken over.
        discard: whether parts with other settings are deleted.
        part_s: time between two parts [s].

    Attributes:
        folder: folder of the parts.
        num_done: number of steps of the recording that are on disk.
        skipped: why seeds have no episode, by seed.

    Raises:
        UserError: there are parts with other settings, and `discard` is not set.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any], discard: bool = False, part_s: float = PART_S) -> None:
        """Finds the parts of an earlier attempt."""
        self._path, self._part_s = Path(path), part_s
        kept = beside(self._path)
        self.folder = parts_of(self._path)
        self._settings = json.loads(json.dumps(settings, default=str))
        self._info: StoreInfo | None = None
        self._new: list[Episode] = []
        self._added = 0
        self.skipped: dict[int, str] = {}
        self._written_at = time.monotonic()
        for name in (kept.name, self.folder.name):
            delete_leftovers(kept.parent, name)
        if self.folder.exists():
            self._take_over(discard)
        parts = self._parts()
        self.num_done = sum(map(_steps, parts))
        for reasons in filter(Path.exists, map(_reasons, parts)):
            self.skipped |= {int(seed): str(reason) for seed, reason in read_object(reasons).items()}

    def __enter__(self) -> "PartialStore":
        """Returns itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Writes the episodes that are not on disk yet, if the recording was stopped."""
        self._write_part()

    def add(self, info: StoreInfo, *episodes: Episode) -> None:
        """Takes what the next step of the recording brought: one episode, several, or none; `num_done` counts steps."""
        self._info = info
        self._new.extend(episodes)
        self._added += 1
        if time.monotonic() - self._written_at >= self._part_s:
            self._write_part()

    def skip(self, seed: int, reason: str) -> None:
        """Takes what the next step of the recording brought: no episode, and why."""
        self.skipped[seed] = reason
        self._added += 1
        if time.monotonic() - self._written_at >= self._part_s:
            self._write_part()

    def finish(self, info: StoreInfo, overwrite: bool = False) -> list[Episode]:
        """Writes the store, deletes the parts, and returns all episodes; its provenance names the seeds without one.

        Raises:
            UserError: all seeds were skipped, none has an episode; or as `predictor.data.store.write_store`.
        """
        written = (read_store(part).episodes for part in self._parts() if any(part.iterdir()))
        episodes = [episode for found in written for episode in found] + self._new
        if not episodes and not self.skipped:
            raise UserError("no agent could be perturbed in any episode, so there are no branches; raise --max-steps")
        if self.skipped:
            if not episodes:
                failed, played = len(self.skipped), self.num_done + self._added
                self._forget()  # so that the next attempt plays them
                first = next(iter(self.skipped.values()))
                if failed < played:
                    raise UserError(
                        f"{failed} of {played} episodes failed, the first so: {first}; "
                        "in the others no agent could be perturbed: raise --max-steps"
                    )
                raise UserError(f"all {failed} episodes failed, the first so: {first}")
            named = {str(seed): reason for seed, reason in sorted(self.skipped.items())}
            info = replace(info, provenance=info.provenance | {"skipped": {"episodes": len(named), "reasons": named}})
        write_store(self._path, info, episodes, overwrite)
        self._forget()
        return episodes

    def _forget(self) -> None:
        """Deletes the parts, and keeps nothing that would be written."""
        self._new, self._added = [], 0
        if self.folder.exists():
            delete_folder(self.folder)

    def _parts(self) -> list[Path]:
        return sorted(part for part in self.folder.glob("*+*") if part.is_dir())

    def _take_over(self, discard: bool) -> None:
        delete_leftovers(self.folder)
        if not self._parts():  # the disk was full before the first one
            delete_folder(self.folder)
            return
        try:
            found = read_object(self.folder / SETTINGS)
        except UserError:
            found = {}
        if found == self._settings:
            return
        if not discard:
            other = ", ".join(_different(found, self._settings)) if found else "settings that cannot be read"
            raise UserError(
                f"{self.folder} has episodes of an unfinished recording that differs in {other}; "
                "repeat its command to go on, or pass --overwrite to begin anew"
            )
        delete_folder(self.folder)

    def _write_part(self) -> None:
        """Writes what is not on disk yet; a signal waits until the part is there and counted."""
        self._written_at = time.monotonic()
        if not self._added or (not self._new and not self.skipped):
            return
        with deferred_stops() as stops:
            self._write()
        stops.stop()

    def _write(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        write_json(self.folder / SETTINGS, self._settings)
        part = self.folder / f"{self.num_done:08d}+{self._added}"
        if self.skipped:
            write_json(_reasons(part), self.skipped)  # counts once the part is there
        if self._new:
            assert self._info is not None
            write_store(part, self._info, self._new)
        else:  # steps without an episode
            part.mkdir()
        self.num_done += self._added
        self._new, self._added = [], 0


def _different(found: dict[str, Any], settings: dict[str, Any]) -> list[str]:
    """Returns the names of the settings that differ in `found`; of a group also those within: "versions (torch)"."""
    names = []
    for name in [*settings, *sorted(found.keys() - settings.keys())]:
        before, now = found.get(name), settings.get(name)
        if before != now and isinstance(before, dict) and isinstance(now, dict):
            names.append(f"{name} ({', '.join(_different(before, now))})")
        elif before != now:
            names.append(name)
    return names


def _steps(part: Path) -> int:
    """Returns the number of steps of the recording that a part holds."""
    return int(part.name.partition("+")[2])


def _reasons(part: Path) -> Path:
    """Returns the file that says why seeds had no episode until a part was written."""
    return part.with_name(f"{part.name}.json")
