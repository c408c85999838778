"""Files that would take a reader hours end in a sentence within moments."""

import json
import time
from pathlib import Path

import pytest

from predictor.support.errors import UserError
from predictor.support.reading import parse_json, read_toml
from predictor.support.typed_values import converted

PATIENCE_S = 20.0
"""Longest time on a busy machine; what grew by the square of the size took 20 minutes and more."""


def test_a_key_that_is_given_twice_is_found_in_one_pass():
    text = "{" + ", ".join(f'"{number}": 0' for number in range(300_000)) + ', "299999": 1}'
    began = time.monotonic()
    with pytest.raises(UserError, match="key '299999' is given twice"):
        parse_json(text, "config.json")
    assert time.monotonic() - began < PATIENCE_S
    assert parse_json(json.dumps({"a": 1}), "config.json") == {"a": 1}


@pytest.mark.parametrize("dots", [".", " . ", "\t.  "])
def test_names_of_many_parts_are_refused_before_they_are_read(tmp_path: Path, dots: str):
    file = tmp_path / "preset.toml"
    parts = 100_000
    for text in (
        dots.join("a" * parts) + " = 1",
        f"[{dots.join('a' * parts)}]",
        f"x = {{{dots.join('a' * parts)} = 1}}",
    ):
        file.write_text(text)
        began = time.monotonic()
        with pytest.raises(UserError, match="preset.toml is not valid TOML: it is nested too deeply"):
            read_toml(file)
        assert time.monotonic() - began < PATIENCE_S


def test_dots_that_are_no_names_are_read(tmp_path: Path):
    file = tmp_path / "preset.toml"
    numbers = [0.5 + number for number in range(200)]
    file.write_text(f"# {'.' * 200}\na.b.c = {numbers}\nd = '{'. ' * 100}'\n")
    assert read_toml(file) == {"a": {"b": {"c": numbers}}, "d": ". " * 100}


@pytest.mark.parametrize("number", ["0x" + "f" * 5000, "0b" + "1" * 20_000, "[1, 0o" + "7" * 6000 + "]"])
def test_integers_of_thousands_of_digits_are_named_by_their_bits(tmp_path: Path, number: str):
    """Python writes none of more than 4,300 digits, so that the sentence itself failed."""
    file = tmp_path / "preset.toml"
    file.write_text(f"learning_rate = {number}")
    with pytest.raises(UserError, match=r"integers have at most 19 digits \(64 bits\), got one of [12]\d,\d\d\d bits"):
        read_toml(file)


def test_values_of_thousands_of_digits_are_told_without_them():
    large = int("f" * 5000, 16)
    with pytest.raises(UserError, match="must be a number of at most 308 digits, got one of 6021"):
        converted(large, float, "--set: learning_rate")
    with pytest.raises(UserError, match="must be true or false, got an integer of thousands of digits"):
        converted(large, bool, "--set: shared")
