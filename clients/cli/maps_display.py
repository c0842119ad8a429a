"""Descriptions of maps on a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console

from clients.cli.display import print_line, unit_of
from visloc_api.words.maps import Anchor, MapInfo

_NUM_TILES_SHOWN = 20


def print_maps(console: Console, maps: Sequence[MapInfo]) -> None:
    """Print a line for each map."""
    if not maps:
        console.print("no maps", highlight=False)
        return
    width = max(len(info.ref) for info in maps)
    for info in maps:
        parts = [f"{info.images} photos", _features(info), _size(info.size_bytes)]
        if info.num_tiles is not None:
            parts.insert(0, f"a set of {info.num_tiles} maps")
        if place := _place(info):
            parts.append(place)
        print_line(console, info.ref.ljust(width), ", ".join(parts))


def print_map(console: Console, info: MapInfo) -> None:
    """Print one map, a line for each fact."""
    unit = unit_of(info)
    low, high = info.extent
    sides = " x ".join(f"{b - a:.2f}" for a, b in zip(low, high, strict=True))
    print_line(console, "map", info.ref, "bold green" if info.current else "bold")
    print_line(console, "current", "yes" if info.current else "no")
    by = "" if info.method is None else f", by {info.method}"
    print_line(console, "created", f"{info.created}{by}")
    print_line(console, "features", _features(info))
    if info.fusion is not None:
        print_line(console, "fusion", _fusion(info))
    seen = "" if info.observations is None else f"{info.observations} observations, "
    print_line(
        console,
        "content",
        f"{info.images} photos, {info.landmarks} landmarks, {seen}{_size(info.size_bytes)}",
    )
    print_line(console, "extent", f"{sides} {unit}")
    if (test := info.own_test) is not None:
        right = f"{test.localized - test.wrong} of {test.tested} photos came back where they were"
        print_line(console, "own test", f"{right}, {test.wrong} elsewhere")
    for doubt in info.doubts:
        print_line(console, "doubt", doubt.message, "yellow")
    if info.pieces:
        print_line(console, "pieces", ", ".join(info.pieces))
    print_line(console, "on Earth", _place(info) or "not known; mapping anchor tells it")
    if info.anchor is not None:
        print_line(console, "anchor", _anchor(info.anchor))
    for number, rig in enumerate(info.rigs):
        print_line(console, "" if number else "rigs", f"{rig.id}: {', '.join(rig.sensors)}")
    for number, tile in enumerate(info.tiles[:_NUM_TILES_SHOWN]):
        print_line(console, "" if number else "tiles", f"{tile.ref}  {tile.images} photos")
    if len(info.tiles) > _NUM_TILES_SHOWN:
        print_line(console, "", f"and {len(info.tiles) - _NUM_TILES_SHOWN} more")
    for number, version in enumerate(info.versions):
        used = "  current" if version.current else ""
        print_line(console, "" if number else "versions", f"{version.version}{used}")
    print_line(console, "content hash", info.content_hash)


def _fusion(info: MapInfo) -> str:
    weights = ", ".join(f"{name}={weight:g}" for name, weight in info.fusion_weights.items())
    return f"{info.fusion} ({weights})" if weights else f"{info.fusion}"


def _features(info: MapInfo) -> str:
    return ", ".join((info.local_features, *info.global_features))


def _place(info: MapInfo) -> str:
    if info.place is None:
        return ""
    place = info.place
    return f"{place.latitude:.5f}, {place.longitude:.5f}, within {place.radius:.0f} m"


def _size(size_bytes: int) -> str:
    size = float(size_bytes)
    for unit in ("bytes", "kB", "MB"):
        if size < 1000:
            return f"{size:.0f} {unit}" if unit == "bytes" else f"{size:.1f} {unit}"
        size /= 1000
    return f"{size:.1f} GB"


def _anchor(anchor: Anchor) -> str:
    if anchor.kind in ("dataset", "model", "none"):
        by = anchor.kind
    elif anchor.images:
        by = f"{anchor.kind}, {anchor.images} photos or points"
    else:
        by = "a place that was given"
    return by if anchor.rms is None else f"{by}, {anchor.rms:.3g} off (rms, units of the world)"
