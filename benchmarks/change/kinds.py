"""Ten kinds of change of a photo whose pose stays known, each in three strengths.

Light, air, lens and sensor are those of the extension ``training``, in linear light. Compression is
libjpeg's. What is moved or missing is rendered anew in the painted room, where truth is exact.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.trust.queries import resized_to
from samples.render import render_photo
from samples.scene import NUM_SURFACES, Rectangle, Scene, make_room
from visloc.geometry import Camera, Pose
from visloc.photos.reading import Photo

if TYPE_CHECKING:
    from visloc_extensions.training.conditions import Conditions

Taken = tuple[Photo, Camera]
_ROOM_SEED, _OTHER_SEED = 0, 1000
_SHELL = 7  # surfaces of the room that stay where they are: walls, floor, ceiling, rug
_MOVED_M = 0.6
_BLOCK = 8
_LINES_PX = 640  # blur counts in pixels of a photo of this width


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of change.

    Attributes:
        change: takes a photo, its camera, the strength and random numbers.
        strengths: from weak to strong.
    """

    change: Callable[[Photo, Camera, float, np.random.Generator], Taken]
    strengths: tuple[float, float, float]


def changed(kind: str, level: int, name: str, photo: Photo, camera: Camera) -> Taken:
    """Return a photo changed by a kind of ``KINDS`` at a level, 0 to 2, and its camera.

    The same name, kind and photo give the same result. All levels draw the same numbers, so that a
    stronger change hides what a weaker one hides, and more.
    """
    rng = np.random.default_rng(zlib.crc32(f"{kind} {name}".encode()))
    return KINDS[kind].change(photo, camera, KINDS[kind].strengths[level], rng)


def changed_room(level: int, name: str, camera: Camera, cam_from_world: Pose) -> Photo:
    """Return a photo of the sample room in which a part is moved, missing or painted anew."""
    noise = np.random.default_rng(zlib.crc32(name.encode()))
    return Photo(render_photo(_room(ROOM_SHARES[level]), camera, cam_from_world, noise))


@cache
def _room(share: float) -> Scene:
    """Change a share of the room: of what hangs and stands, and of the surfaces' paint."""
    rng = np.random.default_rng(0)
    chosen = np.flatnonzero(rng.random(NUM_SURFACES) < share)
    scene = make_room(_ROOM_SEED, frozenset(chosen.tolist()), _OTHER_SEED)
    kept: list[Rectangle] = []
    for index, rectangle in enumerate(scene.rectangles):
        if index < _SHELL or rng.random() >= share:
            kept.append(rectangle)
        elif rng.random() < 0.5:  # the others are missing
            along = rng.uniform(-_MOVED_M, _MOVED_M)
            edge = rectangle.edge_u
            corner = rectangle.corner + along * edge / np.linalg.norm(edge)
            kept.append(replace(rectangle, corner=corner))
    return Scene(tuple(kept))


def _drawn(rng: np.random.Generator, night: float) -> Conditions:
    from visloc_extensions.training.conditions import draw_conditions

    return draw_conditions(rng, 1, night, night, 0.0)


def _nothing(rng: np.random.Generator) -> Conditions:
    return _drawn(rng, 0.0)


def _with(photo: Photo, conditions: Conditions) -> Photo:
    """Apply conditions to a photo, padded to whole blocks."""
    from visloc_extensions.training.augmentation import augment

    height, width = photo.height, photo.width
    below, right = -height % _BLOCK, -width % _BLOCK
    rgb = cv2.copyMakeBorder(photo.rgb, 0, below, 0, right, cv2.BORDER_REFLECT)
    image = torch.from_numpy(rgb).permute(2, 0, 1)[None].float() / 255
    with torch.inference_mode():
        made = augment(image, conditions)[0].permute(1, 2, 0)[:height, :width]
    return replace(photo, rgb=np.ascontiguousarray((255 * made).round().byte().numpy()))


def _one(value: float) -> NDArray[np.float64]:
    return np.array([value])


def _darkness(photo: Photo, camera: Camera, strength: float, rng: np.random.Generator) -> Taken:
    """Take it at night, by a few lamps, with fewer electrons the darker it is."""
    electrons = 2000.0 / strength**2
    night = _drawn(rng, 1.0)
    conditions = _nothing(rng)._replace(
        night=_one(1.0),
        ambient=_one(0.3 / strength),
        lit=_one(0.5),
        lamps=night.lamps,
        target=_one(0.1 / np.sqrt(strength)),
        shot=_one(1.0 / electrons),
        read=_one(3.0 / electrons),
        smoothing=_one(0.5),
    )
    return _with(photo, conditions), camera


def _balance(photo: Photo, camera: Camera, strength: float, rng: np.random.Generator) -> Taken:
    """Multiply colours, one up and two down, as a wrong white balance in a lamp's light does."""
    gains = np.full((1, 3), -strength)
    gains[0, rng.integers(3)] = 0.5 * strength
    return _with(photo, _nothing(rng)._replace(balance=gains)), camera


def _fog(photo: Photo, camera: Camera, strength: float, rng: np.random.Generator) -> Taken:
    noise = {"shot": _one(1 / 3000), "read": _one(2 / 3000)}
    conditions = _nothing(rng)._replace(fog=_one(strength), air=_one(0.6), **noise)
    return _with(photo, conditions), camera


def _rain(photo: Photo, camera: Camera, strength: float, rng: np.random.Generator) -> Taken:
    """Put drops onto the lens, and streaks into the air."""
    count = max(1, round(40 * strength))
    drops = np.concatenate([rng.uniform(0, 1, (count, 2)), rng.uniform(0.02, 0.09, (count, 1))], 1)
    streaks = _one(min(1.0, strength))
    conditions = _nothing(rng)._replace(drops=drops[None], rain=streaks)
    return _with(photo, conditions), camera


def _snow(photo: Photo, camera: Camera, strength: float, rng: np.random.Generator) -> Taken:
    """Lay snow over a share of the photo, more below than above; it keeps only large shades."""
    size = photo.width, photo.height
    depth = np.linspace(0.0, 1.0, photo.height)[:, None]
    for cells in (5, 17, 51):
        lumps = rng.normal(0.0, 2.0 / np.sqrt(cells), (cells, cells))
        depth = depth + cv2.resize(lumps, size, interpolation=cv2.INTER_CUBIC)
    covered = (depth > np.quantile(depth, 1.0 - strength))[..., None]
    shade = cv2.GaussianBlur(photo.rgb.mean(axis=2), (0, 0), photo.width / 30)
    grains = cv2.GaussianBlur(rng.normal(0.0, 12.0, shade.shape), (0, 0), 1.0)
    snow = 150.0 + 0.35 * shade + grains
    rgb = np.where(covered, np.clip(snow, 0, 255)[..., None], photo.rgb)
    return replace(photo, rgb=rgb.astype(np.uint8)), camera


def _compression(photo: Photo, camera: Camera, strength: float, _: np.random.Generator) -> Taken:
    """Compress at 1 / strength of the width, quality 5: as a preview is sent."""
    width, height = round(photo.width / strength), round(photo.height / strength)
    small = resized_to(photo.rgb, width, height).rgb
    encoded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 5])[1]
    decoded = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
    return resized_to(np.asarray(decoded, np.uint8), photo.width, photo.height), camera


def _motion(photo: Photo, camera: Camera, strength: float, rng: np.random.Generator) -> Taken:
    """Move the camera along a line while it exposes, so many pixels of a width of 640."""
    length = strength * photo.width / _LINES_PX
    angle, half = rng.uniform(0, np.pi), int(np.ceil(length / 2)) + 1
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    along, beside = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    beyond = np.maximum(np.abs(along) - length / 2, 0)
    kernel = np.exp(-0.5 * (beside**2 + beyond**2) / 0.4**2)
    blurred = cv2.filter2D(photo.rgb, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REFLECT)
    return replace(photo, rgb=np.asarray(blurred, np.uint8)), camera


def _camera(photo: Photo, camera: Camera, strength: float, rng: np.random.Generator) -> Taken:
    """Take it with a grey camera of 1 / strength of the pixels per side and a hard tone curve."""
    width, height = round(photo.width / strength), round(photo.height / strength)
    conditions = _nothing(rng)._replace(
        grey=_one(1.0),
        contrast=_one(0.3),
        gamma=_one(float(rng.choice([-0.5, 0.5]))),
        shot=_one(1 / 1000),
        read=_one(2 / 1000),
    )
    small = resized_to(photo.rgb, width, height)
    return _with(replace(photo, rgb=small.rgb), conditions), camera.scaled(width, height)


def _grain(photo: Photo, camera: Camera, strength: float, rng: np.random.Generator) -> Taken:
    """Defocus, then so much noise as a share of white."""
    conditions = _nothing(rng)._replace(
        defocus=_one(1.0), read=_one(strength), shot=_one(strength**2)
    )
    return _with(photo, conditions), camera


# Of the painted room, for the kind ``room``: shares that change.
ROOM = "room"
ROOM_SHARES = (0.5, 0.7, 0.9)
# Fixed at commit 1387f1e, for 90, 60 and 30 % of its recall where measured (docs/change.md).
KINDS: Mapping[str, Kind] = {
    "darkness": Kind(_darkness, (4.5, 7.0, 10.0)),
    "balance": Kind(_balance, (6.0, 7.2, 8.0)),
    "fog": Kind(_fog, (1.8, 2.6, 3.6)),
    "rain": Kind(_rain, (1.0, 2.0, 4.0)),
    "snow": Kind(_snow, (0.5, 0.68, 0.78)),
    "compression": Kind(_compression, (3.3, 5.0, 6.5)),
    "motion": Kind(_motion, (17.0, 28.0, 38.0)),
    "camera": Kind(_camera, (2.1, 2.5, 3.0)),
    "grain": Kind(_grain, (0.22, 0.35, 0.5)),
}
