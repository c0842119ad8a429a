"""Photos as the world spoils them: each function takes a photo and its camera, and returns both."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from visloc.geometry import CAMERA_MODELS, Camera
from visloc.photos.reading import Photo

Pixels = NDArray[np.uint8]

# How far a print is turned away from the camera, at most.
_PRINT_YAW_DEG, _PRINT_PITCH_DEG = 25.0, 15.0


def with_focal_length(photo: Photo, camera: Camera, factor: float) -> tuple[Photo, Camera]:
    """Return the photo as it is, with a focal length that is wrong by a factor."""
    params = tuple(
        value * factor if name in ("f", "fx", "fy") else value
        for name, value in zip(CAMERA_MODELS[camera.model], camera.params, strict=True)
    )
    return photo, replace(camera, params=params)


def mirrored(photo: Photo, camera: Camera) -> tuple[Photo, Camera]:
    """Swap left and right, as in a mirror; the principal point moves along."""
    return Photo(np.ascontiguousarray(photo.rgb[:, ::-1])), _with_centre(
        camera, lambda x, y: (camera.width - x, y)
    )


def enlarged_half(photo: Photo, camera: Camera) -> tuple[Photo, Camera]:
    """Enlarge the middle half to the size of the whole, and keep the camera of the whole.

    The true focal length is twice the one of the camera.
    """
    left, top = photo.width // 4, photo.height // 4
    middle = photo.rgb[top : top + photo.height // 2, left : left + photo.width // 2]
    return resized_to(middle, photo.width, photo.height), camera


def corner(photo: Photo, camera: Camera) -> tuple[Photo, Camera]:
    """Crop the upper left quarter, half as wide and half as high, and keep the whole's camera.

    The camera is of another size but of the same aspect, so it is scaled: wrongly.
    """
    quarter = photo.rgb[: photo.height // 2, : photo.width // 2]
    return Photo(np.ascontiguousarray(quarter)), camera


def stretched(photo: Photo, camera: Camera) -> tuple[Photo, Camera]:
    """Squeeze the photo to three quarters of its height; the camera keeps its focal length."""
    height = photo.height * 3 // 4
    centred = _with_centre(camera, lambda x, y: (x, y * height / photo.height))
    return resized_to(photo.rgb, photo.width, height), replace(centred, height=height)


def cut_to(photo: Photo, camera: Camera, width: int, height: int) -> tuple[Photo, Camera]:
    """Cut the middle of a photo to the aspect of a size, and scale it to that size.

    The camera that is returned is the true one.

    Args:
        photo: pixels.
        camera: without distortion, or with a distortion about its principal point.
        width: the result's width, pixels.
        height: the result's height, pixels.
    """
    scale = max(width / photo.width, height / photo.height)
    cut_width, cut_height = round(width / scale), round(height / scale)
    left, top = (photo.width - cut_width) // 2, (photo.height - cut_height) // 2
    cut = photo.rgb[top : top + cut_height, left : left + cut_width]
    centred = _with_centre(camera, lambda x, y: (x - left, y - top))
    whole = replace(centred, width=cut_width, height=cut_height)
    return resized_to(cut, width, height), whole.scaled(width, height)


def print_corners(
    photo: Photo, scene: Camera, share: float, random: np.random.Generator
) -> NDArray[np.float64]:
    """Hang a print of a photo somewhere in the view of a camera, turned a little away from it.

    Args:
        photo: what is printed.
        scene: the camera that sees the print.
        share: width of the print in the scene, as a share of the scene's width.
        random: draws place and orientation.

    Returns:
        (4, 2) pixels of the print's corners: upper left, upper right, lower right, lower left.
    """
    yaw = random.uniform(-_PRINT_YAW_DEG, _PRINT_YAW_DEG)
    pitch = random.uniform(-_PRINT_PITCH_DEG, _PRINT_PITCH_DEG)
    half = np.array([1.0, photo.height / photo.width, 0.0])
    signs = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    turned = Rotation.from_euler("yx", [yaw, pitch], degrees=True).apply(signs * half)
    seen = turned[:, :2] / (turned[:, 2:] + 4.0)  # from a distance of twice its width
    low, size = seen.min(axis=0), np.ptp(seen, axis=0)
    wanted = share * scene.width
    box = wanted * size / size[0]
    free = np.maximum([scene.width - box[0], scene.height - box[1]], 0.0)
    place = random.uniform(0.0, 1.0, 2) * free
    return np.asarray((seen - low) * wanted / size[0] + place)


def with_print(
    scene: Photo, camera: Camera, printed: Photo, corners: NDArray[np.float64]
) -> tuple[Photo, Camera]:
    """Paint a print into a scene; the camera stays that of the scene, and is right.

    Args:
        scene: the photo into which the print is painted.
        camera: of the scene.
        printed: what the print shows.
        corners: (4, 2) of ``print_corners``.
    """
    width = max(1, round(float(np.ptp(corners[:, 0]))))
    small = printed.rgb
    if width < printed.width:  # a smaller print has fewer details, not aliased ones
        small = resized_to(small, width, round(width * printed.height / printed.width)).rgb
    height, width = small.shape[:2]
    # Pixel positions of OpenCV are 0 at the middle of the first pixel, ours at its corner.
    source = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
    warp = cv2.getPerspectiveTransform(
        source.astype(np.float32), (corners - 0.5).astype(np.float32)
    )
    size = scene.width, scene.height
    painted = cv2.warpPerspective(small, warp, size, flags=cv2.INTER_LINEAR)
    covered = cv2.warpPerspective(np.ones(small.shape[:2], np.uint8), warp, size) > 0
    return Photo(np.where(covered[..., None], painted, scene.rgb).astype(np.uint8)), camera


def _with_centre(camera: Camera, moved: Callable[[float, float], tuple[float, float]]) -> Camera:
    names = CAMERA_MODELS[camera.model]
    params = list(camera.params)
    x, y = names.index("cx"), names.index("cy")
    params[x], params[y] = moved(params[x], params[y])
    return replace(camera, params=tuple(params))


def resized_to(rgb: Pixels, width: int, height: int) -> Photo:
    """Return pixels resized, without aliases."""
    smaller = width * height < rgb.shape[0] * rgb.shape[1]
    method = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    return Photo(np.asarray(cv2.resize(rgb, (width, height), interpolation=method), np.uint8))
