"""``mapping set`` and ``mapping split``, and the output of ``inspect`` and ``verify`` on sets."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from mapping.cli.display import ERR, OUT, gravity_text, place_text, say, say_notes
from mapping.cli.progress import StageProgress
from mapping.frames.set_poses import poses_on_earth, read_poses
from mapping.maps.sets import publish_set
from mapping.maps.splitting import split_map
from mapping.options import MapsDirOption
from visloc.archive import MapSet, MapStore, open_set
from visloc.archive.checks import read_any_manifest
from visloc.archive.set_rules import refuse_missing_tiles
from visloc.errors import refuse
from visloc.sets.coarse import check_descriptor

# More lines than anyone reads.
_SHOWN_TILES = 50


def set_maps(
    set_id: Annotated[str, typer.Argument(metavar="ID", help="Id of the set.")],
    maps: Annotated[list[str], typer.Argument(metavar="MAP...", help="id or id@version of each.")],
    poses: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Pose of each map in the set, one per line: map qw qx qy qz tx ty tz "
            "[scale], with x_set = scale R x_map + t. Default: from the anchors of the "
            "maps, in metres east, north and up of the first.",
        ),
    ] = None,
    maps_dir: MapsDirOption = Path("maps"),
) -> None:
    """Publish a set of maps: tiles, floors or buildings in one frame."""
    store = MapStore(maps_dir)
    tiles = poses_on_earth(store, maps) if poses is None else read_poses(poses, maps)
    with StageProgress(ERR, if_stopped="nothing was published") as progress:
        folder = publish_set(store, set_id, tiles, progress)
    print_set(open_set(folder))


def split(
    map_ref: Annotated[str, typer.Argument(metavar="MAP", help="id or id@version.")],
    tile: Annotated[
        str,
        typer.Option(
            metavar="LENGTH",
            help="Side of a tile: 25m for metres in a metric map, 25 for units of the map.",
        ),
    ],
    set_id: Annotated[
        str, typer.Option("--set", metavar="ID", help="Id of the set; its tiles are ID-<i>-<j>.")
    ],
    overlap: Annotated[
        str | None,
        typer.Option(
            metavar="LENGTH",
            help="A tile also takes photos of other tiles within this distance. Default: a fifth "
            "of the side.",
        ),
    ] = None,
    maps_dir: MapsDirOption = Path("maps"),
) -> None:
    """Cut a large map into a set of tiles, on a grid perpendicular to gravity."""
    store = MapStore(maps_dir)
    metric = store.open(map_ref).manifest.world.metric
    side = _length("--tile", tile, metric)
    margin = side / 5 if overlap is None else _length("--overlap", overlap, metric)
    with StageProgress(ERR) as progress:
        folder = split_map(store, map_ref, set_id, progress, tile=side, overlap=margin)
    print_set(open_set(folder))


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
        opened: the set, verified.
        maps_dir: the store; None where the set is a folder alone.

    Raises:
        Conflict: ``map.features``, ``set.tile``, ``set.features``.
        NotFound: ``set.tile``.
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


def _length(option: str, text: str, metric: bool) -> float:
    """A length in units of the map.

    Raises:
        InvalidInput: ``split.tile`` or ``split.overlap``.
    """
    match = re.fullmatch(r"([0-9]*\.?[0-9]+)(m?)", text.strip())
    if match is None or (match[2] and not metric):
        raise refuse(
            f"split.{option[2:]}",
            "the length is not valid"
            if match is None
            else "the map is not metric, so lengths in metres have no meaning",
            field=option,
            expected="a number such as 25 for units of the map, or 25m of a metric one"
            if match is None
            else "a number of the map's own units, such as 25",
            got=text,
        )
    return float(match[1])
