"""Maps of boards in space, made of numbers alone: who sees what is known exactly."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from visloc.archive import (
    FingerprintRecord,
    GlobalFeatures,
    ImageRecord,
    Landmarks,
    Map,
    MapContent,
    open_map,
    pose_row,
    write_map,
)
from visloc.geometry import Camera, Pose
from visloc.pose.reprojection import project

CAMERA = Camera("PINHOLE", 320, 240, (220.0, 220.0, 160.0, 120.0))
MakeMap = Callable[..., Map]
_DIM = 32


def _looking(position: Sequence[float], yaw_deg: float) -> Pose:
    """``cam_from_world`` of a level camera; yaw from the world's x to y, z is up."""
    yaw = math.radians(yaw_deg)
    forward = np.array([math.cos(yaw), math.sin(yaw), 0.0])
    right = np.array([math.sin(yaw), -math.cos(yaw), 0.0])
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Pose(rotation, -rotation @ np.array(position, dtype=np.float64))


def _room(random: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Points on the four walls of a room of 6 by 4 by 2.6 metres about the origin."""
    along, height = random.uniform(-1, 1, count), random.uniform(-1.3, 1.3, count)
    wall = np.arange(count) % 4
    x = np.select([wall == 0, wall == 1], [3.0, -3.0], 3.0 * along)
    y = np.select([wall == 2, wall == 3], [2.0, -2.0], 2.0 * along)
    return np.column_stack([x, y, height])


@pytest.fixture(scope="session")
def looking() -> Callable[[Sequence[float], float], Pose]:
    return _looking


@pytest.fixture(scope="session")
def room() -> Callable[[np.random.Generator, int], NDArray[np.float64]]:
    return _room


@pytest.fixture(scope="session")
def make_map(tmp_path_factory: pytest.TempPathFactory) -> MakeMap:
    """Write and open a map of points (P, 3) seen by cameras at poses.

    A landmark looks a little different in every photo, the more so the further aside it is seen
    from; points that no photo sees are left out. Those of the same number in ``look`` look alike.
    """

    def make(
        points: NDArray[np.float64],
        poses: Sequence[Pose],
        *,
        method: str = "rgbd",
        gravity: tuple[float, float, float] | None = (0.0, 0.0, -1.0),
        metric: bool = True,
        timestamps: Sequence[int] | None = None,
        cameras: Sequence[str] | None = None,
        rigs: dict[str, dict[str, Pose]] | None = None,
        ready_made: bool = False,
        seed: int = 0,
        nearest: float = 0.1,
        look: NDArray[np.int64] | None = None,
    ) -> Map:
        random = np.random.default_rng(seed)
        points = points.astype(np.float32)
        looks = random.normal(size=(len(points), _DIM))
        turns = 3.0 * random.normal(size=(len(points), 3, _DIM))
        if look is not None:
            looks, turns = looks[look], turns[look]
        observed, keypoints, rows, offsets = [], [], [], [0]
        for pose in poses:
            in_cam = pose.apply(points.astype(np.float64))
            pixels = project(CAMERA, in_cam)
            with np.errstate(invalid="ignore"):
                inside = (in_cam[:, 2] > nearest) & (pixels > 0).all(axis=1)
                inside &= (pixels < (CAMERA.width, CAMERA.height)).all(axis=1)
            seen = np.flatnonzero(inside)
            rays = points[seen] - pose.center
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            found = looks[seen] + np.einsum("ni,nid->nd", rays, turns[seen])
            found += 0.3 * random.normal(size=found.shape)
            rows.append((found / np.linalg.norm(found, axis=1, keepdims=True)).astype(np.float32))
            observed.append(seen)
            keypoints.append(pixels[seen] + random.normal(scale=0.3, size=(len(seen), 2)))
            offsets.append(offsets[-1] + len(seen))
        known, renumbered = np.unique(np.concatenate(observed), return_inverse=True)
        names = list(cameras) if cameras is not None else ["cam"] * len(poses)
        tracks = np.bincount(renumbered, minlength=len(known))
        directions = np.array([[*p.rotation[2], *(0.3 * p.center), 1.0, 0.0] for p in poses])
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        kind = "kapture:" if ready_made else ""
        content = MapContent(
            metric=metric,
            method=method,
            settings={},
            notes=(),
            cameras=dict.fromkeys(names, CAMERA),
            rigs={
                rig: {key: pose_row(pose) for key, pose in members.items()}
                for rig, members in (rigs or {}).items()
            },
            images=tuple(
                ImageRecord(f"{i}.jpg", name, i if timestamps is None else timestamps[i])
                for i, name in enumerate(names)
            ),
            image_poses=np.array([pose_row(pose) for pose in poses]),
            landmarks=Landmarks(
                origin=np.zeros(3),
                points=points[known],
                track_lengths=tracks.astype(np.uint16),
                errors_px=np.full(len(known), np.nan, dtype=np.float32),
                angles_deg=np.full(len(known), np.nan, dtype=np.float32),
                offsets=np.array(offsets),
                observed=renumbered.astype(np.uint32),
                keypoints=np.concatenate(keypoints).astype(np.float32),
            ),
            local_fingerprint=FingerprintRecord(name=f"{kind}sift", revision=1, parameters={}),
            max_keypoints=5000,
            descriptor_dim=_DIM,
            descriptors=lambda: iter(rows),
            global_features=(
                GlobalFeatures(
                    FingerprintRecord(name=f"{kind}gem", revision=1, parameters={}),
                    directions.astype(np.float32),
                    {},
                ),
            ),
            gravity=gravity,
        )
        folder = Path(tmp_path_factory.mktemp("map"))
        write_map(folder, content, map_id="room", version="v1", created="2026-01-02T03:04:05+00:00")
        return open_map(folder)

    return make


@pytest.fixture(scope="session")
def half_mapped_room(make_map: MakeMap) -> Map:
    """A room whose photos all look at the wall x = 3 and its surroundings, from near and far."""
    points = _room(np.random.default_rng(0), 2400)
    poses = [
        _looking((x, y, 0.0), yaw)
        for x in (-1.5, 0.0, 1.2)
        for y in (-0.8, 0.8)
        for yaw in (-35.0, 0.0, 35.0)
    ]
    return make_map(points, poses)
