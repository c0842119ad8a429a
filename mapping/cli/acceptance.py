"""Messages about a version in doubt, and ``mapping use``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mapping.cli.display import say
from mapping.cluster.storage import open_store
from mapping.options import CacheDirOption, PlacedMapsDirOption
from mapping.own_test.picture import draw_doubts
from mapping.pipeline.pieces import use_version
from visloc.archive import Map
from visloc.errors import refuse

_SHOWN_NAMES = 10


def use(
    map_ref: Annotated[str, typer.Argument(metavar="MAP@VERSION", help="A published version.")],
    maps_dir: PlacedMapsDirOption = Path("maps"),
    cache_dir: CacheDirOption = Path("maps-cache"),
) -> None:
    """Put a published version of a map into use, also one that its own test speaks against.

    With a version that a build made, the pieces of that build are put into use, and pieces of other
    builds are taken out of use.
    """
    map_id, _, version = map_ref.partition("@")
    if not version:
        raise refuse("map.use", field="MAP@VERSION", got=map_ref)
    for ref in use_version(open_store(maps_dir, cache_dir), map_id, version):
        say(f"in use: {ref}")


def require_acceptance(opened: Map, *, accept: bool, pictures: Path) -> None:
    """Explain a new version's doubts, and fail unless a person accepted them beforehand.

    Args:
        accept: whether the version was put into use all the same.
        pictures: folder for a picture of where the photos in question lie.
    """
    doubts = opened.manifest.parts.doubts
    if not doubts:
        return
    for doubt in doubts:
        names = ", ".join(doubt.photos[:_SHOWN_NAMES])
        more = len(doubt.photos) - _SHOWN_NAMES
        about = f": {names}" + (f" and {more} more" if more > 0 else "") if names else ""
        say(f"doubt: {doubt.message}{about}")
    if any(doubt.photos for doubt in doubts):
        pictures.mkdir(parents=True, exist_ok=True)
        picture = pictures / f"{opened.manifest.id}-{opened.manifest.version}.png"
        picture.write_bytes(draw_doubts(opened))
        say(f"picture: {picture}")
    if not accept:
        raise refuse("map.doubtful", field="--accept", ref=opened.ref)
