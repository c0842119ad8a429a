"""``mapping set`` and ``mapping split``, and what ``inspect`` and ``verify`` show of sets."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from mapping.cli.options import MapsDirOption
from mapping.cli.progress import StageProgress
from mapping.frames.set_poses import poses_on_earth, read_poses
from mapping.maps.sets import publish_set
from mapping.maps.splitting import split_map
from visloc.archive import MapSet, MapStore, open_set
from visloc.archive.checks import read_any_manifest
from visloc.archive.set_rules import refuse_missing_tiles
from visloc.errors import refuse
from visloc.sets.coarse import check_descriptor

_out = Console()
_err = Console(stderr=True)
# More lines than anyone reads.
_SHOWN_TILES = 50


def set_maps(
    set_id: Annotated[str, typer.Argument(metavar="ID", help="Id of the set.")],
    maps: Annotated[list[str], typer.Argument(metavar="MAP...", help="id or id@version of each.")],
    poses: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Where each map lies in the set, in lines: map qw qx qy qz tx ty tz [scale], with "
            "x_set = scale R x_map + t. Left out: where the maps lie on Earth tells, in metres "
            "east, north and up of the first.",
        ),
    ] = None,
    maps_dir: MapsDirOption = Path("maps"),
) -> None:
    """Publish a set of maps: tiles, floors or buildings in one frame."""
    store = MapStore(maps_dir)
    tiles = poses_on_earth(store, maps) if poses is None else read_poses(poses, maps)
    with StageProgress(_err, if_stopped="nothing was published") as progress:
        folder = publish_set(store, set_id, tiles, progress)
    print_set(_out, open_set(folder))


def split(
    map_ref: Annotated[str, typer.Argument(metavar="MAP", help="id or id@version.")],
    tile: Annotated[
        str,
        typer.Option(
            metavar="LENGTH",
            help="Side of a tile: 25m for metres, in metric maps; 25 for units of the map.",
        ),
    ],
    set_id: Annotated[
        str, typer.Option("--set", metavar="ID", help="Id of the set; its tiles are ID-<i>-<j>.")
    ],
    overlap: Annotated[
        str | None,
        typer.Option(
            metavar="LENGTH",
            help="Photos of other tiles that are as near belong to a tile too; left out: a fifth "
            "of the side.",
        ),
    ] = None,
    maps_dir: MapsDirOption = Path("maps"),
) -> None:
    """Cut a large map into a set of tiles on a grid across gravity."""
    store = MapStore(maps_dir)
    metric = store.open(map_ref).manifest.world.metric
    side = _length("--tile", tile, metric)
    margin = side / 5 if overlap is None else _length("--overlap", overlap, metric)
    with StageProgress(_err) as progress:
        folder = split_map(store, map_ref, set_id, progress, tile=side, overlap=margin)
    print_set(_out, open_set(folder))


def set_summary(opened: MapSet) -> dict[str, Any]:
    """Return what a set holds, for programs."""
    return {
        **opened.manifest.model_dump(exclude={"files"}, mode="json"),
        "size_bytes": opened.size_bytes,
        "gravity": None if opened.gravity is None else opened.gravity.tolist(),
        "path": str(opened.path),
    }


def print_set(out: Console, opened: MapSet) -> None:
    """Show what a set holds."""
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
    out.print(table)
    if len(manifest.tiles) > _SHOWN_TILES:
        out.print(f"and {len(manifest.tiles) - _SHOWN_TILES} more tiles", highlight=False)
    down = opened.gravity
    place = opened.place
    for name, value in {
        "tiles": f"{manifest.counts.tiles}, of {manifest.counts.images} photos and "
        f"{manifest.counts.landmarks} landmarks together",
        "local features": manifest.local_features.name,
        "coarse index": f"{manifest.coarse.bits} bits of a photo, {opened.size_bytes} bytes",
        "world": "metric" if world.metric else "not metric",
        "gravity": "not known"
        if down is None
        else f"down is ({', '.join(f'{value:.6g}' for value in down)})",
        "place": "not anchored to the Earth"
        if place is None
        else f"latitude {place.latitude:.7f}, longitude {place.longitude:.7f}, within "
        f"{place.radius:.0f} m",
        "created": manifest.created,
        "folder": str(opened.path),
    }.items():
        out.print(f"{name}: {value}", markup=False, highlight=False, soft_wrap=True)
    for note in manifest.notes:
        out.print(f"note: {note}", markup=False, soft_wrap=True)


def verify_tiles(out: Console, opened: MapSet, maps_dir: Path | None) -> None:
    """Compare the coarse index's features with ours, and the tiles with those in the store.

    Args:
        out: where to say what is fine.
        opened: the set, verified.
        maps_dir: the store; None where the set is a folder alone.

    Raises:
        Conflict: ``map.features``, ``set.tile``, ``set.features``.
        NotFound: ``set.tile``.
    """
    num_files = len(opened.manifest.files)
    out.print(f"{opened.ref}: {num_files} files, every byte as published", soft_wrap=True)
    check_descriptor(opened)
    out.print("the coarse index: the same features as here", soft_wrap=True)
    if maps_dir is not None:
        store = MapStore(maps_dir)
        refuse_missing_tiles(
            opened.manifest,
            lambda refs: (read_any_manifest(store.folder("@".join(ref))) for ref in refs),
        )
        out.print(f"{opened.manifest.counts.tiles} tiles: as the set names them", soft_wrap=True)


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
            expected=(
                "a number such as 25 for units of the map, or 25m of a metric one"
                if match is None
                else "a number of the map's own units, such as 25"
            ),
            got=text,
        )
    return float(match[1])
