"""Lists the licences of all dependencies, and checks them against policy.toml.

``python -m tools.supply_chain.licences`` fails for a licence that the policy does not allow;
``--write`` also writes docs/licences.md.
"""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import distribution
from pathlib import Path, PurePath
from typing import Any

from tools.supply_chain.dependencies import IMAGES, ROOT, of_extras, pinned

POLICY = Path(__file__).with_name("policy.toml")
PAGE = ROOT / "docs" / "licences.md"
_EXTRAS = (
    *("mapping", "service", "gem", "s3", "cluster", "tracing", "clients", "compare", "ros"),
    "dev",
)

_HEADER = """# Licences

What the project depends on, by what each package says of itself or the
[policy](../tools/supply_chain/policy.toml) knows of it. `make licences` writes this page; `make
check` fails when it is out of date, or when the policy does not allow a licence. visloc itself is
under the [BSD 3-Clause license](../LICENSE).

| package | version | licence | in the images |
|---|---|---|---|
"""


@dataclass(frozen=True, slots=True)
class Licensed:
    """A dependency.

    Attributes:
        version: of constraints.txt; empty for what it does not pin, such as pip itself.
        licence: an SPDX expression, or what the package says where the policy does not know it.
        bundled: libraries within its wheel that have another licence, as files or linked.
    """

    name: str
    version: str
    licence: str
    images: tuple[str, ...]
    bundled: tuple[str, ...]


def policy() -> dict[str, Any]:
    """Return policy.toml."""
    return tomllib.loads(POLICY.read_text())


def licence_of(name: str, rules: Mapping[str, Any]) -> str:
    """Return the licence of an installed distribution: an SPDX expression, where it is known."""
    if name in rules["known"]:
        return str(rules["known"][name]["licence"])
    metadata = distribution(name).metadata

    def told(field: str) -> list[str]:
        return [str(each).strip() for each in metadata.get_all(field) or ()]

    if expressions := told("License-Expression"):
        return expressions[0]
    spoken = [c.rpartition(" :: ")[2] for c in told("Classifier") if c.startswith("License :: ")]
    spoken = [each for each in spoken if each != "OSI Approved"]
    if not spoken:
        spoken = [each.partition("\n")[0] for each in told("License")]
    return " OR ".join(str(rules["spoken"].get(each, each)) for each in spoken)


def is_allowed(expression: str, allowed: Sequence[str]) -> bool:
    """Tell whether an SPDX expression (no parentheses) can be obeyed with the allowed licences."""
    choices = re.split(r"\s+OR\s+", expression)
    return any(
        all(part in allowed for part in re.split(r"\s+AND\s+", choice)) for choice in choices
    )


def dependencies(rules: Mapping[str, Any]) -> list[Licensed]:
    """Return all that the project depends on, with all of its extras."""
    images = {image: of_extras(extras) for image, extras in IMAGES.items() if image != "vision"}
    pins = pinned()
    return [
        Licensed(
            name,
            pins.get(name, ""),
            licence_of(name, rules),
            tuple(image for image, names in images.items() if name in names),
            (*bundled_in(name, rules["bundled"]), *rules["linked"].get(name, ())),
        )
        for name in of_extras(_EXTRAS)
    ]


def bundled_in(name: str, known: Mapping[str, str]) -> tuple[str, ...]:
    """Return the licences of libraries in a wheel that the policy knows, by name."""
    files = [PurePath(str(file)).name for file in distribution(name).files or ()]
    found = {library for library in known for file in files if file.startswith(library)}
    return tuple(f"{library} ({known[library]})" for library in sorted(found))


def refusals(found: Sequence[Licensed], rules: Mapping[str, Any]) -> list[str]:
    """Return what the policy does not allow, one sentence each."""
    told = []
    for one in found:
        is_tool = one.name in rules["tools"] and not one.images
        if not is_allowed(one.licence, rules["allowed"]) and not is_tool:
            told.append(f"{one.name} {one.version}: {one.licence or 'no licence is told'}")
        if one.bundled and one.name not in rules["holders"]:
            told.append(f"{one.name} {one.version} holds {', '.join(one.bundled)}")
    names = {one.name for one in found}
    for table in ("known", "tools", "linked", "holders"):
        told += [
            f"{name}: the policy knows it, and nothing needs it"
            for name in rules[table].keys() - names
        ]
    return told


def page(found: Sequence[Licensed], rules: Mapping[str, Any]) -> str:
    """Return docs/licences.md."""
    rows = []
    for one in found:
        licence = one.licence + "".join(f"; holds {each}" for each in one.bundled)
        rows.append(f"| {one.name} | {one.version} | {licence} | {', '.join(one.images)} |\n")
    reasons = [
        f"- `{name}`: {reason}.\n"
        for name, reason in (*rules["tools"].items(), *rules["holders"].items())
    ]
    return _HEADER + "".join(rows) + "\nExceptions of the policy:\n\n" + "".join(reasons)


def main() -> None:
    """Check, and write the page when asked to."""
    rules = policy()
    found = dependencies(rules)
    if "--write" in sys.argv[1:]:
        PAGE.write_text(page(found, rules))
    told = refusals(found, rules)
    if PAGE.read_text() != page(found, rules):
        told.append("docs/licences.md is out of date: make licences")
    if told:
        sys.exit("\n".join(told))


if __name__ == "__main__":
    main()
