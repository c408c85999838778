"""Finds out which optional packages are installed."""

import importlib.util


def missing(*modules: str) -> str:
    """Returns "needs …" with the modules that are not installed, or an empty string if all are."""
    absent = []
    for module in modules:
        try:
            found = importlib.util.find_spec(module) is not None
        except (ImportError, ValueError):  # the parent package is absent, or a test has blanked the module out
            found = False
        if not found:
            absent.append(module)
    return f"needs {', '.join(absent)}" if absent else ""
