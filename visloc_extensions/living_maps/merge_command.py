"""The command ``mapping merge``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from mapping.cli.acceptance import require_acceptance
from mapping.cli.display import ERR, say, say_notes
from mapping.cli.progress import StageProgress
from mapping.options import AcceptOption, MapsDirOption
from visloc.archive import MapStore, open_map
from visloc.geometry import Pose
from visloc_extensions.living_maps.merging.job import MIN_OVERLAP, Merged, join_as_set, merge_maps


def merge(
    a: Annotated[str, typer.Argument(metavar="A", help="id or id@version; its frame stays.")],
    b: Annotated[str, typer.Argument(metavar="B", help="id or id@version of the other map.")],
    map_id: Annotated[str, typer.Option("--map", help="Id of the new map, or set.")],
    as_set: Annotated[
        bool,
        typer.Option("--as-set", help="Publish a set of both instead, and leave them as they are."),
    ] = False,
    min_overlap: Annotated[
        float,
        typer.Option(help="Least share of B's photos that must be localized in A, 0 to 1."),
    ] = MIN_OVERLAP,
    accept: AcceptOption = False,
    maps_dir: MapsDirOption = Path("maps"),
) -> None:
    """Register a map in another map of the same place, and make one map of both."""
    store = MapStore(maps_dir)
    with StageProgress(ERR, if_stopped="nothing was published") as progress:
        if as_set:
            merged = join_as_set(store, a, b, map_id, progress, min_overlap=min_overlap)
        else:
            merged = merge_maps(
                store, a, b, map_id, progress, min_overlap=min_overlap, accept=accept
            )
    print_merged(merged, map_id)
    if not as_set:
        pictures = maps_dir / ".work" / ".doubts"
        require_acceptance(open_map(merged.folder), accept=accept, pictures=pictures)


def print_merged(merged: Merged, map_id: str) -> None:
    """Print how well two maps fit, and the map that was made of them."""
    found, unit = merged.registration, "m" if merged.a.manifest.world.metric else "units"
    tie = found.tie
    tied, moved_by = tie.tied, tie.there_from_here
    w, x, y, z = Pose(moved_by.rotation, moved_by.translation).rotation_wxyz
    distance, angle = (np.median(values[tied]) for values in (tie.distances, tie.angles_deg))
    say(
        f"{merged.b.ref} in {merged.a.ref}: {len(found.localized)} of {found.tried} photos "
        f"localized, {tied.sum()} tied; {tie.num_back} photos of {merged.a.ref} tied the other way"
    )
    say(
        f"medians of the tied: {np.median(tie.errors_px[tied]):.2f} px, "
        f"{distance:.3g} {unit}, {angle:.3g} degrees"
    )
    say(
        f"A from B: scale {moved_by.scale:.6g}, rotation {w:.6f} {x:.6f} {y:.6f} {z:.6f}, "
        "translation " + " ".join(f"{value:.4f}" for value in moved_by.translation)
    )
    say_notes(merged.notes)
    say(f"published: {map_id}@{merged.folder.name}")
