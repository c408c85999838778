"""Writes files and folders so that a reader finds the old version or the whole new one, never a part."""

import json
import os
import shutil
from pathlib import Path
from typing import Any


def copy_file(source: Path, target: Path) -> None:
    """Copy so that `target` is always a whole file."""
    partial = partial_path(target)
    shutil.copyfile(source, partial)
    publish(partial, target)


def write_text(path: Path, text: str) -> None:
    """Write so that `path` is always a whole file."""
    partial = partial_path(path)
    partial.write_text(text)
    publish(partial, path)


def partial_path(path: Path) -> Path:
    """Returns the temporary name beside `path` under which this process writes."""
    return path.with_name(f".{path.name}.{os.getpid()}.partial")


def publish(partial: Path, path: Path) -> None:
    """Flush to disk, then rename: a reader finds the old file or the whole new one, also after a power cut."""
    for target in (partial, partial.parent):
        descriptor = os.open(target, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        if target is partial:
            os.replace(partial, path)


def write_json(path: Path, content: Any) -> None:
    """Write JSON so that a reader finds either the old file or the whole new one."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    partial.write_text(json.dumps(content, indent=2, default=str) + "\n")
    os.replace(partial, path)


def replace_folder(new: Path, target: Path) -> None:
    """Put `new` in the place of `target`; a crash leaves one of them whole under the target's name or beside it."""
    if not target.exists():
        new.rename(target)
        return
    old = target.with_name(f".{target.name}.old")
    shutil.rmtree(old, ignore_errors=True)
    target.rename(old)
    os.replace(new, target)
    shutil.rmtree(old, ignore_errors=True)
