"""What the ``mapping`` command shows of maps and imports."""

from __future__ import annotations

import resource
from typing import Any

from rich.console import Console
from rich.table import Table

from mapping.importers import ImportSummary
from visloc.archive import Map


def summary_of(opened: Map) -> dict[str, Any]:
    """Return what a map holds, for programs."""
    manifest = opened.manifest.model_dump(exclude={"files"}, mode="json")
    counts = manifest["counts"]
    return {
        **manifest,
        "size_bytes": opened.size_bytes,
        "bytes_per_observation": opened.size_bytes / counts["observations"],
        "mean_track_length": float(opened.track_lengths.mean()),
        "cameras": len(opened.cameras),
        "path": str(opened.path),
    }


def print_map(out: Console, opened: Map) -> None:
    """Show what a map holds."""
    summary = summary_of(opened)
    counts, local = summary["counts"], summary["local_features"]
    extent = summary["world"]["extent"]
    sides = [high - low for low, high in zip(extent["min"], extent["max"], strict=True)]
    table = Table(show_header=False, box=None, title=f"map {opened.ref}", title_justify="left")
    rows = {
        "photos": f"{counts['images']} by {summary['cameras']} cameras",
        "landmarks": f"{counts['landmarks']}, seen by {summary['mean_track_length']:.1f} photos "
        "in the mean",
        "observations": f"{counts['observations']}",
        "local features": f"{local['fingerprint']['name']}, {local['descriptor_dim']} dimensions, "
        f"at most {local['max_keypoints']} per photo",
        "global features": ", ".join(
            f"{g['fingerprint']['name']} ({g['dim']})" for g in summary["global_features"]
        ),
        "extent": " x ".join(f"{side:.2f}" for side in sides)
        + (" m" if summary["world"]["metric"] else " (not metric)"),
        "world": _world(opened),
        "method": summary["method"]["name"],
        "size": f"{summary['size_bytes'] / 2**20:.1f} MiB, "
        f"{summary['bytes_per_observation']:.0f} bytes per observation",
        "created": summary["created"],
        "folder": summary["path"],
    }
    for name, value in rows.items():
        table.add_row(name, value)
    out.print(table)
    for note in summary["notes"]:
        out.print(f"note: {note}", markup=False, soft_wrap=True)


def _world(opened: Map) -> str:
    """Whether a unit is a metre, and what fixed the frame."""
    world = opened.manifest.world
    unit = "metric" if world.metric else "not metric"
    if world.anchor is None:
        return unit
    anchor = world.anchor
    fixed_by = {
        "dataset": "the poses of the dataset",
        "model": "the imported reconstruction",
        "gnss": f"GNSS fixes of {anchor.images} photos",
        "positions": f"known positions of {anchor.images} photos",
        "none": "nothing: the frame is arbitrary",
    }[anchor.kind]
    off = "" if anchor.rms is None else f", which agree within {anchor.rms:.2g} (RMS)"
    return f"{unit}, fixed by {fixed_by}{off}"


def peak_memory_bytes() -> int:
    """The largest of this process and its workers, each at its peak."""
    kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return max(resource.getrusage(kind).ru_maxrss for kind in kinds) * 1024


def print_import(out: Console, summary: ImportSummary) -> None:
    """Show what an import brought."""
    out.print(
        f"{summary.images} photos by {summary.cameras} cameras, {summary.posed} with a pose, "
        f"{summary.depth_maps} with depth, {summary.gnss} GNSS fixes; {summary.points} points, "
        f"{summary.observations} observations"
        + (", metric" if summary.metric else ", not known to be metric"),
        highlight=False,
        soft_wrap=True,
    )
    for note in summary.notes:
        out.print(f"note: {note}", markup=False, soft_wrap=True)
