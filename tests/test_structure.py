"""Imports between modules, and what no file may hold."""

import ast
import graphlib
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import pytest
from importlinter.cli import lint_imports

ROOT = Path(__file__).resolve().parents[1]
LAYERS = ("predictor", "envs", "agents", "train_policy", "dgvae_rl")
"""Layers from the bottom up; each may import those before it."""
FOREIGN_TO_PREDICTOR = ("gymnasium", "pettingzoo", "stable_baselines3", "highway_env", "tqdm", "pygame")
ROOMS = ("predictor", "envs", "agents", "dgvae_rl", "tests", "benchmarks", "docs", ".ci")
MAX_LINES = 400
"""Largest number of lines of a module; longer ones are split."""
TEXT_SUFFIXES = {".py", ".md", ".toml", ".json", ".txt", ".yml", ".yaml", ".cfg", ""}


def sources() -> list[Path]:
    rooms = ("predictor", "envs", "agents", "dgvae_rl", "benchmarks", "tests")
    folders = [path for room in rooms for path in (ROOT / room).rglob("*.py")]
    return sorted([*folders, *ROOT.glob("*.py")])


def texts() -> list[Path]:
    """Returns all texts of a clone; runs, data and caches are not part of it."""
    inside = [path for room in ROOMS for path in (ROOT / room).rglob("*") if "__pycache__" not in path.parts]
    top = [path for path in ROOT.iterdir() if not path.name.startswith(".")]
    found = [path for path in [*inside, *top] if path.is_file() and path.suffix in TEXT_SUFFIXES]
    return sorted(path for path in found if path.suffix or "golden" not in path.parts)  # chunks of stores are no texts


def imported_modules(path: Path) -> Iterator[tuple[int, str]]:
    """Yields all absolute imports of a file, also inside functions and under TYPE_CHECKING."""
    for node in ast.walk(ast.parse(path.read_text(), str(path))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: relative import"
            yield node.lineno, node.module or ""


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("layer", LAYERS)
def test_no_layer_imports_a_higher_one(layer: str):
    forbidden = set(LAYERS[LAYERS.index(layer) + 1 :])
    if layer == "predictor":
        forbidden |= set(FOREIGN_TO_PREDICTOR)
    files = [path for path in sources() if relative(path).split("/")[0].removesuffix(".py") == layer]
    assert files
    found = [
        f"{relative(path)}:{line}: {module}"
        for path in files
        for line, module in imported_modules(path)
        if module.split(".")[0] in forbidden
    ]
    assert found == []


def test_import_contracts_hold(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture):
    monkeypatch.chdir(ROOT)
    monkeypatch.syspath_prepend(ROOT)
    status = lint_imports(config_filename="pyproject.toml", no_cache=True, no_logo=True)
    assert status == 0, capsys.readouterr().out


def module_name(path: Path, root: Path = ROOT) -> str:
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports_within(path: Path, known: Mapping[str, Path]) -> Iterator[str]:
    """Yields the modules of `known` that a file imports, also in functions, under TYPE_CHECKING, by import_module."""
    for node in ast.walk(ast.parse(path.read_text(), str(path))):
        if isinstance(node, ast.Import):
            named = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            inner = [f"{node.module}.{alias.name}" for alias in node.names]
            named = [name if name in known else str(node.module) for name in inner]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
            named = [node.args[0].value] if isinstance(node.args[0], ast.Constant) else []
        else:
            continue
        yield from (name for name in named if name in known)


def import_cycle(paths: Sequence[Path], root: Path = ROOT) -> list[str]:
    """Returns modules that import each other in a circle, the first one repeated at the end; empty if none do."""
    known = {module_name(path, root): path for path in paths}
    arrows = {name: set(imports_within(path, known)) - {name} for name, path in known.items()}
    try:
        graphlib.TopologicalSorter(arrows).prepare()
    except graphlib.CycleError as error:
        return list(error.args[1])
    return []


def test_no_modules_import_each_other_in_a_circle():
    """Lazy imports included: a function that imports its importer cannot be read, moved or copied without it."""
    own = [path for path in sources() if relative(path).split("/")[0] != "tests"]
    assert len(own) > 100
    assert import_cycle(own) == []


@pytest.mark.parametrize(
    "back",
    [
        "import room.first",
        "from room import first",
        "def later():\n    from room.first import NAME",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from room.first import NAME",
        "import importlib\nname = importlib.import_module('room.first')",
    ],
    ids=["import", "from-package", "in-a-function", "type-checking", "import-module"],
)
def test_a_circle_is_found_however_it_is_closed(tmp_path: Path, back: str):
    (tmp_path / "room").mkdir()
    files = {name: tmp_path / "room" / f"{name}.py" for name in ("__init__", "first", "second")}
    files["__init__"].write_text("")
    files["first"].write_text("from room.second import other\nNAME = 1\n")
    files["second"].write_text("other = 2\n")
    assert import_cycle(list(files.values()), tmp_path) == []
    files["second"].write_text(f"other = 2\n{back}\n")
    assert set(import_cycle(list(files.values()), tmp_path)) == {"room.first", "room.second"}


def test_no_module_is_longer_than_four_hundred_lines():
    own = [path for path in sources() if relative(path).split("/")[0] != "tests"]
    lines = {relative(path): len(path.read_text().splitlines()) for path in own}
    assert max(lines.values()) > 100
    assert {name: count for name, count in lines.items() if count > MAX_LINES} == {}


def test_no_file_hides_a_module_of_the_standard_library():
    """`python folder/file.py` puts the folder first on the path: its `profile.py` is imported instead of Python's."""
    files = [*sources(), *(ROOT / "docs").rglob("*.py"), *(ROOT / ".ci").rglob("*.py")]
    assert [relative(path) for path in files if path.stem in sys.stdlib_module_names] == []


def test_no_module_edits_the_search_path():
    """Commands are run as `python -m package.module` from the root; `dgvae` finds what they find."""
    own = [path for path in sources() if relative(path).split("/")[0] not in ("tests", "benchmarks")]
    own += [path for path in (ROOT / "benchmarks").glob("*.py") if path.name != "reference.py"]  # imports a checkout
    editing = [relative(path) for path in own if re.search(r"\bsys\.path\b", path.read_text())]
    assert editing == ["dgvae_rl/command.py"]


def test_predictor_runs_where_there_is_no_simulator():
    """A bare GPU box has torch, NumPy and the data packages; nothing else may be imported, by no module of the room."""
    code = f"""
import importlib, pkgutil, sys
for name in {FOREIGN_TO_PREDICTOR!r}:
    sys.modules[name] = None  # importing it raises ImportError
import predictor
names = [m.name for m in pkgutil.walk_packages(predictor.__path__, "predictor.")]
for name in names:
    importlib.import_module(name)
print(len(names))
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 15


def test_torch_never_unpickles():
    calls = [
        (path, node)
        for path in sources()
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "torch.load"
    ]
    unsafe = [
        f"{relative(path)}:{node.lineno}"
        for path, node in calls
        if not any(
            keyword.arg == "weights_only" and isinstance(keyword.value, ast.Constant) and keyword.value.value is True
            for keyword in node.keywords
        )
    ]
    assert unsafe == []


def test_no_file_mentions_a_path_of_one_machine():
    """Also not in the provenance of shipped checkpoints: their commands must run on any machine."""
    homes = tuple("/" + name + "/" for name in ("work", "home", "root", "Users", "tmp", "mnt"))
    files = texts()
    assert ROOT / "pyproject.toml" in files
    found = [
        f"{relative(path)}:{number}: {line.strip()[:100]}"
        for path in files
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
        if any(home in line for home in homes)
    ]
    assert found == []


UNCLEAR_BEGINNINGS = ("Of ", "The same", "Likewise")
"""A docstring begins with a verb or a noun that says what this is; these say it of something that stands elsewhere."""


def docstrings(path: Path) -> Iterator[tuple[int, str]]:
    """Line and text of every docstring of a file: of modules, classes, functions, and below fields and constants."""
    for node in ast.walk(ast.parse(path.read_text(), str(path))):
        if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        fields = zip(node.body, node.body[1:], strict=False)
        below = [text for field, text in fields if isinstance(field, ast.Assign | ast.AnnAssign)]
        for text in (*node.body[:1], *below):
            if (
                isinstance(text, ast.Expr)
                and isinstance(text.value, ast.Constant)
                and isinstance(text.value.value, str)
            ):
                yield text.lineno, text.value.value.strip()


def test_docstrings_begin_with_what_they_describe():
    """`--seed  Of the drawn windows` is a line of --help that says nothing; "Random seed for …" does."""
    own = [path for path in sources() if relative(path).split("/")[0] != "tests"]
    found = [
        f"{relative(path)}:{line}: {text.splitlines()[0][:80]}"
        for path in own
        for line, text in docstrings(path)
        if text.startswith(UNCLEAR_BEGINNINGS)
    ]
    assert sum(1 for path in own for _ in docstrings(path)) > 1000
    assert found == []
