"""A folder with good inputs of every command, and paths that no command can use."""

import os
from pathlib import Path

from predictor.data.dataset_card import save_dataset
from predictor.data.nba import NbaConfig, load
from predictor.data.nba import scene_spec as nba_spec
from predictor.data.springs import SpringsConfig, make
from tests.hostile import texts
from tests.hostile.samples import KINDS
from tests.predictor.helpers import write_circles

LONG = "x" * 300
BAD_PATHS: dict[str, str] = {
    "a pipe": "fifo",
    "an empty folder": "empty",
    "a dangling link": "dangling",
    "a device": "zero",
    "a link to itself": "loop",
    "below a file": "file/below",
    "300 characters": LONG,
    "a file of letters": "file",
    "nothing": "absent",
    "markup in its name": "[red]absent[/red]",
    "a line end in its name": "absent\nabsent",
}
"""What stands at a path, and the path."""


def write_inputs(folder: Path) -> Path:
    """Writes good inputs and bad paths into an empty folder; returns it."""
    write_circles(folder / "store")
    for name, kind in (
        ("checkpoint", "checkpoint"),
        ("mocap", "motion"),
        ("csv", "levelx tracks"),
        ("run", "policy run"),
        ("nba", "score"),
        ("walk", "tracks"),
        ("toml", "study"),
        ("zip", "policy"),
    ):
        (folder / name).mkdir()
        KINDS[kind].make(folder / name)
    (folder / "nba" / "game.txt").write_text(texts.score(24))
    make(SpringsConfig(folder / "tables" / "springs", train=8, val=2, test=2, ood=2))
    nba = NbaConfig(folder / "nba", folder / "court", episode_steps=0)
    save_dataset(nba, nba_spec(), *load(nba))
    (folder / "sdd" / "quad" / "video0").mkdir(parents=True)
    (folder / "sdd" / "estimated_scales.yaml").write_text(texts.SCALES)
    (folder / "sdd" / "quad" / "video0" / "annotations.txt").write_text(texts.ANNOTATIONS)
    (folder / "preset.toml").write_text("learning_rate = 3e-4\n")
    (folder / "accuracy.json").write_text("{}")
    (folder / "file").write_text("mine")
    (folder / "empty").mkdir()
    os.mkfifo(folder / "fifo")
    (folder / "dangling").symlink_to("nowhere")
    (folder / "loop").symlink_to("loop")
    (folder / "zero").symlink_to("/dev/zero")
    return folder


def snapshot(folder: Path) -> dict[str, str]:
    """Returns what stands at each path of a folder: content of files, targets of links, kinds of other things."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink():
            found[name] = f"link to {os.readlink(path)}"
        elif path.is_file():
            found[name] = path.read_bytes().hex()
        else:
            found[name] = "folder" if path.is_dir() else "special"
    return found
