"""Which refined intrinsics to believe, and notes on the others.

A focal length from EXIF or a calibration is a prior: bundle adjustment may correct it, not replace
it. ``mapping.methods.sparse.triangulation`` judges every refined camera by the rules here, and
keeps cameras in doubt at their prior (docs/decisions/0024-focal-lengths-have-priors.md).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import PIL.Image  # noqa: F401  before pycolmap, see visloc.pose.reprojection
import pycolmap
from pydantic import BaseModel, ConfigDict

from mapping.stages.photos import some
from visloc.errors import VislocError, refuse
from visloc.kapture import Sensor

# EXIF rounds, and counts crops and digital stabilization in or not: several per cent are usual,
# a tenth is not.
MAX_MOVE = 0.1
# A focal length is determined if a change by this share ...
STEP = 0.05
# ... raises the reprojection errors by this share of the photo's longer side, a tenth of a pixel of
# 1600. A lens that does not quite fit its model, or a rolling shutter, causes errors of that size,
# which no number of matches averages out; below it, they would decide the focal length. Measured
# for 1600 pixels: flat ground from straight above 0.03 px; facades, rooms and courtyards 0.15 to 1.
MIN_RISE = 0.1 / 1600
# Focal lengths of the longer side of the photo: 9 to 360 mm on 35 mm film.
_FOCAL_RANGE = (0.25, 10.0)
# Distance of a ray from the axis, relative to a lens without distortion.
_STRETCH_RANGE = (2 / 3, 2.0)
# Tested this far towards the corners: beyond, one-coefficient models of a wide lens fail.
_INNER_SHARE = 0.75
# Models of lenses that distort by design.
_FISHEYE = ("FISHEYE", "FOV", "EUCM", "EQUIRECTANGULAR", "DIVISION")
_SAMPLES = 32
_ROUND_TRIP_PX = 0.5
_NAMED = 3
# Key of the origins of a map's cameras in the settings of its manifest.
CAMERAS = "cameras"
# Suffix of the name of a sensor whose focal length is from EXIF.
FROM_EXIF = "(EXIF)"

Reason = Literal["implausible", "undetermined", "moved", "unsettled"]


@dataclass(frozen=True, slots=True)
class Doubt:
    """Why refined intrinsics of a camera are not believed.

    Attributes:
        reason: ``implausible``: no lens has them. ``undetermined``: other focal lengths fit the
            photos as well. ``moved``: too far from the prior. ``unsettled``: not in doubt itself,
            but whenever some cameras were kept, others came in doubt.
        focal_length_px: as refined; may be negative or not finite. NaN for an unsettled camera
            without a photo in the last refined model.
    """

    reason: Reason
    focal_length_px: float


class CameraOrigin(BaseModel):
    """The source of a camera's focal length, as the manifest stores it.

    Attributes:
        source: ``exif``, ``given`` (by the dataset), or ``estimated`` from the photos alone.
        name: of the sensor, for imported photos make and model; "" if the dataset gave the camera.
        prior_px: the focal length of EXIF or the dataset; None if estimated.
        doubt: why the prior was kept; if estimated, why it may be far off.
        refined_px: the refined value of a camera in doubt; None if it is not finite.
    """

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    source: Literal["exif", "given", "estimated"]
    name: str = ""
    prior_px: float | None = None
    doubt: Reason | None = None
    refined_px: float | None = None


def origin_of(sensor: Sensor, doubt: Doubt | None) -> CameraOrigin:
    """Return the source of the focal length of a dataset's camera, and why it is in doubt."""
    refined = None if doubt is None else doubt.focal_length_px
    from_exif = sensor.name.endswith(FROM_EXIF)
    known = sensor.camera is not None
    return CameraOrigin(
        source="exif" if known and from_exif else ("given" if known else "estimated"),
        name="" if known and not from_exif else sensor.name.removesuffix(FROM_EXIF).strip(),
        prior_px=None if sensor.camera is None else sensor.camera.focal_length,
        doubt=None if doubt is None else doubt.reason,
        refined_px=refined if refined is not None and math.isfinite(refined) else None,
    )


def names_by_sensor(photos: Iterable[tuple[str, str]]) -> dict[str, list[str]]:
    """Return the names of photos by sensor, from pairs of sensor and name."""
    names: dict[str, list[str]] = {}
    for sensor, name in photos:
        names.setdefault(sensor, []).append(name)
    return names


def is_plausible(camera: pycolmap.Camera) -> bool:
    """Tell whether a lens for photos may have these intrinsics.

    Its focal length must be in a range. From the principal point towards the edges of the photo,
    rays must go outwards too, and be stretched or squeezed no more than by real lenses.
    """
    if not np.isfinite(camera.params).all():
        return False
    focal = [camera.params[index] for index in camera.focal_length_idxs()]
    low, high = (share * max(camera.width, camera.height) for share in _FOCAL_RANGE)
    if not all(low <= value <= high for value in focal):
        return False
    if any(name in camera.model_name for name in _FISHEYE):
        return True
    center = np.array([camera.principal_point_x, camera.principal_point_y])
    w, h = camera.width, camera.height
    corners, middles = [(0, 0), (w, 0), (0, h), (w, h)], [(w / 2, 0), (0, h / 2)]
    edge = np.array([*corners, *middles, (w, h / 2), (w / 2, h)])
    shares = np.linspace(0, _INNER_SHARE, _SAMPLES + 1)[1:]
    # (edge, sample, 2)
    pixels = center + shares[:, None] * (edge - center)[:, None, :]
    rays = np.asarray(camera.cam_from_img(pixels.reshape(-1, 2))).reshape(pixels.shape)
    if not np.isfinite(rays).all():
        return False
    with_depth = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=2)
    back = np.asarray(camera.img_from_cam(with_depth.reshape(-1, 3))).reshape(pixels.shape)
    if not (np.abs(back - pixels) <= _ROUND_TRIP_PX).all():  # false for NaN
        return False
    radii = np.linalg.norm(rays, axis=2)
    if not (np.diff(radii, axis=1) > 0).all():
        return False
    stretch = radii / np.linalg.norm((pixels - center) / np.array([focal[0], focal[-1]]), axis=2)
    return bool((_STRETCH_RANGE[0] <= stretch).all() and (stretch <= _STRETCH_RANGE[1]).all())


def doubt_of(
    camera: pycolmap.Camera, prior_px: float | None, rise_px: float | None
) -> Doubt | None:
    """Judge a refined camera.

    Args:
        prior_px: its focal length before; None if it was unknown.
        rise_px: root mean square rise of the reprojection errors in its photos, if its focal length
            changes by ``STEP`` and all else adapts. None for an implausible camera.
    """
    focal = float(camera.mean_focal_length())
    if rise_px is None:
        return Doubt("implausible", focal)
    if rise_px < MIN_RISE * max(camera.width, camera.height):
        return Doubt("undetermined", focal)
    if prior_px is not None and abs(focal / prior_px - 1) > MAX_MOVE:
        return Doubt("moved", focal)
    return None


def notes_on(origins: Mapping[str, CameraOrigin], photos: Mapping[str, Sequence[str]]) -> list[str]:
    """Return a note per reason: the cameras in doubt, and what to do about them.

    Args:
        origins: of cameras, by id.
    """
    notes = []
    for known in (True, False):
        for reason in get_args(Reason):
            doubted = {
                name: origin
                for name, origin in origins.items()
                if origin.doubt == reason and (origin.prior_px is not None) == known
            }
            if doubted:
                names = [photo for camera in doubted for photo in photos[camera]]
                note = _note_on_kept if known else _note_on_estimated
                notes.append(note(reason, doubted, names))
    return notes


_WHY: Mapping[Reason, str] = {
    "implausible": "refinement gave a camera that no lens has",
    "undetermined": "the photos fit other focal lengths almost as well. That is so for photos that "
    "look straight down at flat ground, along a straight path, or from one place",
    "moved": f"refinement moved it by more than {MAX_MOVE:.0%}",
    "unsettled": "each time some cameras were kept, others came in doubt, so in the end none was "
    "refined",
}
# `mapping import images --map` leaves no dataset to write it into.
_IN_SENSORS = (
    "in sensors.txt of the dataset (import photos with --output first, see "
    "docs/mapping.md#refined-cameras)"
)
_CALIBRATE = f"give a calibration {_IN_SENSORS}"
_ADVICE: Mapping[Reason, str] = {
    "implausible": f"If these photos matter, {_CALIBRATE}",
    "undetermined": "Sizes and heights in the map are as good as this value. To have it refined, "
    f"take some photos in other directions too, such as oblique ones; or {_CALIBRATE}",
    "moved": f"If the value is wrong, which bends the map, {_CALIBRATE}",
    "unsettled": f"If these photos matter, {_CALIBRATE}",
}


def _note_on_kept(
    reason: Reason, doubted: Mapping[str, CameraOrigin], photos: Sequence[str]
) -> str:
    return (
        f"the focal length was kept as known for {_count(doubted, photos)}: {_WHY[reason]}. "
        f"{_cases(doubted)}. {_ADVICE[reason]}"
    )


def _note_on_estimated(
    reason: Reason, doubted: Mapping[str, CameraOrigin], photos: Sequence[str]
) -> str:
    if reason == "implausible":
        return (
            f"{len(photos)} photos were left out: nothing tells their focal length, and "
            f"{_WHY[reason]}: {some(photos)}. If these photos matter, {_CALIBRATE}"
        )
    return (
        f"nothing tells the focal length for {_count(doubted, photos)}, and {_WHY[reason]}. "
        f"{_cases(doubted)}. Sizes and heights in the map may be far off. Use photos with a focal "
        f"length in EXIF, take some in other directions too, such as oblique ones, or {_CALIBRATE}"
    )


def _cases(doubted: Mapping[str, CameraOrigin]) -> str:
    cases = []
    for name, origin in list(doubted.items())[:_NAMED]:
        prior, refined = origin.prior_px, origin.refined_px
        case = f"{name}: "
        if prior is not None:
            source = "EXIF" if origin.source == "exif" else "the dataset"
            case += f"{prior:.1f} px of {source}, "
        case += "no number" if refined is None else f"{refined:.1f} px by the photos"
        if prior is not None and refined is not None:
            case += f" ({refined / prior - 1:+.1%})"
        cases.append(case)
    return "; ".join(cases) + ("; ..." if len(doubted) > _NAMED else "")


def _count(doubted: Mapping[str, CameraOrigin], photos: Sequence[str]) -> str:
    return f"{len(doubted)} camera{'s' * (len(doubted) > 1)} of {len(photos)} photos"


def no_lens(doubts: Mapping[str, Doubt], photos: Mapping[str, Sequence[str]]) -> VislocError:
    """The error ``sfm.camera``: no photo is left whose camera a lens may have."""
    names = [name for camera in doubts for name in photos[camera]]
    focal = [f"{doubt.focal_length_px:.1f} px" for doubt in doubts.values()]
    return refuse(
        "sfm.camera",
        field=some(names),
        expected="photos with a focal length in EXIF, more photos that overlap, from more places, "
        f"or a camera {_IN_SENSORS}",
        got=f"a focal length of {some(focal)}, with its distortion",
    )
