"""The cameras of a map, as the ``mapping`` command tells them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Literal

from pydantic import JsonValue, ValidationError

from mapping.methods.sparse.intrinsics import CAMERAS, CameraOrigin, Reason
from visloc.archive import ImageRecord, Map

# With more cameras than this, their lines are summed up.
_LISTED = 5
_EXTREMES = 3
_SOURCES = {
    "exif": "EXIF",
    "given": "given by the dataset",
    "estimated": "estimated from the photos",
    "unknown": "its origin is not recorded",
}
_DOUBTS: Mapping[str, str] = {
    "implausible": "refinement gave what no lens has",
    "undetermined": "the photos do not determine it",
    "moved": "refinement moved it too far",
    "unsettled": "refinement did not settle",
}


@dataclass(frozen=True, slots=True)
class MapCamera:
    """A camera of a map.

    Attributes:
        width: of its photos, pixels.
        height: of its photos, pixels.
        source: where it came from: EXIF, the dataset, the photos alone; unknown in maps that do not
            tell.
        moved_percent: by how much refinement moved it from there; None if it came from the photos
            or is of unknown origin.
        doubt: why refinement was not believed, if it was not.
        photos: how many photos of the map it took.
    """

    model: str
    width: int
    height: int
    focal_length_px: float
    source: Literal["exif", "given", "estimated", "unknown"]
    moved_percent: float | None
    doubt: Reason | None
    photos: int


def cameras_of(opened: Map) -> dict[str, MapCamera]:
    """Return the cameras of a map by id."""
    settings = opened.manifest.method.settings
    photos = Counter(image.camera for image in opened.images)
    cameras = {}
    for name, camera in opened.cameras.items():
        origin, focal = _origin(settings, name), camera.focal_length
        prior = None if origin is None else origin.prior_px
        cameras[name] = MapCamera(
            model=camera.model,
            width=camera.width,
            height=camera.height,
            focal_length_px=focal,
            source="unknown" if origin is None else origin.source,
            moved_percent=None if prior is None else 100 * (focal / prior - 1),
            doubt=None if origin is None else origin.doubt,
            photos=photos[name],
        )
    return cameras


def disputed_focal_lengths(opened: Map) -> list[tuple[float, float]]:
    """Return focal lengths (px) that were kept as known, each with the one that photos fit best.

    Only those that the photos do not determine.
    """
    settings = opened.manifest.method.settings
    origins = (_origin(settings, name) for name in opened.cameras)
    return [
        (origin.prior_px, origin.refined_px)
        for origin in origins
        if origin is not None and origin.doubt == "undetermined"
        if origin.prior_px is not None and origin.refined_px is not None
    ]


def origins_record(a: Map, b: Map, images: Sequence[ImageRecord]) -> dict[str, JsonValue]:
    """Return what the manifest of a joined map says of its cameras.

    Args:
        b: the second one.
        images: of the joined map: those of ``a``, then those of ``b``.
    """
    cameras = {image.camera: (a, image.camera) for image in a.images}
    for image, own in zip(images[len(a.images) :], b.images, strict=True):
        cameras.setdefault(image.camera, (b, own.camera))
    origins = {
        name: _origin(opened.manifest.method.settings, camera)
        for name, (opened, camera) in cameras.items()
    }
    if all(origin is not None and origin.source == "given" for origin in origins.values()):
        return {}
    return {CAMERAS: {name: one.model_dump() for name, one in origins.items() if one is not None}}


def _origin(settings: Mapping[str, JsonValue], camera: str) -> CameraOrigin | None:
    """Return what the manifest says of a camera; None when it does not tell its source."""
    refine, recorded = settings.get("refine"), settings.get(CAMERAS)
    if isinstance(recorded, Mapping):
        try:
            return CameraOrigin.model_validate(recorded.get(camera))
        except ValidationError:
            return None
    # Maps of older programs do not tell what they refined.
    changed = settings.get("poses") == "estimate" or (
        isinstance(refine, list) and "intrinsics" in refine
    )
    return None if changed else CameraOrigin(source="given")


def camera_lines(opened: Map) -> list[str]:
    """Tell the cameras of a map: each in a line, or of many a summary with the extremes."""
    cameras = cameras_of(opened)
    if len(cameras) <= _LISTED:
        return [_line(name, camera) for name, camera in cameras.items()]
    sources = Counter(camera.source for camera in cameras.values())
    focal = [camera.focal_length_px for camera in cameras.values()]
    lines = [
        f"{len(cameras)}, focal lengths {min(focal):.1f} to {max(focal):.1f} px, median "
        f"{median(focal):.1f} px: "
        + ", ".join(f"{count} {_SOURCES[source]}" for source, count in sources.most_common())
    ]
    doubted = Counter(camera.doubt for camera in cameras.values() if camera.doubt)
    lines += [f"of {count}, {_DOUBTS[doubt]}" for doubt, count in doubted.most_common()]
    moved = {name: c for name, c in cameras.items() if c.moved_percent}
    if moved:
        lines.append("moved most:")
        lines += _extremes(moved)
    return lines


def _extremes(moved: Mapping[str, MapCamera]) -> Sequence[str]:
    order = sorted(moved.items(), key=lambda item: -abs(item[1].moved_percent or 0.0))
    return [_line(name, camera) for name, camera in order[:_EXTREMES]]


def _line(name: str, camera: MapCamera) -> str:
    source = _SOURCES[camera.source]
    if camera.moved_percent:
        source += f", refined by {camera.moved_percent:+.1f} %"
    if camera.doubt:
        kept = "" if camera.moved_percent is None else ", not refined"
        source += f"{kept}: {_DOUBTS[camera.doubt]}"
    photos = "1 photo" if camera.photos == 1 else f"{camera.photos} photos"
    return (
        f"{name}: {camera.model} {camera.width}x{camera.height}, focal length "
        f"{camera.focal_length_px:.1f} px ({source}), {photos}"
    )
