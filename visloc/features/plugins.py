"""Features of other Python packages, found by their entry points.

A package names a function that takes the folder with weights or None, how networks are computed,
and with how many threads (None for all), and returns a ``LocalFeatureExtractor`` or a
``GlobalDescriptor``. Its code is run when its name is asked for, not before.
"""

from __future__ import annotations

import re
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from visloc.errors import VislocError, refuse
from visloc.features.base import GlobalDescriptor, LocalFeatureExtractor
from visloc.options import Inference
from visloc.types import Fingerprint

LOCAL_FEATURES_GROUP = "visloc.local_features"
GLOBAL_FEATURES_GROUP = "visloc.global_features"
# Names that can stand in a manifest and in file names of a map.
_NAME = re.compile(r"[a-z0-9][a-z0-9_.-]{0,63}")
# The members that a plug-in must have: those that its protocol lists, which ``vars`` returns.
_MEMBERS = {
    group: sorted(name for name in vars(protocol) if not name.startswith("_"))
    for group, protocol in (
        (LOCAL_FEATURES_GROUP, LocalFeatureExtractor),
        (GLOBAL_FEATURES_GROUP, GlobalDescriptor),
    )
}


def plugin_names(group: str) -> set[str]:
    """Return the names that installed packages offer and that a map can have."""
    return {entry.name for entry in entry_points(group=group) if _NAME.fullmatch(entry.name)}


def passed_over(group: str) -> list[str]:
    """Tell which names installed packages offer that no map can have, each with its package."""
    return sorted(
        f"{entry.name!r} of the package {_package(entry)}"
        for entry in entry_points(group=group)
        if not _NAME.fullmatch(entry.name)
    )


def make_plugin(
    group: str, name: str, weights_dir: Path | None, inference: Inference, threads: int | None
) -> Any:
    """Make what a package offers under a name of ``plugin_names``."""
    entries = list(entry_points(group=group, name=name))
    packages = sorted(_package(entry) for entry in entries)
    if len(entries) > 1:
        raise refuse(
            "features.plugin",
            "several installed packages provide features of this name; uninstall all but one",
            field=name,
            expected="one package",
            got=", ".join(packages),
        )
    try:
        made = entries[0].load()(weights_dir, inference, threads)
        lacking = [member for member in _MEMBERS[group] if not hasattr(made, member)]
        fingerprint = None if lacking else made.fingerprint
    except VislocError:
        raise
    # Some packages exit where a library is missing; that must not end a server of other maps.
    except (Exception, SystemExit) as error:
        raise refuse(
            "features.plugin",
            f"the package {packages[0]} cannot make these features; repair or uninstall it",
            field=name,
            expected=f"{entries[0].value} makes them",
            got=f"{type(error).__name__}: {error}",
        ) from error
    if lacking:
        raise refuse(
            "features.plugin",
            f"the package {packages[0]} does not make an object of {group}; repair or uninstall it",
            field=name,
            expected=f"an object with {', '.join(_MEMBERS[group])}",
            got=f"{type(made).__name__} without {', '.join(lacking)}",
        )
    if not isinstance(fingerprint, Fingerprint) or fingerprint.name != name:
        raise refuse(
            "features.plugin",
            f"the package {packages[0]} makes features of another name, so nothing could "
            "open the map again",
            field=name,
            expected=f"a fingerprint with the name of the entry point, {name}",
            got=getattr(fingerprint, "name", fingerprint),
        )
    return made


def _package(entry: EntryPoint) -> str:
    distribution = entry.dist
    return entry.module if distribution is None else distribution.name
