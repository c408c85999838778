"""What the README's section "Install" and CONTRIBUTING.md say is what the files say."""

import re
import subprocess
import tomllib
from pathlib import Path

from dgvae_rl.command import COMMANDS

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
INSTALL = (ROOT / "README.md").read_text().split("## Install\n")[1].split("\n## ")[0]


def requirements(extra: str) -> set[str]:
    """Names of all packages that an extra brings, those of the extras in it included."""
    found: set[str] = set()
    for line in PROJECT["optional-dependencies"][extra]:
        inner = re.match(r"dgvae-rl\[([\w,]+)\]", line)
        names = [requirements(name) for name in inner[1].split(",")] if inner else [{re.split(r"[<>=]", line)[0]}]
        found |= set().union(*names)
    return found


def test_every_extra_is_in_the_table():
    rows = dict(re.findall(r"^\| `?(\w+)`? \| (.*) \|$", INSTALL, re.MULTILINE))
    assert set(rows) - {"none", "extra"} == set(PROJECT["optional-dependencies"]) - {"dev", "docs", "fuzz", "training"}
    assert "0.7 GB" in rows["envpool"] and "but EnvPool" in rows["all"]
    assert requirements("all") == set().union(
        *(requirements(name) for name in rows if name not in ("none", "extra", "all", "envpool", "ray"))
    )
    for outer, inner in (("rl", "envs"), ("study", "rl"), ("contrib", "rl"), ("tune", "rl"), ("envpool", "rl")):
        assert f"`{inner}`" in rows[outer] and requirements(inner) < requirements(outer)


def test_training_installs_no_envpool():
    def planned(target: str) -> str:
        done = subprocess.run(
            ["make", "--dry-run", "--always-make", target], cwd=ROOT, capture_output=True, text=True, check=True
        )
        return done.stdout

    assert "envpool" not in planned("train") and "-e '.[all]'" in planned("train")
    assert "envpool" not in planned("docs") and "-e '.[all,docs]'" in planned("docs")
    assert "envpool" in planned("test")


def test_the_wheel_has_the_version_of_the_project():
    assert f"dgvae_rl-{PROJECT['version']}-py3-none-any.whl" in INSTALL


def test_every_command_that_is_named_is_there():
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]
    named = {word for page in pages for word in re.findall(r"`dgvae ([a-z]\S*?)[` ]", page.read_text())}
    assert {"train-policy", "collect", "watch"} <= named <= set(COMMANDS)
