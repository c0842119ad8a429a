"""Ten seconds of a walk through the sample's room, for readers without a phone at hand.

    .venv/bin/python examples/film.py

Writes ``walk.mp4``, a video of 50 frames, and ``photo.jpg``, which the same camera took beside the
path of the video. The walk goes once around the room and looks across it, as the tutorial asks for:
a walk that turns much, moves little and does not come back makes a bent map.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

from samples.film import film_walk
from samples.render import render_photo
from samples.scene import make_room
from samples.trajectories import stereo_rig
from visloc.geometry import Pose

FRAMES, FRAMES_PER_SECOND = 50, 5
CAMERA = stereo_rig(480, 360)["left"].camera


def pose_at(loops: float, *, size: float = 1.0) -> Pose:
    """Return cam_from_world after a share of the walk around the room.

    Args:
        loops: 0 at the beginning, 1 when the walk is back there.
        size: of the loop; below 1 it runs further inside.
    """
    angle = 2 * np.pi * loops
    x, y = 1.6 * size * np.cos(angle), 1.0 * size * np.sin(angle)
    position = np.array([x, y, 1.45 + 0.1 * np.sin(3 * angle)])
    forward = np.array([-x, -y, 1.15]) - [x, y, position[2]]
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.array([right, np.cross(forward, right), forward])
    return Pose(rotation, -rotation @ position)


def poses_of_film() -> list[Pose]:
    """Return cam_from_world of each frame."""
    return [pose_at(frame / FRAMES) for frame in range(FRAMES)]


def main() -> None:
    """Write the video and the photo."""
    scene = make_room(0)
    film_walk(Path("walk.mp4"), scene, CAMERA, poses_of_film(), rate=FRAMES_PER_SECOND)
    photo = render_photo(scene, CAMERA, pose_at(0.25, size=0.85), np.random.default_rng(1))
    cv2.imwrite("photo.jpg", cv2.cvtColor(photo, cv2.COLOR_RGB2BGR))
    sys.stdout.write("written: walk.mp4, ten seconds in a painted room, and photo.jpg\n")


if __name__ == "__main__":
    main()
