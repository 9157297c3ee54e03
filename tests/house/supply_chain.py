"""Packages that are installed with the product, from the metadata of the installed ones.

`python -m tests.house.supply_chain sbom` prints a software bill of materials (CycloneDX 1.6, JSON), and
`python -m tests.house.supply_chain notice` the list of licences in NOTICE.
"""

from __future__ import annotations

import json
import re
import sys
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
PRODUCT = "rotor-stator-rig"
EXTRAS = ("full", "formats", "campaigns")
"""Extras of users; `test` and `peers` are for developers."""
_CLASSIFIER = "License :: OSI Approved :: "


def find_packages(extras: tuple[str, ...] = EXTRAS) -> dict[str, tuple[Distribution, list[Requirement]]]:
    """Return the installed packages that the product needs, each with the requirements of other packages on it."""
    found: dict[str, tuple[Distribution, list[Requirement]]] = {}
    waiting, seen = [Requirement(f"{PRODUCT}[{','.join(extras)}]")], set()
    while waiting:
        requirement = waiting.pop()
        name, needs = canonicalize_name(requirement.name), ("", *sorted(requirement.extras))
        try:
            package, requirements = found.setdefault(name, (distribution(name), []))
        except PackageNotFoundError:
            raise SystemExit(f"{name} is not installed: pip install -e '.[test]'") from None
        requirements.append(requirement)
        if (name, needs) not in seen:
            seen.add((name, needs))
            waiting += [
                each
                for each in map(Requirement, package.requires or ())
                if each.marker is None or any(each.marker.evaluate({"extra": extra}) for extra in needs)
            ]
    del found[PRODUCT]
    return dict(sorted(found.items()))


def get_licence(package: Distribution) -> str:
    """Return the licence that a package states, as an SPDX expression where it has one."""
    texts = package.metadata.get_all("Classifier") or []
    classified = [text.removeprefix(_CLASSIFIER) for text in texts if text.startswith(_CLASSIFIER)]
    stated = (package.metadata.get("License") or "").strip()
    in_words = stated if "\n" not in stated and len(stated) < 60 else ""
    return package.metadata.get("License-Expression") or ", ".join(classified) or in_words or "not stated"


def build_sbom() -> dict[str, Any]:
    """Return the bill of materials."""
    packages = find_packages()

    def component(package: Distribution, kind: str) -> dict[str, Any]:
        name = canonicalize_name(package.metadata["Name"])
        purl, expression = f"pkg:pypi/{name}@{package.version}", package.metadata.get("License-Expression")
        licence = {"expression": expression} if expression else {"license": {"name": get_licence(package)}}
        row = {"type": kind, "bom-ref": purl, "name": name, "version": package.version, "purl": purl}
        return {**row, "licenses": [licence]}

    product = component(distribution(PRODUCT), "application")
    rows = {name: component(package, "library") for name, (package, _) in packages.items()}
    references = {name: row["bom-ref"] for name, row in rows.items()}
    needs = {
        name: {canonicalize_name(Requirement(text).name) for text in package.requires or ()} & rows.keys()
        for name, (package, _) in packages.items()
    }
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {"component": product},
        "components": list(rows.values()),
        "dependencies": [
            {"ref": product["bom-ref"], "dependsOn": list(references.values())},
            *({"ref": references[name], "dependsOn": sorted(references[on] for on in needs[name])} for name in rows),
        ],
    }


def build_notice() -> str:
    """Return a line with the licence of each package."""
    return "".join(f"{name}: {get_licence(package)}\n" for name, (package, _) in find_packages().items())


def read_constraints() -> list[tuple[Requirement, list[str]]]:
    """Return the pinned packages of .ci/constraints.txt, each with its hashes."""
    text = (ROOT / ".ci" / "constraints.txt").read_text(encoding="utf-8")
    blocks = re.findall(r"^(?![#\s])(.+?)((?: \\\n    --hash=sha256:[0-9a-f]{64})+)$", text, re.MULTILINE)
    return [(Requirement(name), re.findall(r"sha256:(\w+)", hashes)) for name, hashes in blocks]


if __name__ == "__main__":
    if sys.argv[1:] not in (["sbom"], ["notice"]):
        raise SystemExit("usage: python -m tests.house.supply_chain sbom|notice")
    sys.stdout.write(build_notice() if sys.argv[1] == "notice" else json.dumps(build_sbom(), indent=2) + "\n")
