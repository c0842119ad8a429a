"""A walk through the sample world as a phone films it: noise, slight blur, a video file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from samples.render import render_photo
from samples.scene import Scene
from samples.textures import Image
from visloc.geometry import Camera, Pose

# Of a phone indoors: one per cent of the whole range, and an edge that is a pixel wide.
_NOISE_GREY_LEVELS, _BLUR_SIGMA_PX = 2.55, 0.7


def film_walk(
    path: Path,
    scene: Scene,
    camera: Camera,
    cams_from_world: Sequence[Pose],
    *,
    rate: int = 10,
    seed: int = 0,
) -> None:
    """Render a frame at each pose and write them as a video.

    Args:
        cams_from_world: one for each frame.
        rate: frames per second.
    """
    noise = np.random.default_rng(seed)

    def frame(cam_from_world: Pose) -> Image:
        sharp = render_photo(scene, camera, cam_from_world).astype(np.float32)
        grain = noise.standard_normal(sharp.shape, dtype=np.float32)
        seen = cv2.GaussianBlur(sharp, (0, 0), _BLUR_SIGMA_PX) + _NOISE_GREY_LEVELS * grain
        return np.asarray(np.clip(seen + 0.5, 0, 255), dtype=np.uint8)

    encode_video(path, (frame(pose) for pose in cams_from_world), rate=rate)


def encode_video(
    path: Path,
    pictures: Iterable[Image],
    *,
    rate: int = 10,
    codec: str = "libx264",
    options: Mapping[str, str] | None = None,
) -> None:
    """Write pictures (H, W, 3), uint8 RGB of one even size, as the frames of a video."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate, options=dict(options or {"crf": "18"}))
        assert isinstance(stream, av.VideoStream)
        stream.pix_fmt = "yuv420p"
        for index, picture in enumerate(pictures):
            if index == 0:
                stream.height, stream.width = picture.shape[:2]
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.time_base = index, Fraction(1, rate)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
