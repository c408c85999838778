"""What the tests of the dataset loaders share."""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from jaxtyping import Float
from torch import Tensor

from predictor.data.store import EpisodeStore, read_store
from predictor.support.errors import run_entry_point


class Loader:
    """Runs an entry point in this process, with its output under a folder of its own."""

    def __init__(
        self,
        main: Callable[[], None],
        out: Path,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        self.main, self.out, self.monkeypatch, self.capsys = main, out, monkeypatch, capsys
        out.mkdir()

    @property
    def store(self) -> Path:
        return self.out / "store"

    @property
    def card(self) -> str:
        return (self.out / "store.md").read_text()

    def run(self, source: Path, *words: object) -> tuple[int, list[str]]:
        """Exit status and lines on stderr."""
        arguments = ["--source", source, "--out", self.store, *words]
        self.monkeypatch.setattr(sys, "argv", ["loader", *map(str, arguments)])
        code = 0
        try:
            run_entry_point(self.main)
        except SystemExit as stop:
            assert isinstance(stop.code, int)
            code = stop.code
        return code, self.capsys.readouterr().err.strip().splitlines()

    def load(self, source: Path, *words: object) -> EpisodeStore:
        """The store that a successful run wrote."""
        code, errors = self.run(source, *words)
        assert code == 0 and not errors, errors
        assert sorted(p.name for p in self.out.iterdir()) == ["store", "store.md"]
        return read_store(self.store)

    def refuses(self, source: Path, message: str, *words: object) -> None:
        """One line that starts as given; nothing is left behind."""
        code, errors = self.run(source, *words)
        assert code == 2 and len(errors) == 1, (code, errors)
        assert errors[0].startswith(f"error: {message}"), errors[0]
        assert list(self.out.iterdir()) == []


def change_line(path: Path, number: int, text: str | None) -> None:
    """Replace a line (counted from 1), or take it out."""
    lines = path.read_text().splitlines()
    lines[number - 1 : number] = [] if text is None else [text]
    path.write_text("\n".join(lines) + "\n")


def possession(frames: int, players: Sequence[int], feet: Callable[[int, int], tuple[float, float]]) -> str:
    """A file of the NBA's text layout.

    Args:
        frames: number of frames.
        players: ids of the ten players; -1 is the ball, which need not come first.
        feet: function of id and frame that returns x and y.
    """
    lines = []
    for t in range(frames):
        for entity in (*players[:3], -1, *players[3:]):
            x, y = feet(entity, t)
            lines.append(f"{12 * t} {entity} {x:.6f} {y:.6f} {'BALL' if entity == -1 else 'PLAYER'}")
    return "\n".join(lines)  # no end of line after the last, as published


def energy(
    couplings: Float[Tensor, "count agents agents"], states: Float[Tensor, "count frames agents 4"]
) -> Float[Tensor, "count frames"]:
    """Computes kinetic plus elastic energy of springs [J at unit mass]."""
    kinetic = 0.5 * states[..., 2:].square().sum((-1, -2))
    distance = states[..., None, :2] - states[..., None, :, :2]
    elastic = 0.25 * (couplings.double()[:, None] * distance.square().sum(-1)).sum((-1, -2))
    return kinetic + elastic
