"""Approximates poses with kapture-localization; run by ``benchmarks.coarse`` in its environment.

python coarse_peer.py GIVEN.npz TOLD.npy
"""

from __future__ import annotations

import sys

import numpy as np
import quaternion
from kapture import PoseTransform
from kapture.algo.pose_operations import average_pose_transform_weighted
from kapture_localization.image_retrieval.pairing import StackedGlobalFeatures
from kapture_localization.pose_approximation import PoseApproximationMethods as Methods
from kapture_localization.pose_approximation.weight_estimation import get_interpolation_weights
from numpy.typing import NDArray

_Numbers = NDArray[np.float64]

_METHODS = {
    "ewb": Methods.equal_weighted_barycenter,
    "bdi": Methods.barycentric_descriptor_interpolation,
    "csi": Methods.cosine_similarity,
}


def main(given: str, told: str) -> None:
    """Write poses, cam_from_world as qw qx qy qz tx ty tz: (methods, top_k, queries, 7)."""
    with np.load(given) as arrays:
        queries, photos, rows = arrays["queries"], arrays["photos"], arrays["rows"]
        poses, numbers, methods = arrays["poses"], arrays["top_k"], arrays["methods"]
    found = [
        [
            [
                _approximated(_METHODS[method], query, rows[best[:k]], poses[best[:k]])
                for query, best in zip(queries, photos, strict=True)
            ]
            for k in numbers.tolist()
        ]
        for method in methods.tolist()
    ]
    np.save(told, np.array(found))


def _approximated(method: Methods, query: _Numbers, rows: _Numbers, poses: _Numbers) -> list[float]:
    of_query = StackedGlobalFeatures(np.array(["query"]), query[None])
    of_map = StackedGlobalFeatures(np.arange(len(rows)), rows)
    (weighted,) = get_interpolation_weights(
        method, of_query, of_map, len(rows), {"alpha": 8.0}
    ).values()
    world_from_cam = [PoseTransform(poses[i][:4], poses[i][4:]).inverse() for i, _ in weighted]
    weights = [float(weight) for _, weight in weighted]
    pose = average_pose_transform_weighted(world_from_cam, weights).inverse()
    return [*quaternion.as_float_array(pose.r).tolist(), *np.ravel(pose.t).tolist()]


if __name__ == "__main__":
    main(*sys.argv[1:])
