"""The output of ``inspect`` and ``verify`` on sets."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from mapping.cli.display import OUT, gravity_text, place_text, say, say_notes
from visloc.archive import MapStore
from visloc.archive.checks import read_any_manifest
from visloc.archive.set_rules import refuse_missing_tiles
from visloc_extensions.sets.coarse import check_descriptor
from visloc_extensions.sets.files import MapSet, open_set, verify_set

# More lines than anyone reads.
_SHOWN_TILES = 50


def shown(folder: Path) -> tuple[dict[str, Any], Callable[[], None]]:
    """Return the contents of a set for programs, and what prints them."""
    opened = open_set(folder)
    return set_summary(opened), partial(print_set, opened)


def check(folder: Path, maps_dir: Path | None) -> None:
    """Check every byte of a set, and its tiles in a folder of maps, and say so."""
    verify_tiles(verify_set(folder), maps_dir)


def set_summary(opened: MapSet) -> dict[str, Any]:
    """Return the contents of a set, for programs."""
    return {
        **opened.manifest.model_dump(exclude={"files"}, mode="json"),
        "size_bytes": opened.size_bytes,
        "gravity": None if opened.gravity is None else opened.gravity.tolist(),
        "path": str(opened.path),
    }


def print_set(opened: MapSet) -> None:
    """Print the contents of a set."""
    manifest, world = opened.manifest, opened.manifest.world
    unit = " m" if world.metric else ""
    table = Table(box=None, title=f"set {opened.ref}", title_justify="left")
    for name in ("tile", "photos", "landmarks", "MiB", "middle of photos", "span", "scale"):
        table.add_column(name, justify="left" if name == "tile" else "right", overflow="fold")
    for tile in manifest.tiles[:_SHOWN_TILES]:
        sides = list(zip(tile.photo_extent.min, tile.photo_extent.max, strict=True))
        table.add_row(
            escape(tile.map),
            str(tile.images),
            str(tile.landmarks),
            f"{tile.size_bytes / 2**20:.1f}",
            " ".join(f"{(low + high) / 2:.1f}" for low, high in sides),
            " x ".join(f"{high - low:.1f}" for low, high in sides) + unit,
            f"{tile.set_from_tile.scale:.6g}",
        )
    OUT.print(table)
    if len(manifest.tiles) > _SHOWN_TILES:
        say(f"and {len(manifest.tiles) - _SHOWN_TILES} more tiles")
    for name, value in {
        "tiles": f"{manifest.counts.tiles}, of {manifest.counts.images} photos and "
        f"{manifest.counts.landmarks} landmarks together",
        "local features": manifest.local_features.name,
        "coarse index": f"{manifest.coarse.lists} lists of a tile, {opened.size_bytes} bytes",
        "world": "metric" if world.metric else "not metric",
        "gravity": gravity_text(opened.gravity),
        "place": place_text(opened.place),
        "created": manifest.created,
        "folder": str(opened.path),
    }.items():
        say(f"{name}: {value}")
    say_notes(manifest.notes)


def verify_tiles(opened: MapSet, maps_dir: Path | None) -> None:
    """Compare the coarse index's features with ours, and the tiles with those in the store.

    Args:
        maps_dir: the store; None where the set is a folder alone.
    """
    num_files = len(opened.manifest.files)
    say(f"{opened.ref}: {num_files} files, every byte as published")
    check_descriptor(opened)
    say("the coarse index: the same features as here")
    if maps_dir is not None:
        store = MapStore(maps_dir)
        refuse_missing_tiles(
            opened.manifest,
            lambda refs: (read_any_manifest(store.folder("@".join(ref))) for ref in refs),
        )
        say(f"{opened.manifest.counts.tiles} tiles: as the set names them")
