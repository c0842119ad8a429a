"""``mapping set`` and ``mapping split``."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from mapping.cli.display import ERR
from mapping.cli.progress import StageProgress
from mapping.options import MapsDirOption
from visloc.archive import MapStore
from visloc.errors import refuse
from visloc_extensions.sets.display import print_set
from visloc_extensions.sets.files import open_set
from visloc_extensions.sets.poses import poses_on_earth, read_poses
from visloc_extensions.sets.publishing import publish_set
from visloc_extensions.sets.splitting import split_map


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


def _length(option: str, text: str, metric: bool) -> float:
    """A length in units of the map."""
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
