"""Blocks that reports of all runs share: settings, origin, and what was measured of forecasts.

A run folder may come from a stranger: files are read within bounds, and what they hold is shown as text.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from predictor.reports.document import PNG, Block, Heading, Paragraph, Photo, Table
from predictor.support.errors import UserError, short
from predictor.support.reading import MIB, as_object, read_bytes, read_object
from predictor.support.typed_values import converted

ACCURACY_FILE = "accuracy.json"
"""File of `python -m envs.evaluate` and of `python -m predictor.evaluate`."""
NOTHING = "–"
MOST_SETTINGS, MOST_LETTERS = 200, 120
"""Largest number of settings in the table, and of letters of a value."""
MOST_PICTURE_BYTES, MOST_PICTURES = 4 * MIB, 12
"""Largest size of a picture, and largest number of pictures of one folder."""
_COLUMNS = {
    "ade_m": "ADE₁ [m]", "fde_m": "FDE₁ [m]", "min_ade_m": "minADE [m]", "min_fde_m": "minFDE [m]",
    "energy_m": "energy score [m]",
}  # fmt: skip
_CAPTIONS = {
    ".worst": "The worst forecasts, at most one per episode: history solid, forecasts dashed, what happened thin.",
    ".by_horizon": "Accuracy by time ahead.",
    "error_by_horizon": "Displacement by time ahead.",
    "scenes": "Forecasts of the busiest scenes: history solid, forecast dashed, what happened thin.",
}
"""Captions of pictures, by the end of their names."""


def settings(config: Mapping[str, Any]) -> list[Block]:
    """Returns the table of a run's settings; nested ones have their path as name."""
    lines = list(_settings(config))
    left_out = len(lines) - MOST_SETTINGS
    blocks: list[Block] = [Heading("Settings"), Table(["setting", "value"], lines[:MOST_SETTINGS], numbers=False)]
    return [*blocks, Paragraph(f"{left_out} more are in config.json.")] if left_out > 0 else blocks


def _settings(config: Mapping[str, Any], before: str = "") -> Iterator[list[str]]:
    for name, value in config.items():
        if isinstance(value, dict) and value:
            yield from _settings(value, f"{before}{name}.")
        elif value not in (None, "", [], {}):
            shown = ", ".join(map(str, value)) if isinstance(value, list) else value
            yield [short(before + name, MOST_LETTERS), short(shown, MOST_LETTERS)]


def origin(starts: Sequence[Any], where: str) -> list[Block]:
    """Returns how a run was made: command, commit, versions and machine of each start.

    Raises:
        UserError: the content is not what `predictor.support.provenance` writes.
    """
    blocks: list[Block] = [Heading("How it was made")]
    for start in starts[-10:]:
        made = as_object(start, f"{where}: provenance")
        told = [short(made.get(name, "not recorded")) for name in ("command", "commit", "machine", "time")]
        blocks.append(Paragraph(f"{told[0]}; commit {told[1]}; {told[2]}; {told[3]}."))
        versions = as_object(made.get("versions", {}), f"{where}: provenance.versions")
        blocks.append(Paragraph("Versions: " + ", ".join(f"{name} {short(v, 40)}" for name, v in versions.items())))
    return blocks


def accuracy(folders: Sequence[Path]) -> list[Block]:
    """Returns what was measured of forecasts: a table and the pictures of each folder that has accuracy.json.

    Raises:
        UserError: a file cannot be read, or is something else.
    """
    blocks: list[Block] = []
    for folder in folders:
        if os.path.lexists(folder / ACCURACY_FILE):
            blocks += [*_tables(folder / ACCURACY_FILE), *_pictures(folder)]
    return [Heading("Accuracy of the forecasts"), *blocks] if blocks else []


def _tables(file: Path) -> Iterator[Block]:
    content = read_object(file)
    results = content.get("results", [content])
    for number, result in enumerate(converted(results, tuple[dict[str, Any], ...], f"{file}: results")):
        where = f"{file}: result {number + 1}"
        if "rows" in result:  # of predictor.evaluate
            title, lines = str(result.get("source")), result["rows"]
        else:
            title = (
                f"{result.get('env_id')} {result.get('env_kwargs') or ''}".strip() + f", driven {result.get('driver')}"
            )
            controls = as_object(result.get("controls") or {}, where)
            lines = [result.get(name) for name in ("model", "model_samples", "constant_velocity")] + [
                *controls.values()
            ]
        cells = [_cells(as_object(line, where), where) for line in converted(lines, tuple[Any, ...], where)]
        yield Paragraph(f"{short(title, MOST_LETTERS)}:")
        yield Table(["forecaster", "K", *_COLUMNS.values(), "forecasts"], cells)


def _cells(line: Mapping[str, Any], where: str) -> list[str]:
    numbers = [converted(line.get(name), float | None, f"{where}: {name}") for name in _COLUMNS]
    counts = [converted(line.get(name), int | None, f"{where}: {name}") for name in ("num_samples", "agents")]
    shown = [NOTHING if count is None else f"{count:,}" for count in counts]
    name = short(converted(line.get("name"), str, f"{where}: name"), MOST_LETTERS)
    return [name, shown[0], *(NOTHING if number is None else f"{number:.3g}" for number in numbers), shown[1]]


def _pictures(folder: Path) -> Iterator[Block]:
    captions = {
        file: text
        for file in sorted(folder.glob("*.png"))
        for end, text in _CAPTIONS.items()
        if file.stem.endswith(end)
    }
    for file, caption in list(captions.items())[:MOST_PICTURES]:
        yield Photo(picture_in(file), caption)
    if len(captions) > MOST_PICTURES:
        yield Paragraph(f"{len(captions) - MOST_PICTURES} more pictures are in the folder.")


def picture_in(file: Path) -> bytes:
    """Returns the content of a PNG file.

    Raises:
        UserError: it cannot be read, is too large or no PNG.
    """
    data = read_bytes(file, MOST_PICTURE_BYTES)
    if not data.startswith(PNG):
        raise UserError(f"{file} is no PNG picture; remove it or make it anew")
    return data
