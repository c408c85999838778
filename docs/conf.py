"""Settings of the site that `make docs` builds with Sphinx.

The source folder is the root of the repository: a link leads to the same file on a page of the site and in a checkout.
"""

import os
import re
import sys
import urllib.request
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
INVENTORY_S = 3.0
"""Longest time that is waited for another project's list of names [s]."""
PROJECTS = {
    "python": "https://docs.python.org/3/",
    "numpy": "https://numpy.org/doc/stable/",
    "torch": "https://docs.pytorch.org/docs/stable/",
    "gymnasium": "https://gymnasium.farama.org/",
    "pettingzoo": "https://pettingzoo.farama.org/",
    "stable_baselines3": "https://stable-baselines3.readthedocs.io/en/master/",
}
"""Projects to whose pages names of the reference link, where those can be reached during the build."""

# Executed pages run the code of this tree, with the programs of this environment, on one thread.
sys.path.insert(0, str(ROOT))
os.environ |= {
    "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "docs" / "examples")]),
    "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")]),
    "PYTHONWARNINGS": "ignore",
    "OMP_NUM_THREADS": "1",
    "TTY_COMPATIBLE": "0",  # tables without escape sequences
    "COLUMNS": "110",
    "PYDEVD_DISABLE_FILE_VALIDATION": "1",
}

project = "dgvae-rl"
author = "dgvae-rl contributors"
project_copyright = "dgvae-rl contributors, MIT licence"
root_doc = "docs/index"
include_patterns = ["docs/**", "CHANGELOG.md", "CONTRIBUTING.md", "predictor/pretrained/*/README.md"]
exclude_patterns = [".*", "build", "data", "dist", "runs", "**/__pycache__"]
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.intersphinx", "sphinx.ext.viewcode"]

html_theme = "furo"
html_title = "dgvae-rl"
html_extra_path = ["site_root"]
html_static_path = ["site_static"]
html_css_files = ["site.css"]

myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 4
nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_show_tb = True
nb_execution_timeout = 170
nb_output_stderr = "remove"
nb_merge_streams = True
nb_render_markdown_format = "gfm"

autodoc_member_order = "bysource"
autodoc_mock_imports = ["envpool"]
default_role = "literal"


def reachable(projects: dict[str, str]) -> dict[str, tuple[str, None]]:
    """Returns the projects whose inventory can be fetched now; Sphinx would warn of the others."""
    found: dict[str, tuple[str, None]] = {}
    for name, url in projects.items():
        try:
            with urllib.request.urlopen(f"{url}objects.inv", timeout=INVENTORY_S) as answer:
                if answer.read(10) == b"# Sphinx i":
                    found[name] = (url, None)
        except (OSError, ValueError):
            continue
    return found


intersphinx_mapping = reachable(PROJECTS)


def separate_spans(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Makes `Name`s readable for Sphinx, for which a letter may not follow a code span."""
    lines[:] = [re.sub(r"(`[^`]+`)(\w?)", lambda m: m[1] + (f"\\ {m[2]}" if m[2] else ""), line) for line in lines]


def setup(app: Any) -> None:
    """Registers the change of docstrings; has kernels encrypt their sockets; says what was left out."""
    from jupyter_client.manager import KernelManager  # of the extra docs: a build has it, a test of this file may not

    KernelManager.transport_encryption.default_value = "auto"
    app.connect("autodoc-process-docstring", separate_spans)
    missing = sorted(set(PROJECTS) - set(intersphinx_mapping))
    if missing:
        print(f"no links into the pages of {', '.join(missing)}: they cannot be reached from here")
