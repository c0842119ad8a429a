"""The output of the ``mapping`` command about maps and imports."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from mapping.cluster.stage_timings import Spent, StageCost
from mapping.frames.georeference import Georeference
from mapping.importers import ImportSummary
from mapping.maps.cameras import camera_lines, cameras_of
from visloc.archive import Map, MapStore
from visloc.archive.places import GeoCircle
from visloc.archive.schema import photo_file
from visloc.retrieval.fusion import EQUAL_GHARM

OUT = Console()
ERR = Console(stderr=True)
# Of the landmarks, on each side: some lie far outside of what was filmed.
_STRAYS, _MOST_LANDMARKS = 0.02, 100_000
# More lines than anyone reads.
_SHOWN_RESIDUALS = 20


def say(text: str) -> None:
    """Print a line as it is, however long."""
    OUT.print(text, markup=False, highlight=False, soft_wrap=True)


def say_notes(notes: Iterable[str]) -> None:
    """Print notes, one in a line."""
    for note in notes:
        say(f"note: {note}")


def summary_of(opened: Map) -> dict[str, Any]:
    """Return the contents of a map, for programs."""
    manifest = opened.manifest.model_dump(exclude={"files"}, mode="json")
    counts = manifest["counts"]
    return {
        **manifest,
        "size_bytes": opened.size_bytes,
        "bytes_per_observation": opened.size_bytes / counts["observations"],
        "mean_track_length": float(opened.track_lengths.mean()) if opened.has_landmarks else None,
        "cameras": len(opened.cameras),
        "focal_lengths": {name: asdict(one) for name, one in cameras_of(opened).items()},
        "rigs": {rig: sorted(members) for rig, members in opened.rigs.items()},
        # Not in every manifest: a geodetic anchor implies it.
        "gravity": None if opened.gravity is None else opened.gravity.tolist(),
        "keeps": [
            *(["photos"] if photo_file(0) in opened.manifest.files else []),
            *(["colours"] if opened.colors is not None else []),
        ],
        "path": str(opened.path),
    }


def _own_test(opened: Map) -> str:
    """Return the result of the map's own test as text."""
    test = opened.manifest.parts.own_test
    if test is None:
        return "none: answers state the uncertainty of the photo only (mapping upgrade adds it)"
    text = (
        f"{test.localized} of {test.tested} photos localized without themselves, {test.wrong} "
        f"wrong; positions are {test.position_factor:g} times, orientations "
        f"{test.orientation_factor:g} times as uncertain as a photo tells"
    )
    return text if test.independent else f"{text}; their poses are not independent of the map"


def _doubts(opened: Map) -> dict[str, str]:
    """Return why the version was not put into use by itself, if so."""
    doubts = opened.manifest.parts.doubts
    return {"doubts": "\n".join(doubt.message for doubt in doubts)} if doubts else {}


def print_map(opened: Map) -> None:
    """Print the contents of a map."""
    summary = summary_of(opened)
    counts, local = summary["counts"], summary["local_features"]
    table = Table(show_header=False, box=None, title=f"map {opened.ref}", title_justify="left")
    rows = {
        "photos": f"{counts['images']} by {summary['cameras']} cameras",
        "cameras": "\n".join(camera_lines(opened)),
        "rigs": "; ".join(f"{rig}: {', '.join(names)}" for rig, names in summary["rigs"].items())
        or "none",
        "landmarks": _landmarks(summary),
        "observations": f"{counts['observations']}",
        "local features": f"{local['fingerprint']['name']}, {local['descriptor_dim']} dimensions, "
        f"at most {local['max_keypoints']} per photo",
        "computed with": local["computed_with"] or "not known",
        "global features": ", ".join(
            f"{g['fingerprint']['name']} ({g['dim']})" for g in summary["global_features"]
        ),
        **_retrieval(opened),
        "extent": _extent(opened),
        "world": _world(opened),
        "gravity": gravity_text(opened.gravity),
        "place": place_text(opened.place) + _scale(opened),
        "method": summary["method"]["name"],
        "own test": _own_test(opened),
        **_doubts(opened),
        "keeps": ", ".join(summary["keeps"]) or "neither photos nor colours",
        "size": f"{summary['size_bytes'] / 2**20:.1f} MiB, "
        f"{summary['bytes_per_observation']:.0f} bytes per observation",
        "created": summary["created"],
        "folder": summary["path"],
    }
    for name, value in rows.items():
        table.add_row(name, escape(value))
    OUT.print(table)
    say_notes(summary["notes"])


def _landmarks(summary: Mapping[str, Any]) -> str:
    if summary["mean_track_length"] is None:
        return "none: queries triangulate around themselves"
    return (
        f"{summary['counts']['landmarks']}, seen by {summary['mean_track_length']:.1f} photos in "
        "the mean"
    )


def _extent(opened: Map) -> str:
    """Return the sides of the box of the landmarks, without the few that lie far outside."""
    box = opened.manifest.world.extent
    low, high = np.array(box.min), np.array(box.max)
    unit = " m" if opened.manifest.world.metric else " (not metric)"
    if not opened.has_landmarks:
        return _sides(high - low) + unit
    landmarks = opened.landmarks[:: max(1, len(opened.landmarks) // _MOST_LANDMARKS)]
    inner = np.quantile(landmarks.astype(np.float64), [_STRAYS, 1 - _STRAYS], axis=0)
    return (
        f"{_sides(inner[1] - inner[0])}{unit} without the outermost landmarks, "
        f"{_sides(high - low)} with them"
    )


def _sides(lengths: NDArray[np.float64]) -> str:
    return " x ".join(f"{length:.2f}" for length in lengths)


def print_pieces(store: MapStore, largest: Map) -> None:
    """Print the maps that the same build made of photos that nothing links to the largest map."""
    for ref in largest.manifest.pieces:
        print_map(store.open(ref))
        map_id, _, version = ref.partition("@")
        if map_id not in store.ids() or store.current_version(map_id) != version:
            say(f"not in use: {ref}; put it into use with: mapping use {ref}")


def _retrieval(opened: Map) -> dict[str, str]:
    """Return how global features are fused, if not in the usual way."""
    if opened.fusion == EQUAL_GHARM:
        return {}
    weights = opened.fusion.weights
    counted = (
        "equal weights"
        if weights is None
        else ", ".join(f"{name}={weight:g}" for name, weight in weights.items())
    )
    return {"fused by": f"{opened.fusion.operator}, {counted}"}


def _world(opened: Map) -> str:
    """Return whether a unit is a metre, what told that, and what fixed the frame."""
    world, anchor = opened.manifest.world, opened.manifest.world.anchor
    kind, unit = ("metric", "m") if world.metric else ("not metric", "units")
    size = _source_of_size(opened)
    if size:
        kind += f", size from {size}"
    if anchor is None:
        return kind
    if anchor.kind == "none":
        arbitrary = "origin and directions" if world.metric else "origin, directions and size"
        return f"{kind}; {arbitrary} are arbitrary"
    fixed_by = {
        "dataset": "the poses of the dataset",
        "model": "the imported reconstruction",
        "gnss": f"GNSS fixes of {anchor.images} photos",
        "positions": f"known positions of {anchor.images} photos",
        "correspondences": f"{anchor.images} given points" if anchor.images else "a given place",
    }[anchor.kind]
    off = "" if anchor.rms is None else f", which agree within {anchor.rms:.2g} {unit} (RMS)"
    return f"{kind}, fixed by {fixed_by}{off}"


def _source_of_size(opened: Map) -> str:
    """Return the option of `mapping capture` that told the map's unit; empty without."""
    scale = opened.manifest.method.settings.get("scale")
    told_by = scale.get("by") if isinstance(scale, dict) else None
    return {"length": "--scale", "markers": "--marker-size"}.get(str(told_by), "")


def gravity_text(down: NDArray[np.float64] | None) -> str:
    """Return the direction of gravity, for people."""
    if down is None:
        return "not known"
    return f"down is ({', '.join(f'{value:.6g}' for value in down)})"


def place_text(place: GeoCircle | None) -> str:
    """Return where a map or a set lies on Earth, for people."""
    if place is None:
        return "not anchored to the Earth"
    return (
        f"latitude {place.latitude:.7f}, longitude {place.longitude:.7f}, "
        f"within {place.radius:.0f} m"
    )


def _scale(opened: Map) -> str:
    geodetic = opened.geodetic
    if geodetic is None or geodetic.scale == 1:
        return ""
    return f", {geodetic.scale:.6g} m per unit"


def print_georeference(found: Georeference) -> None:
    """Print how well the known positions agree with the map's place on Earth."""
    geodetic = found.anchor.geodetic
    assert geodetic is not None  # a georeference has one
    if found.names:
        _print_residuals(found)
    say(
        f"place: latitude {geodetic.latitude_deg:.9f}, longitude {geodetic.longitude_deg:.9f}, "
        f"altitude {geodetic.altitude_m:.3f} m; {geodetic.scale:.6g} m per unit"
    )


def _print_residuals(found: Georeference) -> None:
    table = Table(box=None, title="metres from the given position", title_justify="left")
    for name in ("place", "east", "north", "up", ""):
        table.add_column(name, justify="left" if name in ("place", "") else "right")
    off = found.residuals_m
    worst_first = sorted(range(len(off)), key=lambda row: -float((off[row] ** 2).sum()))
    for row in worst_first[:_SHOWN_RESIDUALS]:
        numbers = (f"{value:.2f}" for value in off[row])
        table.add_row(escape(found.names[row]), *numbers, "" if found.agrees[row] else "left out")
    OUT.print(table)
    if len(off) > _SHOWN_RESIDUALS:
        say(f"and {len(off) - _SHOWN_RESIDUALS} that are nearer")
    rms = math.sqrt((off[found.agrees] ** 2).sum(axis=1).mean())
    say(f"{found.agrees.sum()} of {len(off)} agree, within {rms:.3g} m (RMS)")


def print_costs(out: Console, costs: Sequence[StageCost]) -> None:
    """Print the cost of each stage of a build."""
    table = Table(box=None)
    table.add_column("stage")
    for name in ("items", "seconds", "CPU seconds", "MiB written"):
        table.add_column(name, justify="right")
    for cost in costs:
        table.add_row(
            escape(cost.stage),
            "" if cost.items is None else str(cost.items),
            f"{cost.wall_s:.1f}",
            f"{cost.spent.cpu_s:.1f}",
            f"{cost.spent.written_bytes / 2**20:.1f}",
        )
    out.print(table)


def say_peak_memory(spent: Spent) -> None:
    """Print the peak memory of the largest process."""
    say(f"peak memory {spent.peak_bytes / 2**30:.2f} GiB")


def print_import(summary: ImportSummary) -> None:
    """Print the contents of an import."""
    say(
        f"{summary.images} photos by {summary.cameras} cameras, {summary.posed} with a pose, "
        f"{summary.depth_maps} with depth, {summary.gnss} GNSS fixes; {summary.points} points, "
        f"{summary.observations} observations"
        + (", metric" if summary.metric else ", not known to be metric")
    )
    say_notes(summary.notes)
