"""A synthetic sample dataset: `mapping sample DIR`.

``DIR/mapping`` and ``DIR/query`` become kapture 1.1 datasets of the same room, with exact poses.
A rig of two cameras and a GNSS receiver walks through it; the mapping run has a depth map
for every photo. Timestamps are milliseconds; the query run comes an hour after the mapping run.
"""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from mapping.progress import ItemProgress
from samples.render import render_depth, render_photo
from samples.scene import Scene, make_room
from samples.textures import Image
from samples.trajectories import (
    RigCamera,
    mapping_trajectory,
    query_trajectory,
    stereo_rig,
)
from visloc.errors import refuse
from visloc.geometry import Pose
from visloc.kapture import Dataset, FileRecord, GnssRecord, Sensor, write_dataset

RIG_ID, GNSS_ID = "rig", "gnss"
# The world's origin on the ellipsoid of WGS 84. The world is the local east-north-up frame
# there: x east, y north, z up.
ANCHOR_LATITUDE_DEG, ANCHOR_LONGITUDE_DEG, ANCHOR_ALTITUDE_M = 45.2178, 5.8083, 310.0
GNSS_HORIZONTAL_SIGMA_M, GNSS_VERTICAL_SIGMA_M = 0.8, 1.5

_MAX_IMAGES = 10_000
_SMALLEST, _LARGEST = (64, 48), 4096
_MAPPING_START_MS, _QUERY_START_MS = 1_700_000_000_000, 1_700_003_600_000
_JPEG_QUALITY = 95
_WGS84_A, _WGS84_E2 = 6378137.0, 6.69437999014e-3


def write_sample(
    root: Path,
    *,
    images: int = 60,
    seed: int = 0,
    size: tuple[int, int] = (640, 480),
    progress: ItemProgress | None = None,
) -> None:
    """Render the sample and write it; nothing is left under ``root`` if this fails.

    The same arguments give the same bytes on the same machine and library versions.

    Args:
        root: absent or an empty folder.
        images: mapping photos in total. The rig takes two at a time; an odd last one comes from
            the left camera alone. There are a third as many queries.
        seed: of pictures in the room, sensor noise and GNSS errors.
        size: width, height in pixels.
        progress: called after each photo with the photos done, and the total.
    """
    _check(root, images, seed, size)
    root = root.resolve()
    num_queries = max(1, round(images / 3))
    runs = _runs(images, num_queries)
    rig = stereo_rig(*size)
    partial = root.with_name(f".{root.name}.{os.getpid()}.partial")
    shutil.rmtree(partial, ignore_errors=True)  # of a killed process with the same id
    try:
        partial.mkdir(parents=True)
        scene = make_room(seed)
        num_done = 0
        for run in runs:
            for _ in _write_run(partial / run.name, scene, rig, run, seed):
                num_done += 1
                if progress is not None:
                    progress(num_done, images + num_queries)
        readme = _readme(images, num_queries, seed, size)
        (partial / "README.txt").write_text(readme, encoding="utf-8")
        if root.exists():
            root.rmdir()  # empty, as checked; fails if that has changed
        partial.rename(root)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


@dataclass(frozen=True, slots=True)
class _Run:
    """One walk of the rig.

    Attributes:
        name: folder, and first part of every image name.
        number: part of the seed of its noise.
        num_photos: two per instant; the last right one may be missing.
    """

    name: str
    number: int
    rig_from_world: Sequence[Pose]
    num_photos: int
    start_ms: int
    step_ms: int
    with_depth: bool

    def timestamp(self, instant: int) -> int:
        return self.start_ms + instant * self.step_ms


def _check(root: Path, images: int, seed: int, size: tuple[int, int]) -> None:
    if not 2 <= images <= _MAX_IMAGES:
        raise refuse("sample.images", field="--images", expected=f"2 to {_MAX_IMAGES}", got=images)
    if not 0 <= seed < 2**31:
        raise refuse("sample.seed", field="--seed", expected=f"0 to {2**31 - 1}", got=seed)
    width, height = size
    if not (_SMALLEST[0] <= width <= _LARGEST and _SMALLEST[1] <= height <= _LARGEST):
        raise refuse(
            "sample.size",
            "photos of this size cannot be made",
            field="--size",
            expected=f"{_SMALLEST[0]}x{_SMALLEST[1]} to {_LARGEST}x{_LARGEST} pixels",
            got=f"{width}x{height}",
        )
    if root.exists() and not (root.is_dir() and not any(root.iterdir())):
        raise refuse("sample.exists", field=str(root))


def _runs(num_mapping: int, num_queries: int) -> tuple[_Run, _Run]:
    mapping_poses = mapping_trajectory(math.ceil(num_mapping / 2))
    query_poses = query_trajectory(math.ceil(num_queries / 2), len(mapping_poses))
    return (
        _Run("mapping", 1, mapping_poses, num_mapping, _MAPPING_START_MS, 1000, with_depth=True),
        _Run("query", 2, query_poses, num_queries, _QUERY_START_MS, 3000, with_depth=False),
    )


def _write_run(
    root: Path, scene: Scene, rig: Mapping[str, RigCamera], run: _Run, seed: int
) -> Iterator[FileRecord]:
    """Write one dataset, yielding after each photo."""
    images: list[FileRecord] = []
    depth_maps: list[FileRecord] = []
    for instant, rig_from_world in enumerate(run.rig_from_world):
        for name, mounted in rig.items():
            if len(images) == run.num_photos:
                break
            noise = _generator(seed, run.number, len(images))
            cam_from_world = mounted.cam_from_rig @ rig_from_world
            stem = f"{run.name}/{name}/{instant + 1:04d}"
            image = FileRecord(run.timestamp(instant), name, f"{stem}.jpg")
            photo = render_photo(scene, mounted.camera, cam_from_world, noise)
            _write_file(root, image, _jpeg(photo))
            if run.with_depth:
                depth_map = FileRecord(image.timestamp, _depth_id(name), f"{stem}.depth")
                depth = render_depth(scene, mounted.camera, cam_from_world)
                _write_file(root, depth_map, depth.astype("<f4").tobytes())
                depth_maps.append(depth_map)
            images.append(image)
            yield image
    write_dataset(
        Dataset(
            root=root,
            sensors=_sensors(rig, with_depth=run.with_depth),
            rigs={RIG_ID: _mounting(rig, with_depth=run.with_depth)},
            trajectories={
                (run.timestamp(i), RIG_ID): pose for i, pose in enumerate(run.rig_from_world)
            },
            images=tuple(sorted(images, key=_order)),
            depth_maps=tuple(sorted(depth_maps, key=_order)),
            gnss=_gnss(run, _generator(seed, run.number)),
        )
    )


def _sensors(rig: Mapping[str, RigCamera], *, with_depth: bool) -> dict[str, Sensor]:
    sensors = {name: Sensor.with_camera(name, mounted.camera) for name, mounted in rig.items()}
    if with_depth:
        sensors |= {
            _depth_id(name): Sensor.with_camera(_depth_id(name), mounted.camera, "depth")
            for name, mounted in rig.items()
        }
    return sensors | {GNSS_ID: Sensor(GNSS_ID, "", "gnss", ("EPSG:4326",), None)}


def _mounting(rig: Mapping[str, RigCamera], *, with_depth: bool) -> dict[str, Pose | None]:
    """Return ``sensor_from_rig``. Depth is registered to the photos; the antenna is the origin."""
    mounting: dict[str, Pose | None] = {name: each.cam_from_rig for name, each in rig.items()}
    if with_depth:
        mounting |= {_depth_id(name): each.cam_from_rig for name, each in rig.items()}
    return mounting | {GNSS_ID: Pose.identity()}


def _gnss(run: _Run, noise: np.random.Generator) -> tuple[GnssRecord, ...]:
    """Return one noisy fix per instant.

    Over a few metres, a plane scaled by the radii of curvature (meridian, prime vertical) at the
    anchor replaces the ellipsoid with an error below a micrometre.
    """
    latitude = math.radians(ANCHOR_LATITUDE_DEG)
    bend = 1.0 - _WGS84_E2 * math.sin(latitude) ** 2
    meridian_m = _WGS84_A * (1.0 - _WGS84_E2) / bend**1.5 + ANCHOR_ALTITUDE_M
    parallel_m = (_WGS84_A / math.sqrt(bend) + ANCHOR_ALTITUDE_M) * math.cos(latitude)
    sigma_m = (GNSS_HORIZONTAL_SIGMA_M, GNSS_HORIZONTAL_SIGMA_M, GNSS_VERTICAL_SIGMA_M)
    records = []
    for instant, rig_from_world in enumerate(run.rig_from_world):
        east, north, up = (rig_from_world.center + noise.normal(0.0, sigma_m)).tolist()
        timestamp = run.timestamp(instant)
        records.append(
            GnssRecord(
                timestamp=timestamp,
                sensor_id=GNSS_ID,
                x=round(ANCHOR_LONGITUDE_DEG + math.degrees(east / parallel_m), 9),
                y=round(ANCHOR_LATITUDE_DEG + math.degrees(north / meridian_m), 9),
                z=round(ANCHOR_ALTITUDE_M + up, 3),
                utc=timestamp / 1000,
                dop=1.0,
            )
        )
    return tuple(records)


def _generator(seed: int, *purpose: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=purpose))


def _depth_id(camera_id: str) -> str:
    return f"{camera_id}_depth"


def _order(record: FileRecord) -> tuple[int, str, str]:
    return record.timestamp, record.sensor_id, record.path


def _jpeg(photo: Image) -> bytes:
    """Encode (H, W, 3) RGB as JPEG, a quarter of the size of PNG; quality 95 costs no accuracy."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    _, encoded = cv2.imencode(".jpg", cv2.cvtColor(photo, cv2.COLOR_RGB2BGR), quality)
    return encoded.tobytes()


def _write_file(root: Path, record: FileRecord, content: bytes) -> None:
    path = root / "sensors" / "records_data" / record.path
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


def _readme(num_mapping: int, num_queries: int, seed: int, size: tuple[int, int]) -> str:
    return f"""A synthetic room for visual localization, made by code, with exact poses.

mapping/   kapture 1.1: {num_mapping} photos, a depth map for each, poses, GNSS
query/     kapture 1.1: {num_queries} photos of the same room from other places, true poses, GNSS

Seed {seed}, {size[0]} x {size[1]} pixels, world in metres with z up, timestamps in milliseconds.
The world is the local east (x), north (y), up (z) frame of WGS 84 at latitude
{ANCHOR_LATITUDE_DEG}, longitude {ANCHOR_LONGITUDE_DEG} degrees, altitude {ANCHOR_ALTITUDE_M} m.
GNSS fixes are of the rig's origin and scatter by {GNSS_HORIZONTAL_SIGMA_M} m east and north
and {GNSS_VERTICAL_SIGMA_M} m up (standard deviations).
"""
