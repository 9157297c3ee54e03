"""Pinned packages, licences and bill of materials agree with what is installed and with pyproject.toml."""

from __future__ import annotations

import re
import sys
from collections import Counter

from packaging.utils import canonicalize_name

from tests.house.supply_chain import EXTRAS, ROOT, build_sbom, find_packages, get_licence, read_constraints

PYTHONS = ("3.11", "3.12", "3.13")


def pins_for(python: str) -> dict[str, str]:
    """Return the pinned version of each package for a Python version, on Linux with x86-64."""
    environment = {"python_version": python, "python_full_version": f"{python}.0", "sys_platform": "linux",
                   "platform_machine": "x86_64", "implementation_name": "cpython"}  # fmt: skip
    rows = [row for row, _ in read_constraints() if row.marker is None or row.marker.evaluate(environment)]
    names = Counter(canonicalize_name(row.name) for row in rows)
    assert max(names.values()) == 1, "one version of each package"
    return {canonicalize_name(row.name): str(row.specifier).removeprefix("==") for row in rows}


def test_constraints_pin_every_package_with_hashes_within_all_bounds() -> None:
    text = (ROOT / ".ci" / "constraints.txt").read_text(encoding="utf-8")
    assert "://" not in text, "no index"
    assert "--index" not in text
    assert len(read_constraints()) == len(re.findall(r"^\S+==", text, re.MULTILINE)), "each row is read, and has a hash"
    packages = find_packages(("test",))
    # uv gives a row a marker if only some versions of Python need the package.
    marked = {canonicalize_name(row.name) for row, _ in read_constraints() if row.marker is not None}
    for python in PYTHONS:
        pins = pins_for(python)
        unneeded = set() if sys.version.startswith(f"{python}.") else marked
        assert set(packages) - set(pins) - unneeded == set(), "packages without a version"
        assert {"hatchling", "editables"} <= set(pins), "the build"
        outside = [
            f"{name} {pins[name]}: {requirement}"
            for name, (_, requirements) in packages.items()
            for requirement in requirements * (name in pins)
            if not requirement.specifier.contains(pins[name], prereleases=True)
        ]
        assert outside == []


def test_the_test_command_installs_by_hash_only() -> None:
    command = (ROOT / "README.md").read_text(encoding="utf-8").partition("<!-- test command -->")[2].split("```")[1]
    installs = re.findall(r"pip install [^&\n]*", command)
    assert [("--require-hashes" in each, "--no-deps --no-build-isolation" in each) for each in installs] == [
        (True, False),
        (False, True),
    ]


def test_the_notice_names_every_installed_package_and_its_copyleft() -> None:
    text = (ROOT / "NOTICE").read_text(encoding="utf-8")
    above, _, listed = text.partition("Licences as stated")
    packages = find_packages(EXTRAS)
    names = {line.partition(":")[0] for line in listed.splitlines()[2:]}
    # A package that another version of a dependency no longer needs may still be listed.
    assert packages.keys() - names == set()
    licences = {name: get_licence(package) for name, (package, _) in packages.items()}
    assert [name for name, licence in licences.items() if licence == "not stated"] == []
    for name, licence in licences.items():
        if re.search("GPL|EPL|MPL|General Public|Eclipse|Mozilla", licence):
            assert re.search(rf"\b{name}\b", above), f"{name} is {licence}"


def test_the_bill_of_materials_has_the_required_fields() -> None:
    """Validated once with the schema of CycloneDX 1.6 (cyclonedx-python-lib); here its required fields and links."""
    document = build_sbom()
    assert {key: document[key] for key in ("bomFormat", "specVersion", "version")} == {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
    }
    assert document["metadata"]["component"]["type"] == "application"
    references = [row["bom-ref"] for row in document["components"]]
    assert len(set(references)) == len(references) == len(find_packages())
    for row in document["components"]:
        assert row["type"] == "library"
        assert row["purl"] == row["bom-ref"] == f"pkg:pypi/{row['name']}@{row['version']}"
        (licence,) = row["licenses"]
        assert licence.get("expression") or licence["license"]["name"]
    known = {*references, document["metadata"]["component"]["bom-ref"]}
    assert {each["ref"] for each in document["dependencies"]} == known
    assert {on for each in document["dependencies"] for on in each["dependsOn"]} <= known
