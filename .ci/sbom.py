"""Bill of materials and known weaknesses of the pinned packages: `python .ci/sbom.py`.

Writes CycloneDX 1.6 (JSON) from constraints.txt and the metadata of what is installed: name, version, licence, place,
and what needs what. Packages that are pinned and not installed here (other Python versions) have no licence. Then
compares the pins with `.ci/advisories.csv`; ends with status 1 if one is affected and `ACCEPTED` gives no reason.
Nothing is fetched: the check knows what its list knows (docs/security.md).
"""

import argparse
import csv
import hashlib
import json
import sys
import uuid
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.requirements import InvalidRequirement, Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).resolve().parents[1]
CONSTRAINTS, ADVISORIES = ROOT / "constraints.txt", ROOT / ".ci" / "advisories.csv"
NAMESPACE = uuid.UUID("6ba7b811-9dad-11d1-80b4-00c04fd430c8")
"""Namespace of URLs (RFC 9562): equal pins give an equal serial number."""
ACCEPTED: dict[tuple[str, str], str] = {
    ("ray", "CVE-2023-48022"): "a cluster runs what is submitted to it, by design: keep it in a trusted network "
    "(docs/security.md)",
}
"""Affected package and id → why its pin stays."""


class SbomError(Exception):
    """Raised if constraints.txt or the list of advisories cannot be understood."""


@dataclass(frozen=True)
class Pin:
    """Pinned package."""

    name: str
    """Name as PyPI normalises it."""
    version: str
    """Version."""
    marker: str
    """Where the pin holds; empty for everywhere."""

    @property
    def purl(self) -> str:
        """Package URL."""
        return f"pkg:pypi/{self.name}@{self.version}"


@dataclass(frozen=True)
class Advisory:
    """Known weakness of a package."""

    package: str
    """Name as PyPI normalises it."""
    name: str
    """Identifier: PYSEC, GHSA or CVE."""
    affected: tuple[SpecifierSet, ...]
    """Sets of versions that have it."""
    source: str
    """Where it was found."""

    def affects(self, version: str) -> bool:
        """Returns whether a version has it."""
        return any(part.contains(Version(version), prereleases=True) for part in self.affected)


def read_pins(path: Path = CONSTRAINTS) -> list[Pin]:
    """Reads the pins of constraints.txt.

    Raises:
        SbomError: a line is no pin "name==version".
    """
    pins = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        text = line.partition("#")[0].strip()
        if not text:
            continue
        try:
            parsed = Requirement(text)
            (part,) = parsed.specifier
        except (InvalidRequirement, ValueError) as error:
            raise SbomError(f"{path.name}:{number}: expected name==version, got '{text}'") from error
        if part.operator != "==" or "*" in part.version:
            raise SbomError(f"{path.name}:{number}: expected name==version, got '{text}'")
        pins.append(Pin(canonicalize_name(parsed.name), part.version, str(parsed.marker or "")))
    return pins


def read_advisories(path: Path = ADVISORIES) -> list[Advisory]:
    """Reads the list of advisories.

    Raises:
        SbomError: a line has no package, no identifier, no source, or versions that are none.
    """
    found = []
    with path.open(encoding="utf-8", newline="") as file:
        lines = csv.DictReader(file)
        if not {"package", "id", "cve", "affected", "source"} <= set(lines.fieldnames or ()):
            raise SbomError(
                f"{path.name}:1: expected the columns package, id, cve, affected, source, got {lines.fieldnames}"
            )
        for number, line in enumerate(lines, start=2):
            name = line["id"] or line["cve"]
            if not (line["package"] and name and line["affected"] and line["source"]):
                raise SbomError(f"{path.name}:{number}: expected package, id or cve, affected and source, got {line}")
            try:
                affected = tuple(SpecifierSet(part) for part in line["affected"].split(" || "))
            except ValueError as error:
                raise SbomError(f"{path.name}:{number}: {error}") from error
            found.append(Advisory(canonicalize_name(line["package"]), name, affected, line["source"]))
    return found


def weaknesses(pins: list[Pin], advisories: list[Advisory]) -> Iterator[tuple[Pin, Advisory]]:
    """Yields pins with the advisories that affect them."""
    for pin in pins:
        yield from ((pin, known) for known in advisories if known.package == pin.name and known.affects(pin.version))


def licences_of(found: Any) -> list[dict[str, Any]]:
    """Returns the licences in a package's metadata, as CycloneDX has them: an SPDX expression, or names."""
    given = found.get("License-Expression")
    if given:
        return [{"expression": given}]
    all_of = found.get_all("Classifier") or []
    names = [text.rpartition(" :: ")[2] for text in all_of if text.startswith("License :: ")]
    text = (found.get("License") or "").strip()
    if not names and text and "\n" not in text and len(text) < 80:
        names = [text]
    return [{"license": {"name": name}} for name in names]


def component_of(pin: Pin) -> dict[str, Any]:
    """Returns a component; licence, place and digest of the installed files only where this very version is installed.

    The digest is of RECORD, which lists the SHA-256 of every file: that of the downloaded archive is not kept by pip.
    """
    component: dict[str, Any] = {
        "type": "library", "bom-ref": f"{pin.purl}{f'#{pin.marker}' if pin.marker else ''}", "name": pin.name,
        "version": pin.version, "purl": pin.purl,
    }  # fmt: skip
    properties = [{"name": "python:marker", "value": pin.marker}] if pin.marker else []
    installed = _installed(pin)
    if installed is not None:
        about: Any = installed.metadata  # an email.message.Message
        if found := licences_of(about):
            component["licenses"] = found
        page = about.get("Home-page") or ""
        if page.startswith("http"):
            component["externalReferences"] = [{"type": "website", "url": page}]
        record = installed.read_text("RECORD")
        if record:
            digest = hashlib.sha256(record.encode()).hexdigest()
            properties.append({"name": "python:sha256-of-record", "value": digest})
    return component | ({"properties": properties} if properties else {})


def _installed(pin: Pin) -> metadata.Distribution | None:
    try:
        found = metadata.distribution(pin.name)
    except metadata.PackageNotFoundError:
        return None
    return found if Version(found.version).public == Version(pin.version).public else None


def _needs(pin: Pin, refs: Mapping[str, list[tuple[Pin, str]]]) -> list[str]:
    """Returns what a pin depends on; of several pins of one package, that of what is installed here."""
    installed = _installed(pin)
    wanted = [Requirement(text) for text in (installed.requires if installed else None) or []]
    here = [one for one in wanted if one.marker is None or one.marker.evaluate({"extra": ""})]
    found = [refs[name] for one in here if (name := canonicalize_name(one.name)) in refs]
    return sorted({ref for pins in found for other, ref in pins if len(pins) == 1 or _installed(other) is not None})


def bill_of(pins: list[Pin], version: str) -> dict[str, Any]:
    """Returns the bill of materials (CycloneDX 1.6).

    Args:
        pins: pinned packages.
        version: version of this project.
    """
    components = [component_of(pin) for pin in pins]
    refs: dict[str, list[tuple[Pin, str]]] = {}
    for pin, component in zip(pins, components, strict=True):
        refs.setdefault(pin.name, []).append((pin, component["bom-ref"]))
    top = {
        "type": "application", "bom-ref": "dgvae-rl", "name": "dgvae-rl", "version": version,
        "licenses": [{"license": {"id": "MIT"}}],
    }  # fmt: skip
    seed = "\n".join(component["bom-ref"] for component in components)
    depends = [
        {"ref": component["bom-ref"], "dependsOn": _needs(pin, refs)}
        for pin, component in zip(pins, components, strict=True)
    ]
    return {
        "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "serialNumber": f"urn:uuid:{uuid.uuid5(NAMESPACE, version + seed)}",
        "version": 1,
        "metadata": {"component": top, "tools": {"components": [{"type": "application", "name": ".ci/sbom.py"}]}},
        "components": components,
        "dependencies": [
            {"ref": "dgvae-rl", "dependsOn": sorted(component["bom-ref"] for component in components)},
            *depends,
        ],
    }


def main() -> int:
    """Runs the command; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "sbom.json", help="file of the bill")
    parser.add_argument("--only-check", action="store_true", help="write no bill")
    arguments = parser.parse_args()
    try:
        pins, advisories = read_pins(), read_advisories()
    except SbomError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if not arguments.only_check:
        try:
            version = metadata.version("dgvae-rl")
        except metadata.PackageNotFoundError:
            version = "0"
        bill = bill_of(pins, version)
        try:
            arguments.out.parent.mkdir(parents=True, exist_ok=True)
            arguments.out.write_text(json.dumps(bill, indent=1) + "\n", encoding="utf-8")
        except OSError as error:
            parser.error(f"--out cannot be written: {error}")
        licensed = sum("licenses" in component for component in bill["components"])
        print(f"{arguments.out}: {len(pins)} packages, {licensed} with a licence")
    bad = 0
    for pin, known in weaknesses(pins, advisories):
        reason = ACCEPTED.get((pin.name, known.name))
        bad += reason is None
        print(f"{pin.name} {pin.version} has {known.name} ({known.source}): {reason or 'raise the pin'}")
    print(f"{len(pins)} pins against {len(advisories)} advisories: {bad} to mend")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
