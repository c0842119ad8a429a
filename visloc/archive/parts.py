"""The optional parts of a map: a new manifest over the same files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from visloc.archive.anchoring import link_or_copy
from visloc.archive.files import Files
from visloc.archive.reader import Map
from visloc.archive.schema import FORMAT_MAJOR, FORMAT_MINOR, INDEX_FOLDER, Doubt, OwnTest
from visloc.archive.writer import write_index


def add_own_test(folder: Path, test: OwnTest, *, version: str, doubts: Sequence[Doubt] = ()) -> str:
    """Write the own test of a map into its manifest, before the map is published.

    Args:
        folder: the map.
        test: replaces one that the map has.
        version: as for ``write_map``.
        doubts: why the map is not put into use by itself; replaces those that it has.

    Returns:
        The version.
    """
    manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    manifest["format_version"] = f"{FORMAT_MAJOR}.{FORMAT_MINOR}"
    manifest["parts"] = {
        **manifest.get("parts", {}),
        "own_test": test.model_dump(mode="json"),
        "doubts": [doubt.model_dump(mode="json") for doubt in doubts],
    }
    return Files(folder).finish(manifest, version)


def write_tested(
    opened: Map, folder: Path, test: OwnTest, *, version: str, created: str, indexed: bool = False
) -> str:
    """Write a map with its own test into an empty folder; files are shared by hard links.

    Args:
        opened: the map, which stays as it is.
        folder: exists and is empty.
        test: of the map.
        version: as for ``write_map``.
        created: ISO 8601 in UTC.
        indexed: whether it gets a new index, instead of one that it has.

    Returns:
        The version.
    """
    manifest = json.loads((opened.path / "manifest.json").read_text(encoding="utf-8"))
    if indexed:
        old = [name for name in manifest["files"] if name.startswith(INDEX_FOLDER)]
        for name in old:
            del manifest["files"][name]
    for name in manifest["files"]:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        link_or_copy(opened.path / name, folder / name)
    if indexed:
        files = Files(folder)
        for record, known in zip(
            manifest["global_features"], opened.manifest.global_features, strict=True
        ):
            name, stem = known.fingerprint.name, known.fingerprint.file_stem
            record["lists"] = write_index(files, stem, opened.global_descriptors[name])
            record.pop("clusters", None)
        manifest["files"] |= files.written()
    manifest["created"] = created
    (folder / "manifest.json").write_text(json.dumps(manifest), encoding="utf-8")
    doubts = opened.manifest.parts.doubts
    return add_own_test(folder, test, version=version, doubts=doubts)
