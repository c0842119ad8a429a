"""Ten seconds of a walk through the sample's room, for readers without a phone at hand.

    .venv/bin/python examples/film.py

Writes ``walk.mp4``, a video of 50 frames, and ``photo.jpg``, another photo by the same camera.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from samples.film import film_walk
from samples.render import render_photo
from samples.scene import make_room
from samples.trajectories import mapping_trajectory, stereo_rig

rig = stereo_rig(320, 240)["left"]
# A third of the loop through the room.
poses = [rig.cam_from_rig @ pose for pose in mapping_trajectory(150)[:50]]
scene = make_room(0)
film_walk(Path("walk.mp4"), scene, rig.camera, poses, rate=5)
photo = render_photo(scene, rig.camera, poses[12], np.random.default_rng(1))
cv2.imwrite("photo.jpg", cv2.cvtColor(photo, cv2.COLOR_RGB2BGR))
