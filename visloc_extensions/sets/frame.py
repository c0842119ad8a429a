"""Transforms between the frame of a set and the frame of a tile, where queries are solved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from visloc.errors import refuse
from visloc.geometry import Pose, Similarity
from visloc.pose.motion import moved_pose, position_covariance
from visloc.priors import HeightBand, PosePrior, PositionPrior, Priors
from visloc.types import CoarsePose, InstantAnswer, RigPose


def answer_in_set(answer: InstantAnswer, set_from_tile: Similarity, set_ref: str) -> InstantAnswer:
    """Move the poses and the rig of a tile's answer to the set's frame and unit."""
    images = tuple(
        replace(image, cam_from_rig=scaled_device(image.cam_from_rig, set_from_tile.scale))
        for image in answer.images
    )
    rig = None if answer.pose is None else _moved_rig(answer.pose, set_from_tile)
    refusal = answer.refusal
    if refusal is not None:
        candidates = tuple(
            replace(
                each,
                rig_from_world=set_from_tile.move(each.rig_from_world),
                map=set_ref,
                tile=each.map,
            )
            for each in refusal.candidates
        )
        refusal = replace(refusal, candidates=candidates)
    coarse = None if answer.coarse is None else _moved_coarse(answer.coarse, set_from_tile)
    return replace(answer, images=images, pose=rig, refusal=refusal, coarse=coarse)


def down_in_set(priors: Priors, down: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
    """Return the unit vector (3,) that points down in a set's frame; None without a height prior.

    Args:
        priors: in the set's frame.
        down: (3,) the set's own direction; None when unknown.
    """
    if priors.height is None:
        return None
    if priors.gravity is not None and priors.gravity.world is not None:
        return priors.gravity.world
    if down is None:
        raise refuse(
            "priors.height",
            "this set does not know its down direction",
            field="priors.height",
            expected="a set of maps that were built with --gravity, or priors.gravity with its "
            "world",
        )
    return down


def priors_in_tile(
    priors: Priors, set_from_tile: Similarity, down: NDArray[np.float64] | None
) -> Priors:
    """Move priors from the set's frame to a tile's; without ``maps``, which chose the tile.

    Args:
        priors: in the set's frame; a GNSS prior is ``located``.
        down: (3,) the set's own direction; None when unknown.
    """
    tile_from_set = set_from_tile.inverse()
    scale, position, height = tile_from_set.scale, priors.position, priors.height
    gravity, pose, down = priors.gravity, priors.pose, down_in_set(priors, down)
    if position is not None:
        position = PositionPrior(tile_from_set.apply(position.position), scale * position.radius)
    if height is not None and down is not None:
        # Heights count from each frame's origin, but along the set's down. The tile's own down may
        # differ slightly, which far from its origin would move a band to another floor.
        lift = float(down @ set_from_tile.translation)
        x, y, z = (tile_from_set.rotation @ down).tolist()
        height = HeightBand(scale * (height.min + lift), scale * (height.max + lift), (x, y, z))
    if pose is not None:
        pose = PosePrior(*moved_pose(pose.device_from_world, pose.covariance, tile_from_set))
    if gravity is not None and gravity.world is not None:
        gravity = replace(gravity, world=tile_from_set.rotation @ gravity.world)
    gnss = priors.gnss
    if gnss is not None:
        assert gnss.fix_from_world is not None  # by the set, as the caller saw to
        gnss = replace(gnss, fix_from_world=gnss.fix_from_world @ set_from_tile)
    return Priors(position=position, height=height, pose=pose, gravity=gravity, gnss=gnss)


def scaled_device(cam_from_rig: Pose, scale: float) -> Pose:
    """Scale the position of a camera in its rig."""
    return Pose(cam_from_rig.rotation, scale * cam_from_rig.translation)


def _moved_rig(rig: RigPose, set_from_tile: Similarity) -> RigPose:
    pose, covariance = moved_pose(rig.rig_from_world, rig.covariance, set_from_tile)
    photo = rig.photo_covariance
    if photo is not None:
        _, photo = moved_pose(rig.rig_from_world, photo, set_from_tile)
    return replace(
        rig,
        rig_from_world=pose,
        covariance=covariance,
        position_std=_position_std(rig.rig_from_world, rig.covariance, set_from_tile),
        photo_covariance=photo,
    )


def _moved_coarse(coarse: CoarsePose, set_from_tile: Similarity) -> CoarsePose:
    pose, covariance = moved_pose(coarse.cam_from_world, coarse.covariance, set_from_tile)
    std = _position_std(coarse.cam_from_world, coarse.covariance, set_from_tile)
    return replace(coarse, cam_from_world=pose, covariance=covariance, position_std=std)


def _position_std(
    pose: Pose, covariance: NDArray[np.float64], a_from_b: Similarity
) -> NDArray[np.float64]:
    """Return standard deviations of a position along frame a's axes, from a pose in frame b."""
    # Computed in frame b, because far from the origin of frame a digits are lost.
    turned = a_from_b.rotation @ position_covariance(pose, covariance) @ a_from_b.rotation.T
    return np.asarray(a_from_b.scale * np.sqrt(np.maximum(np.diag(turned), 0.0)))
