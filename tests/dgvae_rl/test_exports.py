"""`dgvae_rl` has what the three packages export, under one name, and type checkers see it."""

import ast
import importlib
import tomllib
from pathlib import Path

import pytest

import dgvae_rl

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("agents", "envs", "predictor")


@pytest.mark.parametrize("package", PACKAGES)
def test_it_exports_what_a_package_exports(package: str):
    listed = {name for name, of in dgvae_rl.PACKAGE_OF.items() if of == package}
    assert listed == set(importlib.import_module(package).__all__)


def test_each_name_is_that_of_its_package():
    for name, package in dgvae_rl.PACKAGE_OF.items():
        assert getattr(dgvae_rl, name) is getattr(importlib.import_module(package), name)
    with pytest.raises(AttributeError, match="module 'dgvae_rl' has no attribute 'Forcaster'"):
        _ = dgvae_rl.Forcaster


def test_type_checkers_see_the_same_names():
    tree = ast.parse((ROOT / "dgvae_rl" / "__init__.py").read_text())
    (block,) = [node for node in tree.body if isinstance(node, ast.If)]
    names = [(node.module, name) for node in block.body if isinstance(node, ast.ImportFrom) for name in node.names]
    assert all(name.asname == name.name for _, name in names)  # without it, mypy --strict has no export
    seen = {name.name: module for module, name in names}
    assert seen == dgvae_rl.PACKAGE_OF
    assert set(dgvae_rl.__all__) == {*dgvae_rl.PACKAGE_OF, "__version__"}


def test_every_package_is_typed_and_in_the_wheel():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    shipped, found = project["tool"]["setuptools"]["package-data"], project["tool"]["setuptools"]["packages"]["find"]
    for package in (*PACKAGES, "dgvae_rl"):
        assert (ROOT / package / "py.typed").is_file() and "py.typed" in shipped[package]
        assert package in found["include"]
    assert project["project"]["scripts"] == {"dgvae": "dgvae_rl.command:main"}


def test_the_version_is_that_of_the_metadata():
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert dgvae_rl.__version__ in (stated, "not installed")
    assert f"version: {stated}" in (ROOT / "CITATION.cff").read_text()


def test_checks_are_those_of_the_packages():
    from dgvae_rl import testing
    from envs.testing import check_reader
    from predictor.testing import check_forecaster

    assert testing.check_reader is check_reader and testing.check_forecaster is check_forecaster
    assert set(testing.__all__) == set(testing.PACKAGE_OF)
    with pytest.raises(AttributeError, match="module 'dgvae_rl.testing' has no attribute 'check_env'"):
        _ = testing.check_env  # type: ignore[attr-defined]
