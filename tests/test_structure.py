"""How the tree hangs together: who imports whom, and what no file may hold."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from importlinter.cli import lint_imports

ROOT = Path(__file__).resolve().parents[1]
LAYERS = ("predictor", "envs", "agents", "train_policy")
"""From the bottom up; each may import those before it."""
FOREIGN_TO_PREDICTOR = ("gymnasium", "pettingzoo", "stable_baselines3", "highway_env", "tqdm", "pygame")
ROOMS = ("predictor", "envs", "agents", "tests", "benchmarks", "docs", ".ci")
TEXT_SUFFIXES = {".py", ".md", ".toml", ".json", ".txt", ".yml", ".yaml", ".cfg", ""}


def sources() -> list[Path]:
    folders = [
        path for room in ("predictor", "envs", "agents", "benchmarks", "tests") for path in (ROOT / room).rglob("*.py")
    ]
    return sorted([*folders, *ROOT.glob("*.py")])


def texts() -> list[Path]:
    """Everything a clone holds that people read; runs, data and caches are not part of it."""
    inside = [path for room in ROOMS for path in (ROOT / room).rglob("*") if "__pycache__" not in path.parts]
    top = [path for path in ROOT.iterdir() if not path.name.startswith(".")]
    return sorted(path for path in [*inside, *top] if path.is_file() and path.suffix in TEXT_SUFFIXES)


def imported_modules(path: Path) -> Iterator[tuple[int, str]]:
    """Every absolute import of a file, also inside functions and under TYPE_CHECKING."""
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


def test_no_file_mentions_a_path_of_somebodys_machine():
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
