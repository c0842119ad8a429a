"""``mapping anchor``: where a map lies on Earth, from GNSS fixes, given points, or as it is said.

The map's world stays as it is; what is found is the similarity that takes it to east, north and up
of a place (``visloc.archive.Geodetic``). A map that is metric keeps its scale.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapping.frames.anchor import (
    EPSG_GEODETIC,
    GNSS_ERROR_M,
    MAX_DIRECTION_ERROR_DEG,
    MAX_SCALE_ERROR,
    align_positions,
    check_on_earth,
    coordinate_system,
    spread_of,
)
from mapping.frames.anchor_error import place_error
from mapping.stages.publishing import new_version, successor_of
from visloc.archive import Anchor, Geodetic, Map, MapStore, down_of, write_anchored
from visloc.errors import VislocError, refuse
from visloc.geodesy import enu_from_geodetic, middle_of
from visloc.geometry import Pose, Similarity
from visloc.kapture import Dataset

# Given points further off than this part of their spread are mistakes.
_POINT_ERROR = 0.05
_MAX_POINTS = 100_000
_MAX_FILE_BYTES = 64 * 2**20
_POINT_COLUMNS = ("x", "y", "z", "latitude", "longitude", "altitude")
_IMAGE_COLUMNS = ("image", "latitude", "longitude", "altitude")
# An axis whose level part is shorter than this is too steep for a direction on the ground.
_MIN_LEVEL = 0.1
_MIN_LENGTH = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Correspondences:
    """Points whose place is known in a map and on Earth.

    Attributes:
        kind: of the anchor that rests on them.
        points: (n, 3) in the map's world.
        positions: (n, 3) latitude, longitude (deg) and height (m).
    """

    kind: str
    names: tuple[str, ...]
    points: NDArray[np.float64]
    positions: NDArray[np.float64]
    max_error_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Georeference:
    """Where a map lies, and how well what was known agrees with it.

    Attributes:
        residuals_m: (n, 3) metres east, north and up, from where each was said to be to where
            the anchor puts it.
        agrees: (n,) which of them the anchor rests on.
    """

    anchor: Anchor
    names: tuple[str, ...]
    residuals_m: NDArray[np.float64]
    agrees: NDArray[np.bool_]


def correspondences_from_fixes(opened: Map, dataset: Dataset) -> Correspondences:
    """Pair the map's photos with the GNSS fixes of a dataset at their timestamps.

    A photo that the dataset has under the same name is looked up at the timestamp that it has
    there.
    """
    fixes = {fix.timestamp: fix for fix in dataset.gnss}
    times = {record.path: record.timestamp for record in dataset.images}
    found = [
        (row, fixes[time])
        for row, image in enumerate(opened.images)
        if (time := times.get(image.name, image.timestamp)) in fixes
    ]
    if not found:
        raise refuse(
            "anchor.fixes",
            field=str(dataset.root),
            got=f"{len(fixes)} fixes, {len(opened.images)} photos",
        )
    system = coordinate_system(dataset, {fix.sensor_id for _, fix in found})
    if system not in EPSG_GEODETIC:
        raise refuse(
            "gnss.epsg",
            "a place on Earth requires fixes in degrees",
            field=str(dataset.root / "sensors" / "sensors.txt"),
            expected=" or ".join(EPSG_GEODETIC),
            got=system,
        )
    positions = np.array([[fix.y, fix.x, fix.z] for _, fix in found])
    check_on_earth(positions, str(dataset.root / "sensors" / "records_gnss.txt"))
    rows = [row for row, _ in found]
    return Correspondences(
        "gnss",
        tuple(opened.images[row].name for row in rows),
        _centers(opened)[rows],
        positions,
        GNSS_ERROR_M,
    )


def read_correspondences(opened: Map, path: Path) -> Correspondences:
    """Read a CSV file of points, or of photos of the map, with their places on Earth.

    Its first line names the columns: x, y, z or image; latitude, longitude, altitude.
    """
    rows = _read_rows(path)
    by_image = "image" in rows[0][1]
    positions = np.array([[row[name] for name in _POINT_COLUMNS[3:]] for _, row in rows], float)
    check_on_earth(positions, str(path))
    if not by_image:
        points = np.array([[row[name] for name in "xyz"] for _, row in rows], float)
        names = tuple(f"line {number}" for number, _ in rows)
        # The spread on Earth, in metres: a unit of the map may be anything.
        local = enu_from_geodetic(positions, middle_of(positions))
        error = min(GNSS_ERROR_M, _POINT_ERROR * spread_of(local))
        return Correspondences("correspondences", names, points, positions, error)
    by_name = {image.name: row for row, image in enumerate(opened.images)}
    for number, row in rows:
        if row["image"] not in by_name:
            raise refuse(
                "anchor.image",
                field=f"{path}:{number}",
                expected=f"a name such as {opened.images[0].name}",
                got=row["image"],
            )
    names = tuple(str(row["image"]) for _, row in rows)
    points = _centers(opened)[[by_name[name] for name in names]]
    return Correspondences("correspondences", names, points, positions, GNSS_ERROR_M)


def georeference(opened: Map, known: Correspondences) -> Georeference:
    """Fit the place of a map to correspondences, robustly."""
    origin = middle_of(known.positions)
    local = enu_from_geodetic(known.positions, origin)
    found = align_positions(known.points, local, known.max_error_m)
    if isinstance(found, str):
        raise refuse("anchor.undetermined", count=len(known.names), why=found)
    similarity = found.similarity
    if opened.manifest.world.metric:
        similarity = _keep_scale(similarity, known.points[found.agrees], local[found.agrees])
    geodetic = _geodetic(origin, similarity)
    _check_down(opened, geodetic)
    agrees = found.agrees
    error = place_error(
        geodetic, known.points[agrees], local[agrees], fits_scale=not opened.manifest.world.metric
    )
    residuals = similarity.apply(known.points) - local
    rms = math.sqrt(float(np.mean(np.sum(residuals[found.agrees] ** 2, axis=1))))
    anchor = Anchor.model_validate(
        {
            "kind": known.kind,
            "images": int(found.agrees.sum()),
            "rms": rms / similarity.scale,  # in units of the world
            "geodetic": geodetic.model_copy(update={"error": error}),
        }
    )
    return Georeference(anchor, known.names, residuals, found.agrees)


def given_place(
    opened: Map,
    position: tuple[float, float, float],
    yaw_deg: float,
    *,
    accuracy: float | None = None,
    scale: float | None = None,
    gravity: tuple[float, float, float] | None = None,
) -> Georeference:
    """Say where the map lies.

    Args:
        position: latitude, longitude (deg) and height (m) of the world's (0, 0, 0).
        yaw_deg: direction of the level part of the world's x axis: 0 east, 90 north.
        accuracy: how far off the map may be, metres (rms); None when that is not known.
        scale: metres per unit of the world; for maps that are not metric.
        gravity: what points down in the world, of any length; for maps that do not know it.
    """
    check_on_earth(np.array([position]), "--latitude, --longitude, --altitude")
    world = opened.manifest.world
    if (scale is None) != world.metric or (scale is not None and not 0 < scale < math.inf):
        raise refuse(
            "anchor.scale",
            "the unit of this map is the metre"
            if world.metric
            else "the unit of this map has an unknown length in metres",
            field="--scale",
            expected="nothing" if world.metric else "metres per unit, more than 0",
            got="nothing" if scale is None else scale,
        )
    down = _given_down(opened, gravity)
    level = np.array([1.0, 0.0, 0.0]) + down * -down[0]
    length = float(np.linalg.norm(level))
    if not math.isfinite(yaw_deg) or length < _MIN_LEVEL:
        raise refuse(
            "anchor.yaw",
            "this is not a valid direction"
            if length >= _MIN_LEVEL
            else "the world's x axis is nearly vertical and has no horizontal direction; "
            "anchor the map with --correspondences",
            field="--yaw",
            got=yaw_deg,
        )
    # The world's axes that become east, north and up when yaw is 0, as rows.
    upright = np.array([level / length, np.cross(-down, level / length), -down])
    cos, sin = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    turned = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ upright
    similarity = Similarity(1.0 if scale is None else scale, turned, np.zeros(3))
    geodetic = _geodetic(np.array(position), similarity)
    rms = None if accuracy is None else accuracy / similarity.scale
    anchor = Anchor(kind="correspondences", images=0, rms=rms, geodetic=geodetic)
    return Georeference(anchor, (), np.zeros((0, 3)), np.zeros(0, bool))


def publish_anchored(opened: Map, found: Georeference, maps_dir: Path, *, force: bool) -> Path:
    """Publish a map with its place on Earth as a new version, and make it current."""
    if opened.geodetic is not None and not force:
        raise refuse("map.anchored", field="MAP", ref=opened.ref)
    map_id, based_on = opened.manifest.id, opened.manifest.version
    store = MapStore(maps_dir)
    with successor_of(opened, store), store.incoming() as incoming:
        version, created = new_version()
        version = write_anchored(opened, incoming, found.anchor, version=version, created=created)
        return store.publish(incoming, map_id, version, based_on=based_on)


def _centers(opened: Map) -> NDArray[np.float64]:
    poses = (Pose.from_quaternion(row[:4], row[4:]) for row in opened.image_poses)
    return np.array([pose.center for pose in poses])


def _geodetic(origin: NDArray[np.float64], similarity: Similarity) -> Geodetic:
    w, x, y, z = Pose(similarity.rotation, similarity.translation).rotation_wxyz.tolist()
    east, north, up = similarity.translation.tolist()
    return Geodetic(
        latitude_deg=float(origin[0]),
        longitude_deg=float(origin[1]),
        altitude_m=float(origin[2]),
        scale=similarity.scale,
        rotation_wxyz=(w, x, y, z),
        translation=(east, north, up),
    )


def _keep_scale(
    similarity: Similarity, points: NDArray[np.float64], local: NDArray[np.float64]
) -> Similarity:
    """Return the best rigid fit: its rotation is that of the similarity."""
    # Both the fit and the map may be off by as much.
    if abs(math.log(similarity.scale)) > 2 * MAX_SCALE_ERROR:
        raise refuse(
            "anchor.scale",
            "the unit of the map is the metre, but the places give it another length",
            expected=f"a unit of 1 m to within {2 * MAX_SCALE_ERROR:.0%}, or a map that was built "
            "with --not-metric",
            got=f"a unit of {similarity.scale:.4g} m",
        )
    translation = local.mean(axis=0) - similarity.rotation @ points.mean(axis=0)
    return Similarity(1.0, similarity.rotation, translation)


def _check_down(opened: Map, geodetic: Geodetic) -> None:
    """Refuse a place that contradicts a direction of gravity that was given."""
    if opened.gravity is None or opened.geodetic is not None:
        return
    angle_deg = _angle_deg(opened.gravity, down_of(geodetic))
    if angle_deg > MAX_DIRECTION_ERROR_DEG:
        raise refuse(
            "anchor.gravity",
            "the places and the map disagree about the down direction",
            expected=f"the same direction to within {MAX_DIRECTION_ERROR_DEG:g} degrees",
            got=f"{angle_deg:.1f} degrees",
        )


def _given_down(opened: Map, gravity: tuple[float, float, float] | None) -> NDArray[np.float64]:
    known = opened.gravity
    if gravity is None:
        if known is None:
            raise refuse(
                "anchor.gravity",
                "the down direction of the map is unknown",
                field="--gravity",
                expected="X,Y,Z in its world, such as 0,0,-1",
            )
        return known
    length = math.hypot(*gravity)
    if not _MIN_LENGTH <= length < math.inf:
        raise refuse(
            "anchor.gravity", field="--gravity", got=",".join(f"{value:g}" for value in gravity)
        )
    down = np.array(gravity) / length
    if known is not None and _angle_deg(known, down) > MAX_DIRECTION_ERROR_DEG:
        raise refuse(
            "anchor.gravity",
            "the map has another down direction; leave the option out",
            field="--gravity",
            expected=f"{','.join(f'{value:.4g}' for value in known)} to within "
            f"{MAX_DIRECTION_ERROR_DEG:g} degrees",
            got=",".join(f"{value:g}" for value in gravity),
        )
    return down


def _angle_deg(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return math.degrees(math.atan2(float(np.linalg.norm(np.cross(a, b))), float(a @ b)))


def _read_rows(path: Path) -> list[tuple[int, Mapping[str, str | float]]]:
    """Read the lines of a CSV file with their numbers."""

    def bad(line: int, message: str, expected: str, got: object) -> VislocError:
        return refuse("anchor.file", message, field=f"{path}:{line}", expected=expected, got=got)

    try:
        if path.stat().st_size > _MAX_FILE_BYTES:
            raise bad(
                1, "the file is too large", f"at most {_MAX_FILE_BYTES} bytes", path.stat().st_size
            )
        lines = list(csv.reader(path.read_text(encoding="utf-8-sig").split("\n")))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise bad(1, "the file cannot be read", "a CSV file", str(error)) from None
    header = tuple(name.strip() for name in lines[0]) if lines else ()
    columns: Sequence[str] = _IMAGE_COLUMNS if "image" in header else _POINT_COLUMNS
    if sorted(header) != sorted(columns):
        names = f"{','.join(_POINT_COLUMNS)} or {','.join(_IMAGE_COLUMNS)}"
        raise bad(1, "the first line must name the columns", names, ",".join(header))
    rows: list[tuple[int, Mapping[str, str | float]]] = []
    for number, line in enumerate(lines[1:], start=2):
        if not line:
            continue
        if len(line) != len(header) or len(rows) >= _MAX_POINTS:
            expected = f"{len(header)} fields, in at most {_MAX_POINTS} lines"
            raise bad(
                number,
                "the line does not have the columns of the first line",
                expected,
                ",".join(line),
            )
        try:
            rows.append(
                (
                    number,
                    {
                        name: text.strip() if name == "image" else _finite(text)
                        for name, text in zip(header, line, strict=True)
                    },
                )
            )
        except ValueError as error:
            raise bad(number, "the field is not a number", "finite numbers", str(error)) from None
    if not rows:
        raise bad(1, "there are no lines after the first", "three or more", 0)
    return rows


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(text)
    return number
