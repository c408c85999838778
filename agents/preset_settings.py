"""Changed hyperparameters: from words of a command line, from TOML files, and back into a file.

Names and types are those of the algorithm's preset (`agents.presets`); what does not fit is named in one sentence.
"""

import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any, get_type_hints

from agents.presets import PRESETS, Algorithm, Preset
from predictor.support.errors import UserError, short
from predictor.support.files import write_text
from predictor.support.reading import NoSuchFile, read_toml
from predictor.support.typed_values import converted


def settings_from_table(algorithm: Algorithm, table: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Returns hyperparameters from a TOML table, converted to the types of the algorithm's preset.

    Args:
        algorithm: learning algorithm.
        table: names and values.
        where: source of the table, for messages.

    Raises:
        UserError: a name is unknown, or a value has another type.
    """
    return _typed(type(PRESETS[algorithm]), table, f"{where}: {algorithm}", where)


def settings_from_file(algorithm: Algorithm, path: Path) -> dict[str, Any]:
    """Reads hyperparameters from a TOML file without tables: `learning_rate = 3e-4`.

    Raises:
        UserError: no such file, no TOML, or see `settings_from_table`.
    """
    try:
        table = read_toml(path)
    except NoSuchFile as error:
        raise UserError(f"no preset at {path}; give a TOML file with lines such as learning_rate = 3e-4") from error
    return settings_from_table(algorithm, table, str(path))


def settings_from_words(algorithm: Algorithm, words: Sequence[str]) -> dict[str, Any]:
    """Reads hyperparameters from words such as "learning_rate=3e-4" and "net_arch=64,64"; the last of a name counts.

    Raises:
        UserError: a word is no such pair, or see `settings_from_table`.
    """
    table: dict[str, Any] = {}
    kind = type(PRESETS[algorithm])
    hints = {field.name: get_type_hints(kind)[field.name] for field in fields(kind)}
    for word in words:
        name, _, text = word.partition("=")
        if not name or not text or "\n" in word:
            raise UserError(
                f"--set takes NAME=VALUE with hyperparameters of {algorithm} ({', '.join(hints)}), got "
                f"{short(repr(word), 80)}"
            )
        table[name] = _value(text, is_array=hints.get(name) == tuple[int, ...])
    return settings_from_table(algorithm, table, "--set")


def changed(preset: Preset, settings: Mapping[str, Any], where: str) -> Preset:
    """Returns a preset with other values.

    Raises:
        UserError: a name is unknown, or a value is of another type or out of range; the message begins with `where`.
    """
    try:
        return replace(preset, **_typed(type(preset), settings, where, where))
    except UserError as error:
        raise UserError(f"{where}: {error}") from error


def write_preset(path: Path, preset: Preset, comments: Sequence[str] = ()) -> None:
    """Writes the hyperparameters of a preset as TOML, for `settings_from_file`; those that are None are left out.

    Args:
        path: path of the file.
        preset: values to write.
        comments: lines above them, without "#".
    """
    values = {name: value for name, value in asdict(preset).items() if value is not None}  # TOML has no None
    lines = [f"# {line}" for line in comments] + [f"{name} = {_text(value)}" for name, value in values.items()]
    write_text(path, "\n".join(lines) + "\n")


def _typed(kind: type[Preset], table: Mapping[str, Any], of: str, where: str) -> dict[str, Any]:
    """Returns hyperparameters of a kind of preset, converted to its types."""
    known, hints = [field.name for field in fields(kind)], get_type_hints(kind)
    for name in table:
        if name not in known:
            raise UserError(f"{of} has no hyperparameter '{name}'; there are {', '.join(known)}")
    return {name: converted(value, hints[name], f"{where}: {name}") for name, value in table.items()}


def _value(text: str, is_array: bool) -> Any:
    """Returns the value of a word: TOML, "64,64" for an array, or a text without quotes."""
    if is_array and not text.startswith("["):
        text = f"[{text}]"
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):  # no TOML, or an integer of thousands of digits
        return text


def _text(value: Any) -> str:
    return json.dumps(list(value) if isinstance(value, tuple) else value)
