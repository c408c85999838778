"""Which optional packages are here."""

import importlib.util


def missing(*modules: str) -> str:
    """Says "needs …" with the modules that are absent; empty if none is."""
    absent = []
    for module in modules:
        try:
            found = importlib.util.find_spec(module) is not None
        except (ImportError, ValueError):  # a parent package that is absent, or a module that a test blanked out
            found = False
        if not found:
            absent.append(module)
    return f"needs {', '.join(absent)}" if absent else ""
