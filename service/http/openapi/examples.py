"""Answers as a server gave them, with fewer digits and photos, for /openapi.json."""

from __future__ import annotations

from typing import Any

LOCALIZED: dict[str, Any] = {
    "request_id": "f59a93b60e064f19b50d9e646d1fa166",
    "status": "localized",
    "pose": {
        "cam_from_world": {
            "rotation_wxyz": [0.645181, 0.692537, -0.242278, 0.213158],
            "translation": [-0.524988, 1.61195, -0.709412],
        },
        "position": [0.944435, 0.32084, 1.54349],
        "orientation": [0.645181, -0.692537, 0.242278, -0.213158],
        "covariance": [
            *(2.71e-08, -3.02e-09, -1.61e-10, 7.96e-09, 7.05e-08, 4.09e-08),
            *(-3.02e-09, 2.83e-08, 1.15e-09, -7.72e-08, -7.76e-09, 3.84e-09),
            *(-1.61e-10, 1.15e-09, 6.55e-09, -1.36e-08, -3.53e-09, -1.53e-10),
            *(7.96e-09, -7.72e-08, -1.36e-08, 2.32e-07, 2.56e-08, -1.19e-08),
            *(7.05e-08, -7.76e-09, -3.53e-09, 2.56e-08, 1.9e-07, 1.06e-07),
            *(4.09e-08, 3.84e-09, -1.53e-10, -1.19e-08, 1.06e-07, 8.96e-08),
        ],
        "position_std": [0.000301, 0.000223, 0.000318],
        "orientation_std_deg": [0.00942, 0.00964, 0.00464],
    },
    "refusal": None,
    "keypoints": 5000,
    "correspondences": 3740,
    "inliers": 3528,
    "inlier_ratio": 0.943,
    "retrieved": [
        {
            "image": "mapping/right/0003.jpg",
            "score": 0.38,
            "similarities": {"densevlad": 0.746, "localvlad": 0.776},
        },
        {
            "image": "mapping/left/0002.jpg",
            "score": 0.317,
            "similarities": {"densevlad": 0.721, "localvlad": 0.555},
        },
    ],
    "camera": {
        "model": "PINHOLE",
        "width": 640,
        "height": 480,
        "params": [457.6, 457.6, 321.92, 238.08],
        "source": "given",
    },
    "orientation": {"exif": 1, "read_as": "upright"},
    "map": {"id": "sample", "version": "20261121T111436.881Z-7f9cafe0"},
    "seconds": {
        "queued": 7.9e-05,
        "open_map": 0.00011,
        "decode": 0.0021,
        "local_features": 0.58,
        "global_features": 0.072,
        "retrieval": 0.00018,
        "matching": 0.41,
        "pose": 0.13,
    },
    "geopose": None,
    "geopose_ypr": None,
    "debug": None,
    "tile": None,
}
NOT_LOCALIZED: dict[str, Any] = {
    "request_id": "0a6d0ac8ef994eeeab1467fce2531da0",
    "status": "not_localized",
    "pose": None,
    "refusal": {
        "stage": "gate",
        "reason": "too_few_inliers",
        "message": "the best pose explains 18 matches, 30 are needed; "
        "is this photo of the mapped place?",
    },
    "keypoints": 5000,
    "correspondences": 1598,
    "inliers": 18,
    "inlier_ratio": 0.0113,
    "retrieved": [
        {
            "image": "mapping/left/0004.jpg",
            "score": 0.124,
            "similarities": {"densevlad": 0.347, "localvlad": 0.162},
        },
        {
            "image": "mapping/right/0003.jpg",
            "score": 0.117,
            "similarities": {"densevlad": 0.354, "localvlad": 0.134},
        },
    ],
    "camera": {
        "model": "SIMPLE_PINHOLE",
        "width": 1536,
        "height": 1024,
        "params": [1843.2, 768.0, 512.0],
        "source": "guess",
    },
    "orientation": {"exif": 1, "read_as": "upright"},
    "map": {"id": "sample", "version": "20261121T111436.881Z-7f9cafe0"},
    "seconds": {
        "queued": 0.0022,
        "open_map": 0.0002,
        "decode": 0.013,
        "local_features": 1.2,
        "global_features": 0.071,
        "retrieval": 0.00014,
        "matching": 0.54,
        "pose": 0.43,
    },
    "geopose": None,
    "geopose_ypr": None,
    "debug": None,
    "tile": None,
}
MAP: dict[str, Any] = {
    "id": "sample",
    "version": "20261121T111436.881Z-7f9cafe0",
    "created": "2026-11-21T11:14:36+00:00",
    "metric": True,
    "method": "rgbd",
    "local_features": "xfeat",
    "global_features": ["densevlad", "localvlad"],
    "images": 60,
    "landmarks": 199676,
    "observations": 297457,
    "extent": {"min": [-3.0, -2.25, -9.4e-08], "max": [3.0, 2.25, 2.8]},
    "size_bytes": 33037821,
    "down": [],
    "rigs": [{"id": "rig", "sensors": ["left", "right"]}],
    "current": True,
    "versions": [{"version": "20261121T111436.881Z-7f9cafe0", "current": True}],
    "content_hash": "7f9cafe0f2a3c1d54d0d8f3a5f3be7cf13a3f0a4e6c8b5d90b1c2d3e4f506172",
    "fusion": "gharm",
    "fusion_weights": {},
    "kind": "map",
    "num_tiles": None,
    "tiles": [],
    "anchor": {"kind": "dataset", "images": 60, "rms": None, "geodetic": None},
    "place": None,
}
SET: dict[str, Any] = MAP | {
    "id": "site",
    "method": None,
    "global_features": [],
    "observations": None,
    "size_bytes": 412345,
    "rigs": [],
    "fusion": None,
    "kind": "set",
    "num_tiles": 1,
    "tiles": [
        {
            "map": "sample",
            "version": MAP["version"],
            "set_from_tile": {
                "rotation_wxyz": [1.0, 0.0, 0.0, 0.0],
                "translation": [12.5, 0.0, 3.0],
                "scale": 1.0,
            },
            "extent": {"min": [9.5, -2.25, 3.0], "max": [15.5, 2.25, 5.8]},
            "images": 60,
        }
    ],
}

NEW_MAP: dict[str, Any] = MAP | {
    "version": "20261122T090500.120Z-51c09f3e",
    "created": "2026-11-22T09:05:00+00:00",
    "current": False,
    "versions": [
        {"version": "20261121T111436.881Z-7f9cafe0", "current": True},
        {"version": "20261122T090500.120Z-51c09f3e", "current": False},
    ],
    "content_hash": "51c09f3e8d7b6a594837261504f3e2d1c0bfae9d8c7b6a5948372615f4e3d2c1",
}
MAP_IMAGES: dict[str, Any] = {
    "map": {"id": "sample", "version": "20261121T111436.881Z-7f9cafe0"},
    "total": 60,
    "first": 0,
    "cameras": {
        "left": {
            "model": "PINHOLE",
            "width": 640,
            "height": 480,
            "params": [457.6, 457.6, 321.92, 238.08],
        }
    },
    "images": [
        {
            "name": "mapping/left/0000.jpg",
            "camera": "left",
            "position": [1.3, 0.0, 1.52],
            "orientation": [0.5, -0.5, 0.5, -0.5],
        }
    ],
}
READY: dict[str, Any] = {
    "ready": True,
    "maps": ["sample@20261121T111436.881Z-7f9cafe0"],
    "not_loaded": [
        {
            "id": "hall",
            "code": "map.file_missing",
            "message": "maps/hall/20261121T090211.240Z-51c09f3e/landmarks.npy: "
            "a file of the map is missing",
        }
    ],
}
LOADING: dict[str, Any] = {"ready": False, "maps": [], "not_loaded": []}
