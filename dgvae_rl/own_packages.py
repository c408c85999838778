"""Makes `dgvae_rl.envs`, `dgvae_rl.predictor`, `dgvae_rl.agents` importable, also where a user's folders hide ours.

Python knows a module by its name alone: where a working folder has a package `envs` of its own, `import envs` gives
that one, to our modules too. Two cases:

* `envs`, `predictor` and `agents` are ours: `dgvae_rl.envs.readers` is another name for the module `envs.readers`.
* One of them is someone else's: our modules are loaded once more, under the names `dgvae_rl.envs` and so on, and what
  they import from each other is looked up there. The user's `import envs` goes on to give the user's. Names
  that the user does not have lead to ours (`agents`, or `envs.readers`): trained policies name their classes so.

Which case it is, is decided at the first import from here. In the second one our modules get an `__import__` of their
own through `__builtins__`, which CPython honours; source and byte code are the same files.
"""

import builtins
import importlib
import importlib.util
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

OWN = ("agents", "envs", "predictor", "train_policy")
"""Modules at the top of this project that are found below `dgvae_rl`, too."""
HERE = __name__.partition(".")[0]
HOME = Path(__file__).resolve().parents[1]
"""Folder that holds them."""


def is_ours(name: str) -> bool:
    """Returns whether `import name` gives this project's package of that name; does not import it."""
    if name in sys.modules:
        origin = getattr(sys.modules[name], "__file__", None)
    else:
        spec = importlib.util.find_spec(name)
        origin = None if spec is None else spec.origin
    return origin is not None and Path(origin).resolve() in (HOME / name / "__init__.py", HOME / f"{name}.py")


def install_finder() -> None:
    """Puts the finder of our packages before all others; once, however often it is called."""
    if not any(isinstance(finder, OwnFinder) for finder in sys.meta_path):
        sys.meta_path.insert(0, OwnFinder())


class OwnFinder(MetaPathFinder):
    """Finds `dgvae_rl.envs` and the like.

    Attributes:
        hidden: names of `OWN` that are someone else's; None before the first import.
    """

    def __init__(self) -> None:
        """Decides nothing yet: the user's folders may still come onto the search path."""
        self.hidden: tuple[str, ...] | None = None
        self._ours_first = False

    @contextmanager
    def ours_first(self) -> Iterator[None]:
        """Gives our modules the names of a checkout, the user's aside: pickles of policies name our classes so."""
        hidden = self.hidden or ()
        users = {name: sys.modules.pop(name) for name in list(sys.modules) if name.partition(".")[0] in hidden}
        self._ours_first = True
        try:
            yield
        finally:
            self._ours_first = False
            for name in [name for name in sys.modules if name.partition(".")[0] in hidden]:
                del sys.modules[name]
            sys.modules.update(users)

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Returns how to load one of our modules; None for any other."""
        first, _, rest = fullname.partition(".")
        if first == HERE and rest.partition(".")[0] in OWN:
            if self.hidden is None:
                self._decide()
            if not self.hidden:
                return importlib.util.spec_from_loader(fullname, _Alias(rest))
            source = _source_of(rest)
            if source is None:
                return None
            return importlib.util.spec_from_file_location(fullname, source, loader=_SecondCopy(fullname, source))
        if self.hidden and first in OWN and not self._users(first, fullname, path) and _source_of(fullname):
            return importlib.util.spec_from_loader(fullname, _Alias(f"{HERE}.{fullname}"))
        return None

    def _users(self, first: str, fullname: str, path: Sequence[str] | None) -> bool:
        """Returns whether a module is the user's: their package, or a module that is in its folder."""
        assert self.hidden is not None
        if self._ours_first:
            return False
        return first in self.hidden and (first == fullname or PathFinder.find_spec(fullname, path) is not None)

    def _decide(self) -> None:
        self.hidden = ()  # the questions below pass by this finder
        self.hidden = tuple(name for name in OWN if not is_ours(name))


class _Alias(Loader):
    """Gives a module a second name."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._spec: ModuleSpec | None = None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        module = importlib.import_module(self._name)
        self._spec = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self._spec  # the import system has replaced it by the second name's

    def get_code(self, fullname: str) -> CodeType | None:
        """Returns the module's code, for `python -m`."""
        found = importlib.util.find_spec(self._name)
        loader: Any = None if found is None else found.loader
        code: CodeType | None = None if loader is None else loader.get_code(self._name)
        return code


class _SecondCopy(SourceFileLoader):
    """Loads one of our modules under its name below `dgvae_rl`; its imports of our modules stay there."""

    def exec_module(self, module: ModuleType) -> None:
        module.__dict__["__builtins__"] = vars(builtins) | {"__import__": _import_own}
        super().exec_module(module)


def _source_of(name: str) -> str | None:
    """Returns the path of one of our modules; None if there is none of this name."""
    place = HOME.joinpath(*name.split("."))
    files = (place / "__init__.py", place.parent / f"{place.name}.py")
    return next((str(file) for file in files if file.is_file()), None)


def _import_own(
    name: str,
    globals: Mapping[str, Any] | None = None,
    locals: Mapping[str, Any] | None = None,
    fromlist: Sequence[str] | None = (),
    level: int = 0,
) -> ModuleType:
    """Imports like `__import__`, our own modules from below `dgvae_rl`."""
    first = name.partition(".")[0]
    if level or first not in OWN:
        return builtins.__import__(name, globals, locals, fromlist or (), level)
    if fromlist:
        return builtins.__import__(f"{HERE}.{name}", globals, locals, fromlist)
    importlib.import_module(f"{HERE}.{name}")
    return sys.modules[f"{HERE}.{first}"]
