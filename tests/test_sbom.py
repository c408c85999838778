"""The bill of materials has what CycloneDX requires, and a pin that an advisory affects is found."""

import importlib.util
import json
import re
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
SPEC = importlib.util.spec_from_file_location("sbom", ROOT / ".ci" / "sbom.py")
assert SPEC is not None and SPEC.loader is not None
sbom: Any = importlib.util.module_from_spec(SPEC)
sys.modules["sbom"] = sbom
SPEC.loader.exec_module(sbom)


def test_the_bill_has_what_the_schema_requires():
    """CycloneDX 1.6: required fields, unique references, and no reference that leads nowhere."""
    pins = sbom.read_pins()
    bill = json.loads(json.dumps(sbom.bill_of(pins, "1.2.3")))
    assert bill["bomFormat"] == "CycloneDX" and bill["specVersion"] == "1.6" and bill["version"] == 1
    assert re.fullmatch(r"urn:uuid:[0-9a-f]{8}-([0-9a-f]{4}-){3}[0-9a-f]{12}", bill["serialNumber"])
    assert {"type", "name", "version", "bom-ref"} <= set(bill["metadata"]["component"])
    components = bill["components"]
    assert len(components) == len(pins) > 100
    for component in components:
        assert component["type"] == "library" and component["name"] and component["version"]
        assert component["purl"] == f"pkg:pypi/{component['name']}@{component['version']}"
        for licence in component.get("licenses", []):
            assert set(licence) == {"expression"} or set(licence["license"]) == {"name"}
        for found in component.get("properties", []):
            assert found["name"] in ("python:marker", "python:sha256-of-record") and found["value"]
    refs = [component["bom-ref"] for component in components]
    assert len(set(refs)) == len(refs)
    known = {"dgvae-rl", *refs}
    assert all({one["ref"], *one["dependsOn"]} <= known for one in bill["dependencies"])
    assert len({one["ref"] for one in bill["dependencies"]}) == len(bill["dependencies"]) == len(known)


def test_what_is_installed_here_has_licences_and_needs():
    bill = sbom.bill_of(sbom.read_pins(), "1")
    by_name = {component["name"]: component for component in bill["components"]}
    needs = {one["ref"]: one["dependsOn"] for one in bill["dependencies"]}
    assert by_name["pytest"]["licenses"] == [{"expression": "MIT"}]
    assert by_name["pluggy"]["bom-ref"] in needs[by_name["pytest"]["bom-ref"]]
    assert sum("licenses" in component for component in by_name.values()) > 60


def test_each_release_of_a_package_with_several_is_a_part_and_the_installed_one_is_needed():
    pins = sbom.read_pins()
    bill = sbom.bill_of(pins, "1")
    top, *others = bill["dependencies"]
    assert top["dependsOn"] == sorted(component["bom-ref"] for component in bill["components"])
    several = {pin.name for pin in pins if sum(other.name == pin.name for other in pins) > 1}
    here = {c["bom-ref"] for pin, c in zip(pins, bill["components"], strict=True) if sbom._installed(pin) is not None}
    refs = {c["bom-ref"] for pin, c in zip(pins, bill["components"], strict=True) if pin.name in several}
    needed = {ref for one in others for ref in one["dependsOn"]} & refs
    assert several and needed <= here


@pytest.mark.slow
def test_equal_pins_give_an_equal_bill():
    pins = sbom.read_pins()
    assert sbom.bill_of(pins, "1") == sbom.bill_of(pins, "1")
    assert sbom.bill_of(pins, "1")["serialNumber"] != sbom.bill_of(pins[1:], "1")["serialNumber"]


def test_no_pin_is_affected_without_a_reason():
    found = list(sbom.weaknesses(sbom.read_pins(), sbom.read_advisories()))
    assert [(pin, known.name) for pin, known in found if (pin.name, known.name) not in sbom.ACCEPTED] == []


def test_reasons_are_of_advisories_in_the_list():
    listed = {(known.package, known.name) for known in sbom.read_advisories()}
    assert set(sbom.ACCEPTED) <= listed


def test_every_advisory_has_a_kind_of_id_and_a_source():
    known = sbom.read_advisories()
    assert len(known) > 150
    assert all(re.fullmatch(r"(PYSEC-\d{4}-\d+|CVE-\d{4}-\d+|GHSA(-[0-9a-z]{4}){3})", one.name) for one in known)
    assert len({(one.package, one.name) for one in known}) == len(known)


@pytest.mark.parametrize(
    ("version", "affected"),
    [("11.2.0", False), ("11.2.1", True), ("12.1.9", True), ("12.2.0", False)],
)
def test_ranges_hold_at_their_ends(version: str, affected: bool, tmp_path: Path):
    (tmp_path / "list.csv").write_text('package,id,cve,affected,source\nPillow,PYSEC-1,,">=11.2.1,<12.2.0",here\n')
    (known,) = sbom.read_advisories(tmp_path / "list.csv")
    assert known.package == "pillow" and known.affects(version) == affected


def test_an_affected_pin_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "constraints.txt").write_text("# pins\npillow==11.3.0\nray==2.60.0; python_version < '3.14'\n")
    monkeypatch.setattr(sbom.read_pins, "__defaults__", (tmp_path / "constraints.txt",))
    monkeypatch.setattr(sys, "argv", ["sbom.py", "--only-check"])
    assert sbom.main() == 1
    said = capsys.readouterr().out
    assert "pillow 11.3.0 has PYSEC-2026-2251 (osv.dev PYSEC-2026-2251): raise the pin" in said
    assert "ray 2.60.0 has CVE-2023-48022" in said and "trusted network" in said


@pytest.mark.parametrize("line", ["pillow>=11", "pillow", "pillow==11.*", "== 3", "a b"])
def test_what_is_no_pin_is_refused(line: str, tmp_path: Path):
    (tmp_path / "constraints.txt").write_text(f"{line}\n")
    with pytest.raises(sbom.SbomError, match=r"constraints.txt:1: expected name==version"):
        sbom.read_pins(tmp_path / "constraints.txt")


@pytest.mark.parametrize(
    "line", ["pillow,,,<1,here", "pillow,CVE-1,,,here", "pillow,CVE-1,,<1,", "p,CVE-1,,nonsense,x"]
)
def test_a_broken_list_is_refused(line: str, tmp_path: Path):
    (tmp_path / "list.csv").write_text(f"package,id,cve,affected,source\n{line}\n")
    with pytest.raises(sbom.SbomError, match=r"list.csv:2"):
        sbom.read_advisories(tmp_path / "list.csv")


@pytest.mark.parametrize("text", ["", "name,id,cve,affected,source\npillow,CVE-1,,<1,here\n"])
def test_a_list_of_other_columns_is_no_list_without_advisories(text: str, tmp_path: Path):
    (tmp_path / "list.csv").write_text(text)
    with pytest.raises(sbom.SbomError, match="list.csv:1: expected the columns package, id, cve, affected, source"):
        sbom.read_advisories(tmp_path / "list.csv")


def test_the_command_writes_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "argv", ["sbom.py", "--out", str(tmp_path / "new" / "sbom.json")])
    assert sbom.main() == 0
    assert json.loads((tmp_path / "new" / "sbom.json").read_text())["bomFormat"] == "CycloneDX"


def test_a_bill_that_cannot_be_written_is_one_clear_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(sys, "argv", ["sbom.py", "--out", str(tmp_path)])
    with pytest.raises(SystemExit) as ended:
        sbom.main()
    assert ended.value.code == 2 and "error: --out cannot be written: " in capsys.readouterr().err
