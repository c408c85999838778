"""The zoo: what is done to files, and the part of the one line that must come of it.

A case is a kind of file (`tests.hostile.samples`), a name, what is done to the sample, and a part of the message.
"""

import json
import os
import pickle
import struct
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.hostile.samples import KINDS, PIN

Spoil = Callable[[Path], None]
"""Damages a file."""
DEEP, HUGE_NUMBER = 100_000, "9" * 5000
EXECUTED = Path(tempfile.gettempdir()) / f"dgvae-rl-zoo-executed-{os.getpid()}"
"""File that code in a hostile file would write."""


@dataclass(frozen=True)
class Case:
    """One bad input."""

    kind: str
    """Key of `KINDS`."""
    name: str
    """What is done."""
    spoil: Callable[[Path], None]
    """Damages the sample in a folder."""
    expected: str
    """Part of the message."""

    @property
    def title(self) -> str:
        """Name of the test."""
        return f"{self.kind}: {self.name}"


# --- Any file ---------------------------------------------------------------------------------------------------------


def _replaced(make: Spoil) -> Spoil:
    def spoil(path: Path) -> None:
        path.unlink()
        make(path)

    return spoil


def _bytes(content: bytes) -> Spoil:
    return lambda path: void(path.write_bytes(content))


def void(_: Any) -> None:
    """Drops a result."""


def _large(path: Path) -> None:
    os.truncate(path, 2**42)  # sparse: it takes no space


ABSENT = "there is no such file|it has no|missing|no policy at|no preset at|but no tuning"

ANY_FILE: dict[str, tuple[Spoil, str]] = {
    "missing": (lambda path: path.unlink(), ABSENT),
    "folder": (_replaced(lambda path: path.mkdir()), "is a folder|are missing"),
    "fifo": (_replaced(lambda path: os.mkfifo(path)), "is no regular file"),
    "device": (_replaced(lambda path: path.symlink_to("/dev/zero")), "is no regular file"),
    "dangling link": (_replaced(lambda path: path.symlink_to("nowhere")), ABSENT),
    "link to itself": (_replaced(lambda path: path.symlink_to(path.name)), "links that lead in a circle|but no tuning"),
    "4 TiB": (_large, "GiB"),
}
"""What is done to files of every kind."""
NOT_TEXT: dict[str, tuple[Spoil, str]] = {
    "empty": (_bytes(b""), ""),
    "not UTF-8": (_bytes(b'{"caf\xe9": 1}\n'), "UTF-8|expected the columns|is missing"),
    "random bytes": (_bytes(bytes(range(128, 256)) * 9), ""),
    "zeros": (_bytes(b"\0" * 300), ""),
}
"""What is done to texts."""
NOT_JSON: dict[str, tuple[Spoil, str]] = {
    "cut in the middle": (
        lambda path: void(path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])),
        "no JSON",
    ),
    "deep lists": (_bytes(b"[" * DEEP + b"]" * DEEP), "nested"),
    "deep objects": (_bytes(b'{"a":' * DEEP + b"1" + b"}" * DEEP), "nested"),
    "integer of 5,000 digits": (_bytes(f'{{"format": {HUGE_NUMBER}}}'.encode()), "digits"),
    "integer of 4,000 digits": (_bytes(f'{{"format": {HUGE_NUMBER[:4000]}}}'.encode()), "digits"),
    "half a surrogate": (_bytes(b'{"format": "\\ud800"}'), "surrogate"),
    "a number": (_bytes(b"1"), ""),
    "null": (_bytes(b"null"), ""),
    "a text": (_bytes(b'"dgvae-rl"'), ""),
    "list of lists": (_bytes(b"[[]]"), ""),
    "list of null": (_bytes(b"[null]"), ""),
    "two values": (_bytes(b"{} {}"), "no JSON"),
    "empty object": (_bytes(b"{}"), ""),
}
"""What is done to files of JSON."""
JSON_KINDS = (
    "checkpoint", "store", "array", "predictor run", "policy run", "curve", "result", "record", "sportvu", "tuning",
)  # fmt: skip
TEXT_KINDS = tuple(
    kind for kind in KINDS if kind not in ("weights", "chunk", "training state", "policy", "tuning study")
)
OPTIONAL = ("curve", "predictor's curve", "accuracy", "record", "predictor run", "tuning", "tuning study")
"""Files that may be absent."""
ACCEPTED = {
    ("annotations", "empty"): "a video without annotations has no episode, and a store without any is refused",
    ("preset", "empty"): "a preset that changes nothing is the algorithm's own",
    ("scales", "empty"): "the first video without a scale is named",
}
"""Inputs that are no damage, and why."""


def any_file() -> Iterator[Case]:
    """Yields what is done to every kind of file."""
    for kind, sample in KINDS.items():
        for name, (spoil, expected) in ANY_FILE.items():
            if name == "missing" and kind in OPTIONAL:
                continue
            yield Case(kind, name, lambda f, file=sample.file, spoil=spoil: spoil(f / file), expected)
        tables = [NOT_TEXT] if kind in TEXT_KINDS else []
        for table in [*tables, *([NOT_JSON] if kind in JSON_KINDS else [])]:
            for name, (spoil, expected) in table.items():
                if (kind, name) in ACCEPTED:
                    continue
                yield Case(kind, name, lambda f, file=sample.file, spoil=spoil: spoil(f / file), expected)


# --- JSON: one value in another place ---------------------------------------------------------------------------------

NAN, INF = float("nan"), float("inf")
VALUES: dict[str, list[tuple[str, Any, str]]] = {
    "checkpoint": [
        ("format", "other", "format"),
        ("version", 2, "version"),
        ("version", "1", "version"),
        ("model", "resnet", "resnet"),
        ("model", None, "model"),
        ("horizon_steps", 0, "horizon_steps"),
        ("horizon_steps", -3, "horizon_steps"),
        ("horizon_steps", 2.5, "horizon_steps"),
        ("horizon_steps", "3", "horizon_steps"),
        ("horizon_steps", True, "horizon_steps"),
        ("horizon_steps", 10**12, "horizon_steps"),
        ("std_m", "abc", "std_m"),
        ("std_m", ["a", "b", "c"], "std_m"),
        ("std_m", [NAN, 1.0, 1.0], "std_m"),
        ("std_m", [-1.0, 1.0, 1.0], "std_m"),
        ("std_m", [0.0, 1.0, 1.0], "std_m"),
        ("std_m", [INF, 1.0, 1.0], "std_m"),
        ("std_m", [1.0], "std_m"),
        ("std_m", [[1.0], [1.0], [1.0]], "std_m"),
        ("std_m", None, "std_m"),
        ("sources", "abc", "sources"),
        ("sources", [1, 2], "sources"),
        ("sources", [["a"]], "sources"),
        ("provenance", [["a", "b"]], "provenance"),
        ("provenance", "abc", "provenance"),
        ("spec", None, "spec"),
        ("spec", [], "spec"),
        ("spec.dt_s", NAN, "dt_s"),
        ("spec.dt_s", 0, "dt_s"),
        ("spec.dt_s", "1", "dt_s"),
        ("spec.dt_s", True, "dt_s"),
        ("spec.frame", ["ego"], "frame"),
        ("spec.frame", "ego", "frame"),
        ("spec.frame", ["moon", "world"], "frame"),
        ("spec.frame", [["ego"], "world"], "frame"),
        ("spec.feature_names", ["x_m"], "feature"),
        ("spec.feature_names", [1, 2, 3, 4], "feature_names"),
        ("spec.feature_scales", [NAN, 1, 1, 1], "feature_scales"),
        ("spec.feature_scales", [0, 1, 1, 1], "feature_scales"),
        ("spec.feature_scales", [-1, 1, 1, 1], "feature_scales"),
        ("spec.feature_scales", ["a", 1, 1, 1], "feature_scales"),
        ("spec.feature_scales", [1, 1, 1], "feature_scales"),
        ("spec.has_ego", "no", "has_ego"),
        ("spec.has_ego", 1, "has_ego"),
        ("spec.perception_m", NAN, "perception_m"),
        ("spec.perception_m", -1.0, "perception_m"),
        ("spec.perception_m", None, "perception_m"),
        ("spec.max_agents", 0, "max_agents"),
        ("spec.max_agents", 2.5, "max_agents"),
        ("spec.max_agents", 10**12, "max_agents"),
        ("spec.constant_features", "x_m", "constant_features"),
        ("spec.constant_features", [["x"]], "constant_features"),
        ("spec.unknown", 1, "unknown"),
        ("config", None, "config"),
        ("config", "abc", "config"),
        ("config.unknown", 1, "unknown"),
        ("config.hidden_dim", 10**9, "hidden_dim"),
        ("config.hidden_dim", 10**30, "digits"),
        ("config.hidden_dim", 60_000, "config.json"),
        ("config.hidden_dim", 9.0, "hidden_dim"),
        ("config.hidden_dim", "9", "hidden_dim"),
        ("config.hidden_dim", True, "hidden_dim"),
        ("config.hidden_dim", 0, "hidden_dim"),
        ("config.rnn_dim", 10**9, "rnn_dim"),
        ("config.decoder_dim", 10**9, "decoder_dim"),
        ("config.message_dim", 10**9, "message_dim"),
        ("config.num_modes", 10**9, "num_modes"),
        ("config.num_edge_types", 10**9, "num_edge_types"),
        ("config.edge_feature_dim", 10**9, "edge_feature_dim"),
        ("config.innovation_rounds", 10**9, "innovation_rounds"),
        ("config.substeps", 10**9, "substeps"),
        ("config.num_neighbours", -1, "num_neighbours"),
        ("config.temperature", NAN, "temperature"),
        ("config.dropout", 1.5, "dropout"),
        ("config.residual", "moon", "residual"),
        ("config.residual", ["state"], "residual"),
        ("config.forget_bias", NAN, "forget_bias"),
        ("config.forget_bias", "a", "forget_bias"),
        ("config.zero_start", "yes", "zero_start"),
        ("config.rollout_graph", 1, "rollout_graph"),
        *[
            (f"config.{name}", bad, name)
            for name in ("delta_scales", "input_scales", "change_scales")
            for bad in ([NAN, 1, 1, 1], [0, 1, 1, 1], [-1, 1, 1, 1], [1, 1], "abc", ["a"] * 4, [INF] * 4, 5)
        ],
        ("config.geometry_scales", [NAN, 1], "geometry_scales"),
        ("config.geometry_scales", [1, 1, 1], "geometry_scales"),
        ("config.geometry_scales", [True, True], "geometry_scales"),
    ],
    "store": [
        ("zarr_format", 2, "zarr_format"),
        ("node_type", "array", "node_type"),
        ("attributes", None, "attributes"),
        ("attributes.format", "other", "not an episode store"),
        ("attributes.version", 2, "version"),
        ("attributes.version", None, "version"),
        ("attributes.spec", None, "spec"),
        ("attributes.spec.dt_s", NAN, "dt_s"),
        ("attributes.spec.dt_s", "a", "dt_s"),
        ("attributes.spec.unknown", 1, "unknown"),
        ("attributes.spec.feature_scales", ["a"] * 4, "feature_scales"),
        ("attributes.spec.feature_scales", [0] * 4, "feature_scales"),
        ("attributes.spec.max_agents", 10**12, "max_agents"),
        ("attributes.source", 5, "source"),
        ("attributes.source", None, "source"),
        ("attributes.labels", [], "labels"),
        ("attributes.labels", "abcdef", "labels"),
        ("attributes.labels", [1] * 6, "labels"),
        ("attributes.labels", None, "labels"),
        ("attributes.provenance", "abc", "provenance"),
        ("attributes.provenance", None, "provenance"),
        ("attributes.edge_attribute_names", "abc", "edge_attribute_names"),
        ("attributes.edge_attribute_names", ["a", "b"], "checksum"),
        ("attributes.causal_threshold_m", "a", "causal_threshold_m"),
        ("attributes.causal_threshold_m", NAN, "causal_threshold_m"),
        ("attributes.causal_threshold_m", -1.0, "causal_threshold_m"),
    ],
    "array": [
        ("shape", [10**15, 5, 4], ""),
        ("shape", [-1, 5, 4], "shape"),
        ("shape", [10**40], "digits"),
        ("shape", "abc", "shape"),
        ("shape", [], "states"),
        ("shape", [2], "states"),
        ("data_type", "float64", ""),
        ("data_type", "complex64", "data_type"),
        ("data_type", "object", "data_type"),
        ("data_type", {"name": "fixed_length_utf32"}, "data_type"),
        ("data_type", "string", "data_type"),
        ("chunk_grid", None, "chunk_grid"),
        ("chunk_grid.configuration.chunk_shape", [0, 0, 0], "chunk"),
        ("chunk_grid.configuration.chunk_shape", [10**15, 5, 4], "chunk"),
        ("codecs", [], "codecs"),
        ("codecs", [{"name": "numcodecs.pickle"}], "codecs must be bytes, zstd, crc32c"),
        ("codecs", [{"name": "moon"}], "codecs must be bytes, zstd, crc32c"),
        ("node_type", "group", "states"),
        ("fill_value", "abc", ""),
    ],
    "policy run": [
        ("config", None, "config"),
        ("config", [], "config"),
        ("config.env_id", None, "env_id"),
        ("config.env_id", 5, "env_id"),
        ("config.env_id", "evil_module:Id-v0", "--env-id"),
        ("config.env_id", "evil_module:Evil", "--env-id"),
        ("config.env_id", "nothing-v0:x", "--env-id"),
        ("config.env_kwargs", '{"config": {"other_vehicles_type": "evil_module.Evil"}}', "evil_module.Evil"),
        ("config.env_kwargs", '{"env_id": "x"}', "env_id"),
        ("config.env_kwargs", "[" * DEEP, "nested"),
        ("config.env_kwargs", "{]", "JSON"),
        ("config.env_kwargs", 5, "env_kwargs"),
        ("config.observe", "moon", "observe"),
        ("config.observe", ["none"], "observe"),
        ("config.observe", None, "observe"),
        ("config.checkpoint", 5, "checkpoint"),
        ("config.checkpoint", ["a"], "checkpoint"),
        ("config.algorithm", "moon", "algorithm"),
        ("config.algorithm", 5, "algorithm"),
        ("config.learners", "abc", "learners"),
        ("config.learners", [1], "learners"),
        ("config.partner", "moon", "driver"),
        ("config.partner", 5, "partner"),
        ("config.num_samples", 0, "num_samples"),
        ("config.num_samples", "a", "num_samples"),
        ("config.num_samples", 2.5, "num_samples"),
        ("config.num_samples", 10**12, "num_samples"),
        ("config.horizon_steps", "a", "horizon_steps"),
        ("config.horizon_steps", -1, "horizon_steps"),
        ("config.horizon_steps", 10**12, "horizon_steps"),
        ("config.perception_m", NAN, "perception_m"),
        ("config.perception_m", "a", "perception_m"),
        ("config.what_if", "yes", "what_if"),
    ],
    "predictor run": [
        ("config", None, "config"),
        ("config", [1], "config"),
        ("config", "abc", "config"),
        ("config.steps", "abc", "steps"),
        ("config.batch_size", "\x1b[31mred\n", "batch_size"),
        ("config.seed", {"a": 1}, "seed"),
        ("config.set", 5, "set"),
        ("config.data", 5, "data"),
        ("config.lr", NAN, "lr"),
    ],
    "tuning": [
        ("config", None, "damaged"),
        ("config", [], "damaged"),
        ("config.steps", 5, "steps was 5"),
        ("config.env_id", "\x1b[31mred", "env_id"),
        ("provenance", 5, "damaged"),
        ("provenance", [5], "damaged"),
    ],
    "curve": [
        ("0", 5, "curve.json"),
        ("0.steps", "a", "steps"),
        ("0.steps", NAN, "steps"),
        ("0.steps", -1, "steps"),
        ("0.return", "a", "return"),
        ("0.return", ["a"], "return"),
        ("0.seconds", "a", "seconds"),
    ],
    "record": [
        ("measurements", 5, "measurements"),
        ("measurements.0", 5, "measurements"),
        ("measurements.0.episodes", "a", "episodes"),
        ("measurements.0.env_id", 5, "env_id"),
        ("measurements.0.unknown", 5, "unknown"),
        ("measurements.0.min_ade_m", "a", "min_ade_m"),
        ("measurements.0.min_ade_interval_m", [1.0], "min_ade_interval_m"),
        ("measurements.0.min_ade_interval_m", "ab", "min_ade_interval_m"),
        ("measurements.0.controls", 5, "controls"),
        ("measurements.0.controls", {"x": {}}, "best_of_k_m"),
    ],
    "sportvu": [
        ("events", 5, "events"),
        ("events.0", None, "moments"),
        ("events.0.moments", 5, "moments"),
        ("events.0.moments.0", None, "moments[0]"),
        ("events.0.moments.0.1", "a", "moments[0]"),
        ("events.0.moments.0.1", 10**25, "digits"),
        ("events.0.moments.0.5", None, "moments[0]"),
        ("events.0.moments.0.5.0.2", NAN, "finite"),
        ("events.0.moments.0.5.0.2", "a", "moments[0]"),
        ("events.0.moments.0.5.1.1", -7, "ids"),
        ("events.0.moments.0.5.1.1", 2**63, "ids"),
        ("events.0.moments.0.5.1.1", 9.3e18, "ids"),
        ("events.0.moments.0.5.1.2", 1e300, "positions"),
    ],
}
"""Dotted place of a value in a file of JSON, the value, and a part of the message."""
DROPPED: dict[str, list[str]] = {
    "checkpoint": "format version spec config horizon_steps std_m sources provenance spec.dt_s".split(),
    "store": "zarr_format attributes attributes.spec attributes.labels attributes.version attributes.source".split(),
    "array": ["shape", "data_type", "chunk_grid", "codecs", "node_type", "fill_value"],
    "policy run": ["config", "config.observe", "config.checkpoint", "config.algorithm"],
    "predictor run": ["config"],
    "result": ["sha256"],
    "record": ["measurements", "measurements.0.env_id"],
    "curve": ["0.steps", "0.return"],
}  # fmt: skip
"""Dotted places of what is left out."""


def _change(file: Path, place: str, change: Callable[[Any, Any], None]) -> None:
    content = json.loads(file.read_text())
    *path, last = [int(part) if part.isdigit() else part for part in place.split(".")]
    inner = content
    for part in path:
        inner = inner[part]
    change(inner, last)
    file.write_text(json.dumps(content))


def _set(kind: str, place: str, value: Any) -> Spoil:
    def put(inner: Any, key: Any) -> None:
        inner[key] = value

    return lambda folder: _change(folder / KINDS[kind].file, place, put)


def values() -> Iterator[Case]:
    """Yields files of JSON with one value changed or left out."""
    for kind, changed in VALUES.items():
        for place, value, expected in changed:
            yield Case(kind, f"{place} = {json.dumps(value)[:40]}", _set(kind, place, value), expected)
    for kind, places in DROPPED.items():
        for place in places:
            name = place.rpartition(".")[2]
            drop = lambda f, kind=kind, place=place: _change(f / KINDS[kind].file, place, lambda c, key: c.pop(key))  # noqa: E731
            yield Case(kind, f"without {place}", drop, "" if kind == "array" else name)


# --- Texts: one line changed ------------------------------------------------------------------------------------------

LINES: list[tuple[str, str, str, str]] = [
    ("tracks", "790 4", "nan 4", "line 3"),
    ("tracks", "790 4", f"{HUGE_NUMBER} 4", "line 3"),
    ("tracks", "790 4", "1e300 4", "line 3"),
    ("tracks", "790 4", "999999999999980 4 1 1\n999999999999990 4", "steps"),
    ("tracks", "790 4", "-999999999999990 4 1 1\n-999999999999980 4", "steps"),
    ("tracks", "790 4", "790", "line 3"),
    ("tracks", "790 4 ", "790 4 inf ", "finite"),
    ("tracks", "790 4", "780 4", "already"),
    ("tracks", "790 4", "790 -4", "id"),
    ("tracks", "790 4 158", "790 4 1e300", "line 3"),
    ("tracks", "790 4 158", "790 4 1e39", "line 3"),
    ("annotations", " 12 0 0 0", f" {HUGE_NUMBER} 0 0 0", "line 2"),
    ("annotations", " 12 0 0 0", f" {'9' * 100} 0 0 0", "line 2"),
    (
        "annotations",
        "4 98 47",
        "5 0 0 9 9 999999999999960 0 0 0 Biker\n5 0 0 9 9 999999999999972 0 0 0 Biker\n4 98 47",
        "steps",
    ),
    ("annotations", "4 98 47 102 53 12", f"{'9' * 30} 98 47 102 53 12", "line 2"),
    ("annotations", "4 98 47 102 53 12", "4 nan 47 102 53 12", "line 2"),
    ("annotations", "4 98 47 102 53 12", "4 1e300 47 102 53 12", "line 2"),
    ("annotations", "Pedestrian", "Moon", "label"),
    ("scales", "0.5 ", "nan ", "scale"),
    ("scales", "0.5 ", "-1 ", "scale"),
    ("scales", "0.5 ", "1e300 ", "scale"),
    ("scales", "quad:", "*a: &b", ""),
    ("score", "12 1 1 20", f"12 {'9' * 30} 1 20", "line"),
    ("score", "12 1 1 20", f"12 {HUGE_NUMBER} 1 20", "line"),
    ("score", "12 1 1 20", "12 1 nan 20", "line"),
    ("score", "12 1 1 20", "12 1 1e300 20", "line"),
    ("score", "12 1 1 20", "12 1 1 20 20", "line"),
    ("skeleton", "length 0.5", "length 0", "length"),
    ("skeleton", "length 0.5", "length 1e-320", "length"),
    ("skeleton", "length 2", "length nan", "length"),
    ("skeleton", "root upper", "upper upper", "parent"),
    ("skeleton", "direction 1 0 0", "direction 0 0 0", "direction"),
    ("skeleton", "direction 1 0 0", "direction 1e300 1e300 0", "direction"),
    ("skeleton", "axis XYZ", "axis XXX", "axis"),
    ("skeleton", "dof rz", "dof rz rz", "dof"),
    ("skeleton", ":hierarchy", ":moon", "hierarchy"),
    ("motion", "\n2\n", "\n3\n", "consecutive"),
    ("motion", "\n2\n", f"\n{HUGE_NUMBER}\n", "frame"),
    ("motion", "\n1\n", f"\n{'9' * 30}\n", "frame"),
    ("motion", "upper 1.5", "upper inf", "finite"),
    ("motion", "upper 1.5", "upper 1e300", ""),
    ("motion", "upper 1.5", "moon 1.5", "moon"),
    ("motion", "upper 1.5", "upper", ""),
    ("levelx tracks", "0,1,5,5", "0,1,nan,5", "line 3"),
    ("levelx tracks", "0,1,5,5", "0,1,999999999999995,5", "steps"),
    ("levelx tracks", "0,1,5,5", "0,1,1e300,5", "line 3"),
    ("levelx tracks", "0,1,5,5", "0,1,5,1e300", "line 3"),
    ("levelx tracks", "0,1,5,5", "0,2,5,5", "track 2"),
    ("levelx tracks", "0,1,5,5", "0,1,0,5", "already"),
    ("levelx tracks", "trackId", "moon", ""),
    ("levelx meta", "car", "moon", "class"),
    ("levelx meta", "0,1,car", "0,1", "columns"),
    ("levelx meta", "0,1,car", f"0,{HUGE_NUMBER},car", "line 2"),
    ("levelx meta", "0,1,car", f"0,1,{'c' * 200_000}", ""),
    ("levelx recording", "25", "0", "frameRate"),
    ("levelx recording", "25", "nan", "frameRate"),
    ("levelx recording", "0,3,25", "0,3,25\n0,3,25", "one recording"),
    ("preset", "learning_rate = 3e-4", "lerning_rate = 1", "lerning_rate"),
    ("preset", "learning_rate = 3e-4", "learning_rate = nan", "learning_rate"),
    ("preset", "learning_rate = 3e-4", "learning_rate = -1", "learning_rate"),
    ("preset", "learning_rate = 3e-4", "learning_rate = 'a'", "learning_rate"),
    ("preset", "learning_rate = 3e-4", "gamma = 2", "gamma"),
    ("preset", "learning_rate = 3e-4", "n_steps = 2.5", "n_steps"),
    ("preset", "learning_rate = 3e-4", f"n_steps = {HUGE_NUMBER}", ""),
    ("preset", "learning_rate = 3e-4", "n_steps = 1000000000000000", "n_steps"),
    ("preset", "learning_rate = 3e-4", "batch_size = 0", "batch_size"),
    ("preset", "learning_rate = 3e-4", "net_arch = [1000000000]", "net_arch"),
    ("preset", "learning_rate = 3e-4", "net_arch = ['a']", "net_arch"),
    ("preset", "learning_rate = 3e-4", "[table]\na = 1", "table"),
    ("study", "seeds = 2", f"seeds = {HUGE_NUMBER}", ""),
    ("study", "seeds = 2", "seeds = nan", "seeds"),
    ("study", "seeds = 2", "seeds = 1000000000000", "seeds"),
    ("study", "seeds = 2", f"seeds = {'[' * DEEP}", "nested"),
    ("study", "steps = 100", "steps = -1", "steps"),
    ("study", "steps = 100", "steps = true", "steps"),
    ("study", "steps = 100", "num_envs = 1000000000", "num_envs"),
    ("study", '"forecast"', '"../../x"', "arm"),
    ("study", '"forecast"', '"\\u001b[31m"', "arm"),
    ("study", "[scenarios", "[scenario", "scenario"),
    ("study", '"Mine"', "5", "title"),
]
"""Kind, what stands in the good file, what takes its place, and a part of the message."""


def lines() -> Iterator[Case]:
    """Yields texts with a line changed."""
    for kind, old, new, expected in LINES:

        def spoil(folder: Path, kind: str = kind, old: str = old, new: str = new) -> None:
            path = folder / KINDS[kind].file
            text = path.read_text()
            assert old in text, f"{kind}: no {old!r}"
            path.write_text(text.replace(old, new, 1))

        yield Case(kind, f"{old.strip()} → {new.strip()[:40]} ({len(new)})", spoil, expected)


# --- Weights, chunks, zips, pickles -----------------------------------------------------------------------------------


class Evil:
    """Leaves a file when it is unpickled."""

    def __reduce__(self) -> Any:
        """Returns what unpickling runs."""
        return Path.touch, (EXECUTED,)


def _header(path: Path) -> tuple[dict[str, Any], bytes]:
    content = path.read_bytes()
    (length,) = struct.unpack("<Q", content[:8])
    return json.loads(content[8 : 8 + length]), content[8 + length :]


def _weights(change: Callable[[dict[str, Any]], Any]) -> Spoil:
    def spoil(folder: Path) -> None:
        path = folder / "model.safetensors"
        header, data = _header(path)
        changed = change(header)
        text = json.dumps(header if changed is None else changed).encode()
        path.write_bytes(struct.pack("<Q", len(text)) + text + data)

    return spoil


def _first(header: dict[str, Any]) -> dict[str, Any]:
    return header[sorted(name for name in header if name != "__metadata__")[0]]


def _flipped(file: str, place: float) -> Spoil:
    def spoil(folder: Path) -> None:
        content = bytearray((folder / file).read_bytes())
        content[int(place * (len(content) - 1))] ^= 0x10
        (folder / file).write_bytes(bytes(content))

    return spoil


def _nan_weight(folder: Path) -> None:
    path = folder / "model.safetensors"
    path.write_bytes(path.read_bytes()[:-4] + struct.pack("<f", NAN))


def _half(file: str) -> Spoil:
    return lambda f: void((f / file).write_bytes((f / file).read_bytes()[: (f / file).stat().st_size // 2]))


def _state(change: Callable[[dict[str, Any]], Any]) -> Spoil:
    def spoil(folder: Path) -> None:
        import torch

        path = folder / "run" / "train_state.pt"
        state = torch.load(path, weights_only=True)
        changed = change(state)
        torch.save(state if changed is None else changed, path)

    return spoil


def _zip(name: str, content: str | bytes) -> Spoil:
    def spoil(folder: Path) -> None:
        path = folder / "policy.zip"
        with zipfile.ZipFile(path) as archive:
            kept = {entry: archive.read(entry) for entry in archive.namelist()}
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for entry, data in (kept | {name: content}).items():
                archive.writestr(entry, data)

    return spoil


def _note(change: Callable[[dict[str, Any]], Any]) -> Spoil:
    note = {"policy": {"forecaster": dict(PIN), "learners": [], "driver": "heuristic"}}
    changed = change(note["policy"])
    return _zip("note.json", json.dumps(note if changed is None else changed))


def _older_zarr(folder: Path) -> None:
    """Writes a group of Zarr's format 2, whose arrays can hold pickles."""
    import shutil

    data = folder / "data"
    attributes = json.loads((data / "zarr.json").read_text())["attributes"]
    shutil.rmtree(data)
    for name in ("states", "valid", "ids", "starts", "seeds"):
        (data / name).mkdir(parents=True)
        array = {
            "zarr_format": 2, "shape": [1], "chunks": [1], "dtype": "|O", "compressor": None, "fill_value": None,
            "order": "C", "filters": [{"id": "pickle", "protocol": 5}],
        }  # fmt: skip
        (data / name / ".zarray").write_text(json.dumps(array))
        (data / name / "0").write_bytes(pickle.dumps(Evil()))
    (data / ".zgroup").write_text('{"zarr_format": 2}')
    (data / ".zattrs").write_text(json.dumps(attributes))


def _chunk_link(folder: Path) -> None:
    (folder / "data/ids/c/0/0").unlink()
    (folder / "data/ids/c/0/0").symlink_to("/dev/zero")


def _set_key(*keys: Any, value: Any) -> Callable[[Any], None]:
    def change(content: Any) -> None:
        for key in keys[:-1]:
            content = content[key]
        content[keys[-1]] = value

    return change


def binaries() -> Iterator[Case]:
    """Yields damage to weights, chunks, policies and training states."""
    w, belongs = "weights", "do not belong together"
    yield Case(
        w,
        "header of 2**60 bytes",
        lambda f: void((f / "model.safetensors").write_bytes(b"\xff" * 7 + b"\x0f" + b"{}")),
        "safetensors",
    )
    yield Case(w, "empty", lambda f: void((f / "model.safetensors").write_bytes(b"")), "safetensors")
    yield Case(w, "half", _half("model.safetensors"), "safetensors")
    yield Case(w, "pickle", lambda f: void((f / "model.safetensors").write_bytes(pickle.dumps(Evil()))), "safetensors")
    yield Case(w, "NaN", _nan_weight, "not finite")
    yield Case(w, "no tensor", _weights(lambda h: {}), "")
    yield Case(w, "header a list", _weights(lambda h: []), "safetensors")
    yield Case(
        w,
        "deep header",
        lambda f: void((f / "model.safetensors").write_bytes(struct.pack("<Q", DEEP) + b"[" * DEEP)),
        "safetensors",
    )
    yield Case(w, "shape", _weights(lambda h: _first(h).update(shape=[1, 1])), "")
    yield Case(w, "huge shape", _weights(lambda h: _first(h).update(shape=[2**40, 2**20])), "")
    yield Case(w, "dtype float64", _weights(lambda h: _first(h).update(dtype="F64")), "")
    yield Case(w, "dtype int32", _weights(lambda h: _first(h).update(dtype="I32")), "I32")
    yield Case(w, "dtype uint32", _weights(lambda h: _first(h).update(dtype="U32")), "U32")
    yield Case(
        w,
        "renamed tensor",
        _weights(lambda h: {("x" if i == 0 else k): v for i, (k, v) in enumerate(h.items())}),
        belongs,
    )
    yield Case(
        w,
        "tensor named by 100,000 letters",
        _weights(lambda h: {("x" * 100_000 if i == 0 else k): v for i, (k, v) in enumerate(h.items())}),
        belongs,
    )
    yield Case(w, "offsets overlap", _weights(lambda h: _first(h).update(data_offsets=[0, 4])), "")
    for place in (0.2, 0.5, 0.8):
        yield Case("chunk", f"flipped bit at {place}", _flipped("data/states/c/0/0/0", place), "states")
    for array, chunk in (("valid", "c/0/0"), ("ids", "c/0/0"), ("starts", "c/0"), ("seeds", "c/0")):
        yield Case("store", f"flipped bit in {array}", _flipped(f"data/{array}/{chunk}", 0.6), array)
        yield Case("store", f"half a chunk of {array}", _half(f"data/{array}/{chunk}"), array)
        yield Case("store", f"missing chunk of {array}", lambda f, p=f"data/{array}/{chunk}": (f / p).unlink(), array)
    yield Case(
        "store",
        "flipped bit in a label",
        lambda f: _change(f / "data/zarr.json", "attributes.labels.0", _set_label),
        "checksum",
    )
    yield Case("store", "pickles in format 2", _older_zarr, "")
    yield Case("store", "chunk is a device", _chunk_link, "no regular file")
    yield Case(
        "store",
        "chunk is a fifo",
        lambda f: ((f / "data/ids/c/0/0").unlink(), os.mkfifo(f / "data/ids/c/0/0"))[1],
        "no regular file",
    )  # type: ignore[func-returns-value]
    yield Case(
        "store",
        "array metadata is a fifo",
        lambda f: ((f / "data/ids/zarr.json").unlink(), os.mkfifo(f / "data/ids/zarr.json"))[1],
        "no regular file",
    )  # type: ignore[func-returns-value]
    s = "training state"
    yield Case(s, "empty", lambda f: void((f / "run/train_state.pt").write_bytes(b"")), "train_state.pt")
    yield Case(s, "half", _half("run/train_state.pt"), "train_state.pt")
    yield Case(
        s, "pickle", lambda f: void((f / "run/train_state.pt").write_bytes(pickle.dumps(Evil()))), "train_state.pt"
    )
    yield Case(s, "a list", _state(lambda s: [1]), "train_state.pt")
    yield Case(s, "no model", _state(lambda s: void(s.pop("model"))), "model")
    yield Case(s, "model a number", _state(_set_key("model", value=5)), "model")
    yield Case(s, "optimizer a number", _state(_set_key("optimizer", value=5)), "optimizer")
    yield Case(s, "optimizer without groups", _state(_set_key("optimizer", "param_groups", value=[])), "one group")
    yield Case(
        s, "optimizer without moments", _state(_set_key("optimizer", "state", value={0: {"step": 1}})), "optimizer"
    )
    yield Case(s, "step a text", _state(_set_key("step", value="a")), "step")
    yield Case(s, "step negative", _state(_set_key("step", value=-5)), "step")
    yield Case(s, "step 2.5", _state(_set_key("step", value=2.5)), "step")
    yield Case(s, "best NaN", _state(_set_key("best", value=NAN)), "best")
    yield Case(s, "stale negative", _state(_set_key("stale", value=-5)), "stale")
    yield Case(
        s,
        "weights NaN",
        _state(lambda s: void([v.fill_(NAN) for v in s["model"].values() if v.is_floating_point()])),
        "finite",
    )
    t = "tuning study"
    yield Case(t, "zeros", lambda f: void((f / "tuning.db").write_bytes(b"\0" * 9000)), "tuning.db")
    yield Case(t, "letters", lambda f: void((f / "tuning.db").write_bytes(b"a" * 9000)), "tuning.db")
    yield Case(t, "half", _half("tuning.db"), "tuning.db")
    p = "policy"
    yield Case(p, "empty", lambda f: void((f / "policy.zip").write_bytes(b"")), "policy.zip")
    yield Case(p, "half", _half("policy.zip"), "policy.zip")
    yield Case(p, "data a list", _zip("data", "[]"), "policy.zip")
    yield Case(p, "data a number", _zip("data", "5"), "policy.zip")
    yield Case(p, "deep data", _zip("data", "[" * DEEP), "nested")
    yield Case(p, "bomb", _zip("data", b" " * (2**26 + 1)), "MiB")
    yield Case(p, "note a list", _zip("note.json", "[]"), "note")
    yield Case(p, "note no JSON", _zip("note.json", "{"), "note")
    yield Case(p, "note not UTF-8", _zip("note.json", b"\xff\xfe"), "note")
    yield Case(p, "deep note", _zip("note.json", "[" * DEEP), "nested")
    yield Case(p, "note with a long number", _zip("note.json", HUGE_NUMBER), "digits")
    yield Case(p, "note without driver", _note(lambda n: void(n.pop("driver"))), "driver")
    yield Case(p, "policy a list", _note(lambda n: {"policy": [1]}), "note")
    yield Case(p, "learners a text", _note(_set_key("learners", value="abc")), "learners")
    yield Case(p, "learners numbers", _note(_set_key("learners", value=[1])), "learners")
    yield Case(p, "driver a number", _note(_set_key("driver", value=5)), "driver")
    yield Case(p, "pin a list", _note(_set_key("forecaster", value=[])), "forecaster")
    yield Case(p, "pin without sha256", _note(lambda n: void(n["forecaster"].pop("sha256"))), "sha256")
    for name, bad in (("horizon_steps", "a"), ("horizon_steps", -1), ("num_samples", 0), ("max_agents", 10**12),
                      ("perception_m", "a"), ("sha256", 5), ("checkpoint", 5), ("arm", "moon"), ("layout", 5),
                      ("layout", {"a": 1}), ("num_plans", -1)):  # fmt: skip
        yield Case(p, f"pin {name} = {bad}", _note(_set_key("forecaster", name, value=bad)), name)


def _set_label(labels: Any, place: Any) -> None:
    labels[place] = "other"


CASES: list[Case] = [*any_file(), *values(), *lines(), *binaries()]
"""All cases."""
