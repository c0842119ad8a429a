"""Photos of a place made harder, and pictures that are no photo of it although they show it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from visloc.geometry import CAMERA_MODELS, Camera

Image = NDArray[np.uint8]
Taken = tuple[Image, Camera]
# How a photo is made harder; its pose stays right. The foreign photo may cover a part of it.
Disguise = Callable[[Image, Camera, Image, np.random.Generator], Taken]


def printed(image: Image, scene: Image, rng: np.random.Generator) -> Taken:
    """Put a photo as a print, a fifth to five sixths of the width, into a scene."""
    width = int(rng.choice([800, 1024, 1280]))
    height = int(width * rng.choice([0.75, 0.5625, 0.667]))
    ground = cv2.resize(scene, (width, height), interpolation=cv2.INTER_CUBIC)
    rows, columns = image.shape[:2]
    across = rng.uniform(0.22, 0.85) * width
    across = min(across, 0.95 * height * columns / rows)
    down = across * rows / columns
    left, top = rng.uniform(0, width - across), rng.uniform(0, height - down)
    corners = np.array([[0, 0], [across, 0], [across, down], [0, down]]) + np.array([left, top])
    corners += rng.normal(0, 0.02 * across, (4, 2))
    whole = np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]], np.float32)
    warp = cv2.getPerspectiveTransform(whole, corners.astype(np.float32))
    reduced = max(1.0, columns / across)
    source = cv2.GaussianBlur(image, (0, 0), 0.4 * reduced) if reduced > 1.2 else image
    warped = cv2.warpPerspective(source, warp, (width, height))
    covers = cv2.warpPerspective(np.full((rows, columns), 255, np.uint8), warp, (width, height))
    focal = rng.uniform(0.75, 1.25) * width
    camera = Camera("PINHOLE", width, height, (focal, focal, width / 2, height / 2))
    return np.where(covers[..., None] > 127, warped, ground).astype(np.uint8), camera


def resembling(image: Image, foreign: Image, rng: np.random.Generator) -> Image:
    """Make a place of the same design out of a photo: another floor, the next house.

    Lengths differ smoothly by up to a per cent or two of the photo, a part of what hangs and
    stands there is something else, and the light is another.
    """
    height, width = image.shape[:2]
    strength, waves = rng.uniform(0.005, 0.014) * width, int(rng.integers(3, 8))
    coarse = rng.normal(0, strength, (2, waves, waves)).astype(np.float32)
    moved_x, moved_y = (
        cv2.resize(each, (width, height), interpolation=cv2.INTER_CUBIC) for each in coarse
    )
    down, across = np.mgrid[:height, :width].astype(np.float32)
    bent = cv2.remap(
        image, across + moved_x, down + moved_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
    )
    mask = _patches(width, height, rng.uniform(0.15, 0.5), (0.04, 0.16), (0.05, 0.22), rng)
    other = np.where(mask[..., None], cv2.resize(foreign, (width, height)), bent)
    return _bytes(255 * (other / 255) ** rng.uniform(0.7, 1.4) * rng.uniform(0.8, 1.15))


def _blurred(image: Image, camera: Camera, _: Image, rng: np.random.Generator) -> Taken:
    return _bytes(cv2.GaussianBlur(image, (0, 0), rng.uniform(1, 4) * camera.width / 640)), camera


def _dark(image: Image, camera: Camera, _: Image, rng: np.random.Generator) -> Taken:
    darker = image * rng.uniform(0.08, 0.35) + rng.normal(0, rng.uniform(2, 6), image.shape)
    return _bytes(np.clip(darker, 0, 255) * rng.uniform(1, 3)), camera


def _at_night(image: Image, camera: Camera, _: Image, rng: np.random.Generator) -> Taken:
    """Grey, blurred, noisy, and lit by a few lamps."""
    grey = np.repeat(image.mean(axis=2, keepdims=True), 3, axis=2)
    grey = cv2.GaussianBlur(grey, (0, 0), rng.uniform(0.8, 2) * camera.width / 640)
    down, across = np.mgrid[: camera.height, : camera.width]
    light = np.full((camera.height, camera.width), rng.uniform(0.02, 0.2))
    for _lamp in range(rng.integers(1, 5)):
        x, y = rng.uniform(0, 1, 2) * (camera.width, 0.7 * camera.height)
        size = rng.uniform(0.08, 0.3) * camera.width
        away2 = (across - x) ** 2 + (down - y) ** 2
        light += rng.uniform(0.3, 1.2) * np.exp(-away2 / (2 * size**2))
    lit = grey * light[..., None] + rng.normal(0, rng.uniform(2, 8), grey.shape)
    return _bytes(np.clip(lit, 0, 255) * rng.uniform(1, 2)), camera


def _exposed(image: Image, camera: Camera, _: Image, rng: np.random.Generator) -> Taken:
    return _bytes(255 * (image / 255) ** rng.choice([0.35, 0.5, 2.0, 3.0])), camera


def _noisy(image: Image, camera: Camera, _: Image, rng: np.random.Generator) -> Taken:
    return _bytes(image + rng.normal(0, rng.uniform(10, 40), image.shape)), camera


def _grey(image: Image, camera: Camera, _: Image, rng: np.random.Generator) -> Taken:
    grey = np.repeat(image.mean(axis=2, keepdims=True), 3, axis=2)
    return _bytes(grey * rng.uniform(0.5, 1.2)), camera


def _small(image: Image, camera: Camera, _: Image, rng: np.random.Generator) -> Taken:
    share = rng.uniform(0.3, 0.6)
    width, height = int(camera.width * share), int(camera.height * share)
    factors = (width / camera.width, height / camera.height)
    of = {"f": factors[0], "fx": factors[0], "cx": factors[0], "fy": factors[1], "cy": factors[1]}
    names = CAMERA_MODELS[camera.model]
    params = tuple(v * of.get(n, 1.0) for n, v in zip(names, camera.params, strict=True))
    smaller = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return _bytes(smaller), Camera(camera.model, width, height, params)


def _cropped(image: Image, camera: Camera, _: Image, rng: np.random.Generator) -> Taken:
    """Keep a part, and say so: the camera's principal point moves along."""
    share = rng.uniform(0.5, 0.8)
    width, height = int(camera.width * share), int(camera.height * share)
    left = int(rng.integers(0, camera.width - width))
    top = int(rng.integers(0, camera.height - height))
    of = {"cx": left, "cy": top}
    names = CAMERA_MODELS[camera.model]
    params = tuple(v - of.get(n, 0) for n, v in zip(names, camera.params, strict=True))
    part = np.ascontiguousarray(image[top : top + height, left : left + width])
    return part, replace(camera, width=width, height=height, params=params)


def _covered(image: Image, camera: Camera, foreign: Image, rng: np.random.Generator) -> Taken:
    """Cover a tenth to two fifths, as people and cars do."""
    other = cv2.resize(foreign, (camera.width, camera.height))
    share = rng.uniform(0.1, 0.4)
    mask = _patches(camera.width, camera.height, share, (0.1, 0.35), (0.2, 0.7), rng)
    return np.where(mask[..., None], other, image), camera


DISGUISES: dict[str, Disguise] = {
    "blur": _blurred,
    "dark": _dark,
    "night": _at_night,
    "exposure": _exposed,
    "noise": _noisy,
    "grey": _grey,
    "small": _small,
    "crop": _cropped,
    "covered": _covered,
}


def _patches(
    width: int,
    height: int,
    share: float,
    widths: tuple[float, float],
    heights: tuple[float, float],
    rng: np.random.Generator,
) -> NDArray[np.bool_]:
    """Boxes that cover about a share of a photo; their sides are parts of its sides."""
    mask = np.zeros((height, width), np.bool_)
    while mask.mean() < share:
        across, down = int(width * rng.uniform(*widths)), int(height * rng.uniform(*heights))
        left, top = int(rng.integers(0, width - across)), int(rng.integers(0, height - down))
        mask[top : top + down, left : left + across] = True
    return mask


def _bytes(values: NDArray[Any]) -> Image:
    return np.asarray(np.clip(values, 0, 255), dtype=np.uint8)
