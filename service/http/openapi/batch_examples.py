"""Answers to rigs and sequences as a server gave them, with fewer digits, for /openapi.json."""

from __future__ import annotations

from typing import Any

RIG: dict[str, Any] = {
    "request_id": "279cf07e0be44ccd8756535dac99877a",
    "timestamp": 1700003600000,
    "status": "localized",
    "source": "estimated",
    "pose": {
        "rig_from_world": {
            "rotation_wxyz": [0.637246, 0.689947, -0.257152, 0.227517],
            "translation": [-0.592983, 1.61698, -0.720109],
        },
        "position": [1.02015, 0.256464, 1.54218],
        "orientation": [0.637246, -0.689947, 0.257152, -0.227517],
        "covariance": [
            *(1.43e-08, -1.49e-09, -3.57e-10, 4.49e-09, 3.74e-08, 2.26e-08),
            *(-1.49e-09, 1.12e-08, 4.92e-10, -3.12e-08, -3.93e-09, 3.23e-09),
            *(-3.57e-10, 4.92e-10, 3.01e-09, -6.39e-09, -2.8e-09, -4.72e-10),
            *(4.49e-09, -3.12e-08, -6.39e-09, 9.74e-08, 1.5e-08, -8.14e-09),
            *(3.74e-08, -3.93e-09, -2.8e-09, 1.5e-08, 1.01e-07, 5.88e-08),
            *(2.26e-08, 3.23e-09, -4.72e-10, -8.14e-09, 5.88e-08, 5.17e-08),
        ],
        "position_std": [0.000185, 0.000159, 0.00023],
        "orientation_std_deg": [0.00684, 0.00608, 0.00314],
    },
    "refusal": None,
    "images": [
        {
            "sensor": "left",
            "error": None,
            "cam_from_world": {
                "rotation_wxyz": [0.645125, 0.692498, -0.242447, 0.213259],
                "translation": [-0.523924, 1.61206, -0.709191],
            },
            "keypoints": 5000,
            "correspondences": 3743,
            "inliers": 3531,
            "retrieved": [
                {
                    "image": "mapping/right/0003.jpg",
                    "score": 0.38,
                    "similarities": {
                        "densevlad": 0.746,
                        "localvlad": 0.776,
                    },
                },
                {
                    "image": "mapping/left/0002.jpg",
                    "score": 0.315,
                    "similarities": {
                        "densevlad": 0.721,
                        "localvlad": 0.548,
                    },
                },
            ],
            "camera": {
                "model": "PINHOLE",
                "width": 640,
                "height": 480,
                "params": [457.6, 457.6, 321.92, 238.08],
                "source": "given",
            },
            "orientation": {
                "exif": 1,
                "read_as": "upright",
            },
        },
        {
            "sensor": "right",
            "error": None,
            "cam_from_world": {
                "rotation_wxyz": [0.628459, 0.689723, -0.269693, 0.23788],
                "translation": [-0.667429, 1.62594, -0.724045],
            },
            "keypoints": 5000,
            "correspondences": 3606,
            "inliers": 3445,
            "retrieved": [
                {
                    "image": "mapping/left/0002.jpg",
                    "score": 0.443,
                    "similarities": {
                        "densevlad": 0.882,
                        "localvlad": 0.89,
                    },
                },
                {
                    "image": "mapping/right/0002.jpg",
                    "score": 0.3,
                    "similarities": {
                        "densevlad": 0.603,
                        "localvlad": 0.597,
                    },
                },
            ],
            "camera": {
                "model": "PINHOLE",
                "width": 640,
                "height": 480,
                "params": [460.6, 460.6, 318.08, 242.4],
                "source": "given",
            },
            "orientation": {
                "exif": 1,
                "read_as": "upright",
            },
        },
    ],
    "correspondences": 7349,
    "inliers": 6976,
    "inlier_ratio": 0.949,
    "map": {
        "id": "sample",
        "version": "20261121T103543Z-f2f50fc8",
    },
    "seconds": {
        "queued": 1.4,
        "decode": 0.007,
        "local_features": 0.49,
        "global_features": 0.23,
        "retrieval": 0.00045,
        "matching": 2.0,
        "pose": 0.58,
    },
    "geopose": None,
    "geopose_ypr": None,
    "tile": None,
}
# The first two of three instants; of the second the photo was damaged.
SEQUENCE: dict[str, Any] = {
    "request_id": "c1e5dd49e9f247828a097a859433480d",
    "answers": [
        {
            "request_id": "c1e5dd49e9f247828a097a859433480d",
            "timestamp": 1700003600000,
            "status": "localized",
            "source": "estimated",
            "pose": {
                "rig_from_world": {
                    "rotation_wxyz": [0.637302, 0.689976, -0.257005, 0.227439],
                    "translation": [-0.593854, 1.61684, -0.7204],
                },
                "position": [1.02076, 0.256448, 1.5421],
                "orientation": [0.637302, -0.689976, 0.257005, -0.227439],
                "covariance": [
                    *(2.69e-08, -2.94e-09, 6.77e-10, 6.37e-09, 6.98e-08, 4.16e-08),
                    *(-2.94e-09, 2.79e-08, 1.19e-09, -7.61e-08, -7.41e-09, 4.16e-10),
                    *(6.77e-10, 1.19e-09, 6.57e-09, -1.38e-08, -6.09e-10, 1.05e-09),
                    *(6.37e-09, -7.61e-08, -1.38e-08, 2.3e-07, 2e-08, -5.51e-09),
                    *(6.98e-08, -7.41e-09, -6.09e-10, 2e-08, 1.87e-07, 1.08e-07),
                    *(4.16e-08, 4.16e-10, 1.05e-09, -5.51e-09, 1.08e-07, 9.03e-08),
                ],
                "position_std": [0.000309, 0.000211, 0.000318],
                "orientation_std_deg": [0.00939, 0.00958, 0.00465],
            },
            "refusal": None,
            "images": [
                {
                    "sensor": "left",
                    "error": None,
                    "cam_from_world": {
                        "rotation_wxyz": [0.645178, 0.692526, -0.242298, 0.21318],
                        "translation": [-0.524807, 1.61192, -0.709443],
                    },
                    "keypoints": 5000,
                    "correspondences": 3743,
                    "inliers": 3531,
                    "retrieved": [
                        {
                            "image": "mapping/right/0003.jpg",
                            "score": 0.38,
                            "similarities": {
                                "densevlad": 0.746,
                                "localvlad": 0.776,
                            },
                        },
                        {
                            "image": "mapping/left/0002.jpg",
                            "score": 0.315,
                            "similarities": {
                                "densevlad": 0.721,
                                "localvlad": 0.548,
                            },
                        },
                    ],
                    "camera": {
                        "model": "PINHOLE",
                        "width": 640,
                        "height": 480,
                        "params": [457.6, 457.6, 321.92, 238.08],
                        "source": "given",
                    },
                    "orientation": {
                        "exif": 1,
                        "read_as": "upright",
                    },
                },
            ],
            "correspondences": 3743,
            "inliers": 3531,
            "inlier_ratio": 0.943,
            "map": {
                "id": "sample",
                "version": "20261121T103543Z-f2f50fc8",
            },
            "seconds": {
                "queued": 6e-05,
                "decode": 0.0021,
                "local_features": 0.2,
                "global_features": 0.12,
                "retrieval": 0.00019,
                "matching": 0.99,
                "pose": 0.33,
                "sequence": 6.7e-05,
            },
            "geopose": None,
            "geopose_ypr": None,
            "tile": None,
        },
        {
            "request_id": "c1e5dd49e9f247828a097a859433480d",
            "timestamp": 1700003600500,
            "status": "filled",
            "source": "interpolated",
            "pose": {
                "rig_from_world": {
                    "rotation_wxyz": [0.632802, 0.698297, 0.240238, -0.23287],
                    "translation": [-0.630534, 1.37446, 0.0727864],
                },
                "position": [0.4791, 0.456239, 1.36173],
                "orientation": [0.632802, -0.698297, -0.240238, 0.23287],
                "covariance": [
                    *(0.0156, 4.39e-09, 5.41e-09, -6.95e-09, -0.00114, 0.0215),
                    *(4.39e-09, 0.0156, 4.72e-09, 0.00114, -6e-09, 0.00985),
                    *(5.41e-09, 4.72e-09, 0.0156, -0.0215, -0.00985, 1.01e-08),
                    *(-6.95e-09, 0.00114, -0.0215, 0.343, 0.0135, 0.000717),
                    *(-0.00114, -6e-09, -0.00985, 0.0135, 0.319, -0.00156),
                    *(0.0215, 0.00985, 1.01e-08, 0.000717, -0.00156, 0.349),
                ],
                "position_std": [0.56, 0.56, 0.56],
                "orientation_std_deg": [7.16, 7.16, 7.16],
            },
            "refusal": {
                "stage": "features",
                "reason": "no_usable_image",
                "message": "none of the images could be used",
            },
            "images": [
                {
                    "sensor": "left",
                    "error": {
                        "kind": "InvalidInput",
                        "code": "image.empty",
                        "message": "image: the photo has no bytes "
                        "(expected JPEG, PNG, WebP, TIFF or BMP, got 0 bytes)",
                    },
                    "cam_from_world": {
                        "rotation_wxyz": [0.629826, 0.690857, 0.253118, -0.248933],
                        "translation": [-0.526854, 1.37509, 0.0862609],
                    },
                    "keypoints": 0,
                    "correspondences": 0,
                    "inliers": 0,
                    "retrieved": [],
                    "camera": None,
                    "orientation": None,
                },
            ],
            "correspondences": 0,
            "inliers": 0,
            "inlier_ratio": 0.0,
            "map": {
                "id": "sample",
                "version": "20261121T103543Z-f2f50fc8",
            },
            "seconds": {
                "pose": 1.1e-05,
                "sequence": 0.00041,
            },
            "geopose": None,
            "geopose_ypr": None,
            "tile": None,
        },
    ],
}
