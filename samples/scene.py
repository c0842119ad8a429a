"""The sample room: textured rectangles, and nothing else.

World frame: metres, right-handed, z up; the origin lies in the middle of the floor, x runs along
the long side of the room.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from samples import papers, surfaces
from samples.lighting import light
from samples.textures import Image, Paint

ROOM_SIZE_M = (6.0, 4.5, 2.8)

Vector = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Rectangle:
    """A flat picture in the world, seen from both sides.

    A point of it is ``corner + u * edge_u + v * edge_v`` with u, v in [0, 1]. Its picture's
    columns run along ``edge_u``, its rows along ``edge_v``, and its outer corner, not the centre
    of a texel, lies on ``corner``.

    Attributes:
        corner: (3,) metres.
        edge_u: (3,) metres.
        edge_v: (3,) metres, at a right angle to edge_u.
        levels: pictures (H, W, 3) uint8 RGB, the first as painted and lit, each further one of
            half the size.
    """

    corner: Vector
    edge_u: Vector
    edge_v: Vector
    levels: tuple[Image, ...]

    def at(self, u: float, v: float) -> Vector:
        """Return the point (3,) at u, v."""
        return self.corner + u * self.edge_u + v * self.edge_v


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Everything that can be seen."""

    rectangles: tuple[Rectangle, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Board:
    """A rectangle before it is painted."""

    corner: Vector
    edge_u: Vector
    edge_v: Vector
    paint: Paint


def make_room(
    seed: int, repainted: Collection[int] = (), repainted_seed: int | None = None
) -> Scene:
    """Build the room; its furniture stands still, every picture in it depends on the seed.

    Args:
        repainted: numbers of surfaces, below ``NUM_SURFACES``, whose pictures depend on another
            seed: they make rooms that resemble each other.
    """
    boards = _boards()
    painted = []
    for index, board in enumerate(boards):
        size = [
            round(float(np.linalg.norm(e)) * surfaces.TEXELS_PER_M)
            for e in (board.edge_u, board.edge_v)
        ]
        of = repainted_seed if index in repainted and repainted_seed is not None else seed
        rng = np.random.default_rng([of, index])
        painted.append(board.paint(rng, max(size[1], 8), max(size[0], 8)))
    lit = light(painted, [(b.corner, b.edge_u, b.edge_v) for b in boards], ROOM_SIZE_M)
    return Scene(
        tuple(
            Rectangle(board.corner, board.edge_u, board.edge_v, picture_levels(image))
            for board, image in zip(boards, lit, strict=True)
        )
    )


def picture_levels(image: Image) -> tuple[Image, ...]:
    """Halve a picture until a side is shorter than 8 texels."""
    levels = [image]
    while min(image.shape[:2]) >= 16:
        height, width = image.shape[:2]
        # Area averaging keeps the outer corners where they are, also for odd sizes.
        halved = cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
        image = np.asarray(halved, dtype=np.uint8)
        levels.append(image)
    return tuple(levels)


def _boards() -> list[_Board]:
    return [*_shell(), *_furniture(), *_wall_pictures()]


def _board(
    corner: tuple[float, ...], u: tuple[float, ...], v: tuple[float, ...], paint: Paint
) -> _Board:
    return _Board(np.array(corner, float), np.array(u, float), np.array(v, float), paint)


def _shell() -> list[_Board]:
    """Walls, floor, ceiling; the first corner is the upper left one as seen from inside."""
    length, width, height = ROOM_SIZE_M
    x, y = length / 2, width / 2
    down = (0.0, 0.0, -height)
    return [
        _board((-x, y, height), (length, 0, 0), down, surfaces.mural_wall),
        _board((x, y, height), (0, -width, 0), down, surfaces.brick_wall),
        _board((x, -y, height), (-length, 0, 0), down, surfaces.pinboard_wall),
        _board((-x, -y, height), (0, width, 0), down, surfaces.mosaic_wall),
        _board((-x, y, 0), (length, 0, 0), (0, -width, 0), surfaces.parquet),
        _board((x, y, height), (-length, 0, 0), (0, -width, 0), surfaces.night_sky),
        _board((-1.3, 0.9, 0.01), (2.6, 0, 0), (0, -1.8, 0), surfaces.rug),
    ]


def _furniture() -> list[_Board]:
    boards: list[_Board] = []
    # Two pillars, from floor to ceiling.
    boards += _box((2.15, 1.35, 0.0), (0.36, 0.36, 2.8), 0.5, surfaces.terrazzo)
    boards += _box((-2.0, -1.3, 0.0), (0.3, 0.3, 2.8), -0.3, surfaces.mosaic_wall)
    # A shelf at the west wall, a sideboard at the north wall with parcels on it.
    boards += _box((-2.83, 0.75, 0.0), (0.3, 1.5, 1.9), 0.0, surfaces.book_shelf)
    boards += _box((-0.5, 2.0, 0.0), (1.7, 0.42, 0.75), 0.0, surfaces.sideboard)
    boards += _box((-0.9, 2.0, 0.75), (0.4, 0.3, 0.34), 0.25, surfaces.cardboard)
    boards += _box((-0.2, 1.98, 0.75), (0.3, 0.26, 0.5), -0.35, papers.art_poster)
    # A low table in the middle, a desk at the south wall.
    boards += _table((0.1, 0.0), (1.1, 0.6, 0.45), 0.2)
    boards += _box((0.3, 0.05, 0.45), (0.24, 0.18, 0.16), 0.7, surfaces.cardboard)
    boards += _table((1.2, -1.85), (1.4, 0.65, 0.74), 0.0)
    boards += _box((0.8, -1.95, 0.74), (0.5, 0.1, 0.36), 0.15, papers.picture)
    boards += _box((1.6, -1.9, 0.74), (0.28, 0.22, 0.2), -0.4, surfaces.cardboard)
    # Parcels piled up in two corners.
    boards += _box((2.55, -1.75, 0.0), (0.6, 0.6, 0.6), 0.3, surfaces.cardboard)
    boards += _box((2.6, -1.8, 0.6), (0.45, 0.4, 0.42), -0.25, surfaces.cardboard)
    boards += _box((2.62, -1.78, 1.02), (0.28, 0.3, 0.3), 0.5, surfaces.cardboard)
    boards += _box((-2.45, 1.8, 0.0), (0.5, 0.5, 0.5), 0.15, surfaces.cardboard)
    boards += _box((2.7, 0.3, 0.0), (0.42, 0.8, 0.9), 0.1, surfaces.book_shelf)
    # Two lamps.
    boards += _box((-1.5, 0.2, 2.35), (0.3, 0.3, 0.2), 0.4, papers.picture)
    boards += _box((1.5, -0.2, 2.3), (0.3, 0.3, 0.2), 0.1, papers.picture)
    return boards


def _wall_pictures() -> list[_Board]:
    """Posters, hung a little before the walls: (along the wall, top edge, width, height)."""
    art, chart = papers.art_poster, papers.map_poster
    north = [
        _board((along, 2.2, top), (width, 0, 0), (0, 0, -height), paint)
        for along, top, width, height, paint in (
            (-2.3, 2.4, 0.7, 1.0, art),
            (0.75, 2.3, 0.8, 1.1, chart),
            (1.7, 1.9, 0.5, 0.7, art),
        )
    ]
    east = [
        _board((2.95, along, top), (0, -width, 0), (0, 0, -height), paint)
        for along, top, width, height, paint in (
            (1.7, 2.3, 0.65, 0.9, art),
            (-0.4, 2.4, 0.9, 1.2, art),
        )
    ]
    south = [
        _board((along, -2.2, top), (-width, 0, 0), (0, 0, -height), paint)
        for along, top, width, height, paint in (
            (2.3, 2.5, 0.8, 1.1, art),
            (0.2, 2.3, 0.9, 0.65, chart),
            (-1.2, 2.2, 0.7, 1.0, art),
        )
    ]
    west = [
        _board((-2.94, along, top), (0, width, 0), (0, 0, -height), paint)
        for along, top, width, height, paint in (
            (-1.6, 2.2, 0.8, 1.1, chart),
            (0.15, 2.75, 1.2, 0.75, art),
        )
    ]
    return [*north, *east, *south, *west]


def _box(
    base: tuple[float, float, float], size: tuple[float, float, float], yaw: float, paint: Paint
) -> list[_Board]:
    """Four sides and a top, standing with the middle of its foot on ``base``, turned by yaw."""
    ax, ay = _axes(yaw)
    up = np.array([0.0, 0.0, 1.0])
    length, width, height = size
    middle = np.array(base)
    top = middle + height * up
    boards = []
    for along, across, reach, extent in (
        (ax, -ay, width, length),
        (ay, ax, length, width),
        (-ax, ay, width, length),
        (-ay, -ax, length, width),
    ):
        corner = top + across * reach / 2 - along * extent / 2
        boards.append(_Board(corner, along * extent, -up * height, paint))
    corner = top - ax * length / 2 + ay * width / 2
    boards.append(_Board(corner, ax * length, -ay * width, paint))
    if base[2] > 0.0:
        corner = middle - ax * length / 2 - ay * width / 2
        boards.append(_Board(corner, ax * length, ay * width, paint))
    return boards


def _table(
    center: tuple[float, float], size: tuple[float, float, float], yaw: float
) -> list[_Board]:
    ax, ay = _axes(yaw)
    length, width, height = size
    thick, leg = 0.04, 0.06
    middle = np.array([*center, 0.0])
    boards = _box(
        (center[0], center[1], height - thick), (length, width, thick), yaw, surfaces.wood
    )
    boards[4] = _Board(boards[4].corner, boards[4].edge_u, boards[4].edge_v, surfaces.desk)
    for sx in (-0.5, 0.5):
        for sy in (-0.5, 0.5):
            x, y, _ = middle + sx * (length - 2 * leg) * ax + sy * (width - 2 * leg) * ay
            boards += _box((x, y, 0.0), (leg, leg, height - thick), yaw, surfaces.wood)[:4]
    return boards


def _axes(yaw: float) -> tuple[Vector, Vector]:
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([cos, sin, 0.0]), np.array([-sin, cos, 0.0])


NUM_SURFACES = len(_boards())
