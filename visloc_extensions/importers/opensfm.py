"""OpenSfM's datasets: ``reconstruction.json``, ``tracks.csv``, ``features``.

Format: OpenSfM's documentation, "Dataset Structure" and "Geometric Models". Image coordinates are
normalized: the centre of the image is (0, 0) and the longer side is 1 long, so that in our pixels
x = x_n max(w, h) + w / 2. Shots have ``rotation`` (angle-axis) and ``translation``:
x_cam = R x_world + t. The world of a georeferenced reconstruction is in metres, x east, y north,
z up from ``reference_lla``. The matches are pickles and are never opened.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mapping.frames.anchor import scale_doubt
from mapping.importers.largest import ModelSize, largest_model
from mapping.importers.model import ImportedImage, ImportedModel
from mapping.importers.reading.json_fields import JsonValue, notes_on_unread, read_json
from mapping.importers.reading.photo_names import photo_names
from mapping.importers.reading.text_lines import TextLines
from visloc.errors import DatasetError, InvalidInput, refuse
from visloc.geodesy import geodetic_from_enu
from visloc.geometry import MAX_IMAGE_SIDE, Camera, Pose
from visloc.kapture import GnssRecord, Sensor
from visloc.kapture.text import is_field
from visloc_extensions.importers.opensfm_features import Features, read_features
from visloc_extensions.importers.tracks import Measurements, keypoints_of

_GNSS = "gnss"
# What OpenSfM writes for an altitude that it was told not to use, its default.
_UNUSED_ALTITUDE = 2.0
_NUM_COLUMNS = {"OPENSFM_TRACKS_VERSION_v1": 9, "OPENSFM_TRACKS_VERSION_v2": 11}
_NUM_COLUMNS_V0 = 8  # the first version has no header and no scale
_MAX_FEATURE = 10**9


@dataclass(frozen=True, slots=True, eq=False)
class _Shot:
    at: JsonValue
    name: str
    camera: str
    pose: Pose
    gps: list[float] | None
    dop: float


def read(path: Path, photos: Path | None = None) -> ImportedModel:
    """Read the largest reconstruction of an OpenSfM dataset.

    Features are taken from ``features/NAME.features.npz`` if all photos have them; else the
    observations in ``tracks.csv`` become the keypoints. Photos' GPS positions become GNSS fixes,
    and the world counts as metric when they tell its scale (``mapping.frames.anchor.scale_doubt``).

    Args:
        path: the dataset's folder, or its ``reconstruction.json``.
        photos: folder of photos; ``images`` in the dataset by default, when it exists.
    """
    path = path / "reconstruction.json" if path.is_dir() else path
    folder = path.parent
    reconstruction, notes = _largest(read_json(path))
    cameras, unknown = _read_cameras(reconstruction["cameras"])
    shots = _read_shots(path, reconstruction, cameras, unknown, notes)
    default = folder / "images"
    found_photos = default if photos is None and default.is_dir() else photos
    base = default if found_photos is None else found_photos
    names, name_notes = photo_names([(s.name, s.at.where) for s in shots], base, base)
    notes += name_notes
    sensors = _sensors(cameras)
    sensor_of = dict(zip(cameras, sensors, strict=True))
    images = [
        ImportedImage(name, sensor_of[shot.camera], rank, shot.pose)
        for rank, (name, shot) in enumerate(zip(names, shots, strict=True))
    ]
    point_ids, points, colors = _read_points(reconstruction["points"])
    measurements = _read_tracks(
        folder / "tracks.csv", point_ids, {shot.name: rank for rank, shot in enumerate(shots)}
    )
    sizes = np.array([(cameras[s.camera].width, cameras[s.camera].height) for s in shots])
    features = read_features(folder / "features", names)
    if features is not None:
        images = _with_features(images, features, sizes)
        unread = Counter(name for found in features for name in found.unread)
        if unread:
            some = ", ".join(f"{name!r} ({count})" for name, count in unread.most_common(10))
            notes.append(f"arrays of the features that are not read: {some}")
        observations = _checked_rows(folder / "tracks.csv", measurements, features)
    else:
        notes.append("not all photos have features; the observations are the keypoints")
        images, observations = _with_observed(images, measurements, sizes, folder / "tracks.csv")

    gnss, metric, gnss_notes = _fixes(folder, reconstruction, shots)
    if gnss:
        sensors[_GNSS] = Sensor(_GNSS, "", "gnss", ("EPSG:4326",), None)
    return ImportedModel(
        sensors,
        tuple(images),
        found_photos,
        points,
        colors,
        observations,
        keypoints_type="opensfm",
        gnss=gnss,
        metric=metric,
        notes=(*notes, *gnss_notes, *notes_on_unread(reconstruction)),
    )


def _with_observed(
    images: Sequence[ImportedImage],
    measurements: Measurements,
    sizes: NDArray[np.int64],
    tracks: Path,
) -> tuple[list[ImportedImage], NDArray[np.int64]]:
    """Take the observations as keypoints; return the images and the observations (M, 3)."""
    pixels = _pixels(measurements.xy, sizes[measurements.image])
    found, observations = keypoints_of(measurements, pixels, len(images), str(tracks))
    return [replace(i, keypoints=k) for i, k in zip(images, found, strict=True)], observations


def _read_shots(
    path: Path,
    model: JsonValue,
    cameras: Mapping[str, Camera],
    unknown: Mapping[str, str],
    notes: list[str],
) -> list[_Shot]:
    """Read the shots of usable cameras; add a note on those of cameras of ``unknown`` kinds."""
    shots = [_read_shot(name, value) for name, value in model["shots"].fields()]
    for shot in shots:
        if shot.camera not in cameras and shot.camera not in unknown:
            raise shot.at["camera"].error("there is no such camera", expected="a key of cameras")
    for camera, kind in unknown.items():
        num = sum(shot.camera == camera for shot in shots)
        notes.append(f"{num} photos of a camera of the kind {kind!r} were left out")
    usable = [shot for shot in shots if shot.camera in cameras]
    if not usable:
        raise refuse(
            "import.empty",
            "no photo of the reconstruction can be used" + "".join(f"; {n}" for n in notes),
            field=str(path),
        )
    return usable


def _sensors(cameras: Mapping[str, Camera]) -> dict[str, Sensor]:
    return {
        f"camera_{rank}": Sensor.with_camera(
            f"camera_{rank}", camera, name=key if is_field(key) else ""
        )
        for rank, (key, camera) in enumerate(cameras.items())
    }


def _largest(top: JsonValue) -> tuple[JsonValue, list[str]]:
    reconstructions = top.elements()
    if not reconstructions:
        raise refuse("import.empty", "the file holds no reconstruction", field=top.where)
    sizes = []
    for number, reconstruction in enumerate(reconstructions):
        points = reconstruction.get("points")
        sizes.append(
            ModelSize(
                f"reconstruction {number}",
                photos=len(list(reconstruction["shots"].fields())),
                points=0 if points is None else len(list(points.fields())),
            )
        )
    largest, notes = largest_model("the file", sizes)
    return reconstructions[largest], notes


def _read_cameras(cameras: JsonValue) -> tuple[dict[str, Camera], dict[str, str]]:
    """Return the cameras by key, and the kinds of those that have no counterpart here."""
    known: dict[str, Camera] = {}
    unknown: dict[str, str] = {}
    for key, value in cameras.fields():
        kind = value["projection_type"].text()
        try:
            camera = _camera(kind, value)
        except DatasetError:
            raise
        except InvalidInput as error:
            raise refuse(
                "import.json", error.message, field=value.where, expected=error.expected
            ) from error
        if camera is None:
            unknown[key] = kind
        else:
            known[key] = camera
    return known, unknown


def _camera(kind: str, value: JsonValue) -> Camera | None:
    def field(name: str) -> float:
        return value[name].number()

    width, height = (value[side].integer(MAX_IMAGE_SIDE) for side in ("width", "height"))
    side = max(width, height)
    if kind in ("perspective", "fisheye"):
        model = "RADIAL" if kind == "perspective" else "RADIAL_FISHEYE"
        f = field("focal") * side
        return Camera(model, width, height, (f, width / 2, height / 2, field("k1"), field("k2")))
    distortion = {
        "simple_radial": ("k1",),
        "radial": ("k1", "k2"),
        "brown": ("k1", "k2", "p1", "p2", "k3"),
        "fisheye_opencv": ("k1", "k2", "k3", "k4"),
    }
    if kind not in distortion:
        return None
    k = tuple(field(name) for name in distortion[kind])
    center = (field("c_x") * side + width / 2, field("c_y") * side + height / 2)
    pinhole = (field("focal_x") * side, field("focal_y") * side, *center)
    if kind == "fisheye_opencv":
        return Camera("OPENCV_FISHEYE", width, height, (*pinhole, *k))
    if kind == "brown":
        # The rational model is the one that has a k3; its k4 to k6 are zero then.
        return Camera("FULL_OPENCV", width, height, (*pinhole, *k, 0.0, 0.0, 0.0))
    return Camera("OPENCV", width, height, (*pinhole, *(*k, 0.0)[:2], 0.0, 0.0))


def _read_shot(name: str, value: JsonValue) -> _Shot:
    rotation = Rotation.from_rotvec(value["rotation"].numbers(3)).as_matrix()
    gps, dop = value.get_set("gps_position"), value.get_set("gps_dop")
    return _Shot(
        value,
        name,
        value["camera"].text(),
        Pose(rotation, np.array(value["translation"].numbers(3))),
        None if gps is None else gps.numbers(3),
        0.0 if dop is None else dop.number(),
    )


def _read_points(
    points: JsonValue,
) -> tuple[dict[str, int], NDArray[np.float64], NDArray[np.uint8]]:
    ids: dict[str, int] = {}
    coordinates: list[list[float]] = []
    colors: list[list[float]] = []
    for key, value in points.fields():
        ids[key] = len(coordinates)
        coordinates.append(value["coordinates"].numbers(3))
        colors.append(value["color"].numbers(3))
    rgb = np.clip(np.array(colors, np.float64).reshape(-1, 3).round(), 0, 255).astype(np.uint8)
    return ids, np.array(coordinates, np.float64).reshape(-1, 3), rgb


def _read_tracks(
    path: Path, point_ids: Mapping[str, int], ranks: Mapping[str, int]
) -> Measurements:
    """Return where the points were seen, normalized; rows of other photos or tracks are skipped."""
    rows: list[tuple[int, int, int, float, float]] = []
    with TextLines(path) as lines:
        line = lines.next_or_none()
        num_columns = _NUM_COLUMNS_V0
        if line is not None and line.startswith("OPENSFM_TRACKS_VERSION"):
            if line not in _NUM_COLUMNS:
                raise lines.error(
                    "the version is unknown", expected=f"one of {', '.join(_NUM_COLUMNS)}", got=line
                )
            num_columns = _NUM_COLUMNS[line]
            line = lines.next_or_none()
        while line is not None:
            fields = line.split("\t")
            if len(fields) != num_columns:
                raise lines.error(
                    "the line has the wrong number of fields, separated by tabs",
                    expected=f"{num_columns}: image, track, feature, x, y, ...",
                    got=len(fields),
                )
            feature = lines.to_integer(fields[2], _MAX_FEATURE)
            x, y = lines.to_number(fields[3]), lines.to_number(fields[4])
            rank, point = ranks.get(fields[0]), point_ids.get(fields[1])
            if rank is not None and point is not None:
                rows.append((point, rank, feature, x, y))
            line = lines.next_or_none()
    return Measurements.from_rows(rows)


def _pixels(normalized: NDArray[np.float64], sizes: NDArray[np.int64]) -> NDArray[np.float64]:
    """Turn normalized positions (N, 2) into our pixels; sizes (N or 1, 2) are width, height."""
    pixels: NDArray[np.float64] = normalized * sizes.max(axis=1, keepdims=True) + sizes / 2
    return pixels


def _with_features(
    images: Sequence[ImportedImage], features: Sequence[Features], sizes: NDArray[np.int64]
) -> list[ImportedImage]:
    made = []
    for image, found, size in zip(images, features, sizes, strict=True):
        keypoints = found.points.astype(np.float64)
        keypoints[:, :2] = _pixels(keypoints[:, :2], size[None])
        keypoints[:, 2] *= size.max()  # the diameter or scale is normalized, too
        keypoints[:, 3] = np.radians(keypoints[:, 3])
        made.append(
            replace(image, keypoints=keypoints.astype(np.float32), descriptors=found.descriptors)
        )
    return made


def _checked_rows(
    path: Path, measurements: Measurements, features: Sequence[Features]
) -> NDArray[np.int64]:
    """Return the observations, once every one of them is known to be a feature."""
    for rank, found in enumerate(features):
        rows = measurements.image == rank
        numbers, xy = measurements.feature[rows], measurements.xy[rows]
        inside = numbers < len(found.points)
        off = np.abs(found.points[numbers[inside], :2] - xy[inside]).max(axis=1)
        if not inside.all() or (off > 1e-4).any():  # tracks have six digits
            raise refuse(
                "import.features",
                f"the tracks in {path.name} were made from other features",
                field=str(found.path),
                expected="the tracked features, where the tracks have them",
            )
    return np.column_stack([measurements.point, measurements.image, measurements.feature])


def _fixes(
    folder: Path, reconstruction: JsonValue, shots: Sequence[_Shot]
) -> tuple[tuple[GnssRecord, ...], bool, list[str]]:
    """Return the photos' GPS positions, whether they tell the scale, and notes."""
    located = [(rank, shot.gps, shot.dop) for rank, shot in enumerate(shots) if shot.gps]
    reference = reconstruction.get("reference_lla")
    if reference is None and os.path.isfile(folder / "reference_lla.json"):  # noqa: PTH113
        reference = read_json(folder / "reference_lla.json")
    if not located or reference is None:
        return (), False, ["the reconstruction is not georeferenced: its scale is unknown"]
    latitude, longitude = reference["latitude"], reference["longitude"]
    for angle, limit in ((latitude, 90), (longitude, 180)):
        if not -limit <= angle.number() <= limit:
            raise angle.error("the angle is out of range", expected=f"-{limit} to {limit} degrees")
    origin = [latitude.number(), longitude.number(), reference["altitude"].number()]
    positions = np.array([gps for _, gps, _ in located])
    geodetic = geodetic_from_enu(positions, np.array(origin))
    fixes = tuple(
        GnssRecord(rank, _GNSS, float(lon), float(lat), float(alt), 0.0, dop)
        for (rank, _, dop), (lat, lon, alt) in zip(located, geodetic, strict=True)
    )
    centers = np.array([shots[rank].pose.center for rank, _, _ in located])
    off = float(np.median(np.linalg.norm((centers - positions)[:, :2], axis=1)))
    notes = [
        f"{len(located)} of {len(shots)} photos have a GPS position, {off:.2g} m (median, "
        "horizontally) from where they were reconstructed"
    ]
    if reference.parent is None:  # a file of its own
        notes += notes_on_unread(reference)
    if np.abs(geodetic[:, 2] - _UNUSED_ALTITUDE).max() < 0.01:
        notes.append("the altitudes of the GPS positions are OpenSfM's placeholder, not measured")
    # Horizontally: altitudes are worse, or not measured.
    doubt = scale_doubt(centers[:, :2], positions[:, :2])
    if doubt is not None:
        notes.append(f"the world does not count as metric: {doubt}")
    return fixes, doubt is None, notes
