"""A good map of a few kilobytes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from visloc.archive import (
    Anchor,
    FingerprintRecord,
    Geodetic,
    GlobalFeatures,
    ImageRecord,
    Landmarks,
    MapContent,
    pose_row,
    write_map,
)
from visloc.geometry import Camera, Pose
from visloc.retrieval.index import IndexKind

LOCAL_DIM, GLOBAL_DIM = 8, 4


def write_tiny_map(
    folder: Path, local_features: str = "sift", index: IndexKind = IndexKind.AUTO
) -> None:
    """Write a map of three photos that see five landmarks seven times, into a new folder."""
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(7, LOCAL_DIM)).astype(np.float32)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    content = MapContent(
        metric=True,
        method="triangulation",
        settings={"max_error_px": 4.0},
        notes=("one photo has no pose",),
        cameras={"cam": Camera("OPENCV", 64, 48, (50.0, 50.0, 32.0, 24.0, 0.1, 0.0, 0.0, 0.0))},
        rigs={"rig": {"cam": (0.6, 0.8, 0.0, 0.0, 1.0, 2.0, 3.0)}},
        images=tuple(ImageRecord(name=f"{i}.jpg", camera="cam", timestamp=i) for i in range(3)),
        image_poses=np.array(
            [
                pose_row(Pose.from_quaternion(rng.normal(size=4), rng.normal(size=3)))
                for _ in range(3)
            ]
        ),
        landmarks=Landmarks(
            origin=np.array([500_000.0, 0.0, 10.0]),
            points=rng.normal(size=(5, 3)).astype(np.float32),
            track_lengths=np.array([2, 1, 1, 2, 1], dtype=np.uint16),
            errors_px=np.ones(5, dtype=np.float32),
            angles_deg=np.full(5, np.nan, dtype=np.float32),
            offsets=np.array([0, 3, 3, 7]),
            observed=np.array([0, 1, 3, 0, 2, 3, 4], dtype=np.uint32),
            keypoints=rng.uniform(0, 48, (7, 2)).astype(np.float32),
            colors=rng.integers(0, 256, (5, 3), np.uint8),
        ),
        local_fingerprint=FingerprintRecord(name=local_features, revision=1, parameters={}),
        max_keypoints=100,
        descriptor_dim=LOCAL_DIM,
        descriptors=lambda: iter([rows[:3], rows[3:3], rows[3:]]),
        global_features=(
            GlobalFeatures(
                FingerprintRecord(name="densevlad", revision=1, parameters={}),
                np.eye(3, GLOBAL_DIM, dtype=np.float32),
                {"vocabulary": rng.normal(size=(2, 4)).astype(np.float32)},
            ),
        ),
        anchor=Anchor(
            kind="gnss",
            images=3,
            rms=0.5,
            geodetic=Geodetic(latitude_deg=45.0, longitude_deg=5.8, altitude_m=300.0),
        ),
        gravity=(0.0, 0.0, -1.0),
        index=index,
    )
    folder.mkdir(parents=True)
    write_map(folder, content, map_id="room", version="v1", created="2026-01-02T03:04:05+00:00")
