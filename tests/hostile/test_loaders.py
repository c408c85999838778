"""Any content of a file loads, or is refused as a `UserError`: found by hypothesis."""

import dataclasses
import json
import struct
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from agents.preset_settings import changed, settings_from_file
from agents.presets import PRESETS
from predictor.support.errors import UserError, one_line
from predictor.support.reading import parse_json
from tests.hostile.samples import KINDS

ANY_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)
"""Values of JSON, NaN and long integers included."""
TEXTS = ("tracks", "annotations", "scales", "score", "skeleton", "motion", "levelx tracks", "levelx meta",
         "levelx recording", "study")  # fmt: skip
OBJECTS = ("checkpoint", "policy run", "curve", "record", "sportvu", "result", "predictor run", "store info", "array")
BINARIES = ("weights", "chunk", "policy", "training state")
BUDGET = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A sample of each kind, whose file the tests overwrite."""
    folders = {kind: tmp_path_factory.mktemp("loaders") for kind in (*TEXTS, *OBJECTS, *BINARIES)}
    for kind, folder in folders.items():
        KINDS[kind].make(folder)
    return folders


def loads_or_is_refused(kind: str, folder: Path, content: bytes) -> None:
    path = folder / KINDS[kind].file
    before = path.read_bytes()
    path.write_bytes(content)
    try:
        KINDS[kind].load(folder)
    except UserError as error:
        assert one_line(error).isprintable()
    finally:
        path.write_bytes(before)


def places(content: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Returns the path to every value inside."""
    items = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    return [path, *(place for key, value in items for place in places(value, (*path, key)))]


def with_value(content: Any, place: tuple[Any, ...], value: Any) -> Any:
    if not place:
        return value
    changed = content.copy()
    changed[place[0]] = with_value(content[place[0]], place[1:], value)
    return changed


@pytest.mark.parametrize("kind", OBJECTS)
@BUDGET
@given(data=st.data())
def test_any_value_at_any_place_of_json(kind: str, good: dict[str, Path], data: st.DataObject):
    content = json.loads((good[kind] / KINDS[kind].file).read_text())
    place = data.draw(st.sampled_from(places(content)))
    changed = with_value(content, place, data.draw(ANY_JSON))
    loads_or_is_refused(kind, good[kind], json.dumps(changed).encode())


@pytest.mark.parametrize("kind", TEXTS)
@BUDGET
@given(data=st.data())
def test_any_word_of_a_text(kind: str, good: dict[str, Path], data: st.DataObject):
    """A piece of the text becomes a number, a word or bytes."""
    text = (good[kind] / KINDS[kind].file).read_bytes()
    first = data.draw(st.integers(0, len(text)))
    last = data.draw(st.integers(first, min(first + 12, len(text))))
    number = st.one_of(st.integers(), st.floats()).map(str)
    piece = data.draw(
        st.one_of(number.map(str.encode), st.binary(max_size=8), st.sampled_from([b"\n", b",", b" ", b":"]))
    )
    loads_or_is_refused(kind, good[kind], text[:first] + piece + text[last:])


@pytest.mark.parametrize("kind", BINARIES)
@settings(BUDGET, max_examples=30)
@given(data=st.data())
def test_any_bytes_of_a_binary(kind: str, good: dict[str, Path], data: st.DataObject):
    """Some bytes are others, are missing, or there are more."""
    content = (good[kind] / KINDS[kind].file).read_bytes()
    first = data.draw(st.integers(0, len(content)))
    last = data.draw(st.integers(first, min(first + 64, len(content))))
    loads_or_is_refused(kind, good[kind], content[:first] + data.draw(st.binary(max_size=64)) + content[last:])


@BUDGET
@given(data=st.data())
def test_any_hyperparameter_in_a_file(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject):
    """A preset's values may be anything that TOML can say."""
    name = data.draw(
        st.sampled_from([field.name for field in dataclasses.fields(PRESETS["ppo"])]) | st.text(max_size=9)
    )
    value = data.draw(
        st.integers() | st.floats() | st.booleans() | st.text(max_size=8) | st.lists(st.integers(), max_size=3)
    )
    path = tmp_path_factory.mktemp("preset") / "preset.toml"
    path.write_text(f"{json.dumps(name)} = {json.dumps(value).replace('NaN', 'nan').replace('Infinity', 'inf')}")
    try:
        changed(PRESETS["ppo"], settings_from_file("ppo", path), str(path))
    except UserError as error:
        assert one_line(error).isprintable()


@pytest.mark.slow
@BUDGET
@given(data=st.data())
def test_any_header_of_weights(good: dict[str, Path], data: st.DataObject):
    content = (good["weights"] / "model.safetensors").read_bytes()
    (length,) = struct.unpack("<Q", content[:8])
    header = json.loads(content[8 : 8 + length])
    place = data.draw(st.sampled_from(places(header)))
    changed = json.dumps(with_value(header, place, data.draw(ANY_JSON))).encode()
    stated = data.draw(st.sampled_from([len(changed), 0, len(changed) + 1, 2**63]))
    loads_or_is_refused("weights", good["weights"], struct.pack("<Q", stated) + changed + content[8 + length :])


@BUDGET
@given(content=ANY_JSON)
def test_json_comes_back_or_is_refused(content: Any):
    try:
        assert json.dumps(parse_json(json.dumps(content), "x")) == json.dumps(content)
    except UserError as error:
        assert "64 bits" in str(error) or "surrogate" in str(error)


@BUDGET
@given(text=st.text(max_size=40) | st.text('[]{}",:0123456789.eE-+ntfalsru\\', max_size=40))
def test_any_text_is_json_or_refused(text: str):
    try:
        parse_json(text, "x", finite=True)
    except UserError as error:
        assert str(error).startswith("x")
