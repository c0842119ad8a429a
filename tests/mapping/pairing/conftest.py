"""Scenes of hand-made cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from mapping.pairing import Scene
from visloc.geometry import Camera, Pose

# 90 degrees across and down: the image is the square [-1, 1] at depth 1.
SQUARE = Camera("PINHOLE", 480, 480, (240.0, 240.0, 240.0, 240.0))


def _looking(center: ArrayLike, yaw_deg: float = 0.0, pitch_deg: float = 0.0) -> Pose:
    """Make a pose; yaw 0 looks along +z of the world, 90 along +x; y of the world is down."""
    yaw, pitch = np.radians([yaw_deg, pitch_deg])
    about_y = np.array([[np.cos(yaw), 0, -np.sin(yaw)], [0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)]])
    about_x = np.array(
        [[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]]
    )
    rotation = about_x @ about_y
    return Pose(rotation, -rotation @ np.asarray(center, dtype=np.float64))


def _scene(
    poses: Sequence[Pose | None] = (),
    *,
    names: Sequence[str] | None = None,
    sensors: Sequence[str] | None = None,
    timestamps: Sequence[int] | None = None,
    cameras: Sequence[Camera | None] | None = None,
    global_descriptors: Mapping[str, NDArray[np.float32]] | None = None,
    tracks: ArrayLike = (),
) -> Scene:
    """Make a scene of as many photos as there are poses or names."""
    count = len(names or poses)
    return Scene(
        names=tuple(names or (f"{row}.jpg" for row in range(count))),
        sensors=tuple(sensors or ["cam"] * count),
        timestamps=np.array(timestamps or range(count), dtype=np.int64),
        cameras=tuple(cameras or [SQUARE] * count),
        cam_from_world=tuple(poses or [None] * count),
        global_descriptors=global_descriptors or {},
        tracks=np.array(tracks, dtype=np.int64).reshape(-1, 2),
    )


def _random_poses(count: int, seed: int, extent: Sequence[float]) -> list[Pose]:
    """Make cameras in a box, looking anywhere, mostly level, as if held by hand."""
    rng = np.random.default_rng(seed)
    centers = rng.uniform(0.0, 1.0, (count, 3)) * extent
    yaws, pitches = rng.uniform(0, 360, count), rng.normal(0, 12, count)
    return [_looking(c, yaw, pitch) for c, yaw, pitch in zip(centers, yaws, pitches, strict=True)]


@pytest.fixture(scope="session")
def looking() -> Callable[..., Pose]:
    return _looking


@pytest.fixture(scope="session")
def make_scene() -> Callable[..., Scene]:
    return _scene


@pytest.fixture(scope="session")
def random_poses() -> Callable[..., list[Pose]]:
    return _random_poses
