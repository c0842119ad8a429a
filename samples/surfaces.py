"""The look of the sample room's surfaces.

Each function paints one surface, (height, width, 3) uint8 RGB, ``TEXELS_PER_M`` texels per
metre, and no two calls with different generators give the same picture. All of them carry
distinct corners from a few millimetres to half a metre, because a localizer needs something to
hold on to from everywhere.
"""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from samples.papers import (
    BRIGHT_COLOURS,
    PAPER_COLOURS,
    code_card,
    picture,
    text_page,
    town_map,
)
from samples.textures import (
    Colour,
    Image,
    canvas,
    chips,
    disc,
    glyphs,
    grit,
    lettering,
    palette,
    paste,
    pick,
    polygon,
    shapes,
    stain,
    value_noise,
    vary,
    words,
)

TEXELS_PER_M = 500

_EARTH = palette("7f5539 9c6644 b08968 ddb892 e6ccb2 5c4033 8a5a44 3c2a21")
_STONE = palette("d9d4c7 b7b0a1 8d8a82 5f5d59 efeae0 a3785f 6b705c 3f4045 c9ada7")


def brick_wall(rng: np.random.Generator, height: int, width: int) -> Image:
    """Paint bricks of many colours, weathered, with painted letters."""
    image = canvas(height, width, (176, 168, 156))
    bricks = palette("9c4a35 a85a41 8a3f30 b56b4d 7a3b2e c07f5e 94553f 6f3a33 b98a6b")
    brick_h, brick_w, joint = 40, 122, 6
    for row, y in enumerate(range(0, height, brick_h)):
        x = -brick_w * rng.uniform(0.3, 0.9) if row % 2 else -brick_w * rng.uniform(0.0, 0.2)
        while x < width:
            length = brick_w * rng.uniform(0.75, 1.1)
            corners = np.array([[0, 0], [length, 0], [length, brick_h], [0, brick_h]], float)
            corners += joint / 2 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
            corners += np.array([x, y]) + rng.uniform(-2.0, 2.0, (4, 2))
            polygon(image, corners, vary(rng, pick(rng, bricks), 0.22))
            x += length
    _painted_letters(image, rng, palette("f1ece0 2e86ab f2c14e 1d1e22 e4572e"), (110, 420), 26)
    chips(image, rng, [*bricks, (205, 196, 182), (58, 40, 36)], (2.5, 9.0), 8)
    stain(image, value_noise(rng, height, width, (320, 320), 4), 0.2)
    grit(image, rng, 0.16)
    return image


def mosaic_wall(rng: np.random.Generator, height: int, width: int) -> Image:
    """Paint a patchwork of tiles, each with a motif of its own."""
    image = canvas(height, width, (214, 209, 198))
    colours = palette(
        "14213d 1d5b79 468faf a9d6e5 f2efe5 fca311 e07a5f 81b29a f4f1de 3d405b d62828"
    )
    tile = 60
    for y in range(0, height, tile):
        for x in range(0, width, tile):
            patch = image[y + 2 : y + tile - 1, x + 2 : x + tile - 1]
            _tile_motif(patch, rng, colours)
    chips(image, rng, [*colours, (70, 66, 62)], (2.5, 6.0), 4)
    stain(image, value_noise(rng, height, width, (400, 400), 3), 0.14)
    grit(image, rng, 0.1)
    return image


def mural_wall(rng: np.random.Generator, height: int, width: int) -> Image:
    """Paint an abstract mural: shapes upon shapes, lines, letters."""
    colours = palette(
        "264653 2a9d8f e9c46a f4a261 e76f51 f1faee 1d3557 a8dadc 6d597a b56576 355070"
    )
    fields = value_noise(rng, height, width, (700, 700), 3)
    bands = np.clip((fields + 1.0) * 0.5 * len(colours), 0, len(colours) - 1).astype(np.uint8)
    paints = np.array(colours, dtype=np.uint8)[rng.permutation(len(colours))]
    image: Image = np.asarray(paints[bands], dtype=np.uint8)
    shapes(image, rng, colours, (320.0, 18.0), 0.3)
    _strokes(image, rng, colours, width // 24)
    glyphs(image, rng, colours, (20.0, 130.0), width // 12)
    shapes(image, rng, colours, (14.0, 3.0), 0.04)
    stain(image, value_noise(rng, height, width, (240, 240), 4), 0.12)
    grit(image, rng, 0.1)
    return image


def pinboard_wall(rng: np.random.Generator, height: int, width: int) -> Image:
    """Paint plaster that is papered with pages, cards and pictures at all angles."""
    image = canvas(height, width, (196, 178, 150))
    stain(image, value_noise(rng, height, width, (160, 160), 6), 0.3)
    chips(image, rng, _EARTH, (2.5, 9.0), 10)
    painters = (text_page, text_page, picture, town_map, code_card)
    for _ in range(height * width // 16_000):
        patch_h = int(rng.uniform(90, 230))
        patch_w = int(patch_h * rng.uniform(0.65, 1.35))
        patch = painters[int(rng.integers(len(painters)))](rng, patch_h, patch_w)
        x, y = rng.uniform((0, 0), (width, height))
        paste(image, patch, (x, y), rng.normal(0, 0.16))
        disc(image, np.array([x, y - 0.42 * patch_h]), 5, pick(rng, BRIGHT_COLOURS))
    stain(image, value_noise(rng, height, width, (500, 500), 3), 0.1)
    grit(image, rng, 0.08)
    return image


def parquet(rng: np.random.Generator, height: int, width: int) -> Image:
    """Paint planks of different woods with grain, knots and scratches."""
    image = canvas(height, width, (60, 42, 30))
    woods = palette("a9784f c49a6c 8b5e3c d4ad7d 7a5230 b98757 9a6b43 e0bf94 6b4528")
    plank = 56
    for y in range(0, height, plank):
        x = -rng.uniform(0, 300)
        while x < width:
            length = rng.uniform(140, 420)
            left, right = int(max(x + 2, 0)), int(min(x + length, width))
            if right - left > 4 and height - y > 4:
                board = image[y + 2 : y + plank, left:right]
                board[:] = vary(rng, pick(rng, woods), 0.14)
                stain(board, value_noise(rng, board.shape[0], board.shape[1], (5, 120), 3), 0.24)
                _knots(board, rng)
            x += length
    chips(image, rng, [*woods, (48, 32, 24), (240, 220, 190)], (2.2, 5.0), 9)
    _strokes(image, rng, palette("4a3020 e8cfa8 35241a"), 160, 1)
    grit(image, rng, 0.14)
    return image


def night_sky(rng: np.random.Generator, height: int, width: int) -> Image:
    """Paint a star chart: nebulae, stars, constellations, names."""
    # Clouds are smooth: a quarter of the resolution is enough for them.
    rows, columns = -(-height // 4), -(-width // 4)
    clouds = canvas(rows, columns, (44, 62, 104))
    for colour in palette("6a4c93 2a9d8f b5658f 3d7ea6 8a9fd1"):
        cover = np.clip(value_noise(rng, rows, columns, (125, 125), 6) - 0.1, 0, 0.8)[..., None]
        clouds[:] = (clouds * (1 - cover) + cover * np.array(colour, np.float32)).astype(np.uint8)
    enlarged = cv2.resize(clouds, (width, height), interpolation=cv2.INTER_LINEAR)
    image = np.asarray(enlarged, dtype=np.uint8)
    stars = palette("fdfcf0 ffe8b6 cfe3ff ffd0b0 f6f7ff")
    shapes(image, rng, [*stars, *palette("20304f 8fb8de 1b2440")], (9.0, 2.5), 0.03)
    for _ in range(height * width // 26_000):
        knots = rng.uniform((0, 0), (width, height)) + np.cumsum(rng.normal(0, 75, (5, 2)), axis=0)
        cv2.polylines(image, [knots.astype(np.int32)], False, (168, 190, 226), 2, cv2.LINE_AA)
        for knot in knots:
            _star(image, rng, knot, rng.uniform(7, 20), pick(rng, stars))
        name = words(rng, int(rng.integers(4, 10))).upper()
        lettering(image, name, (knots[0, 0] + 12, knots[0, 1]), rng.uniform(14, 26), stars[2])
    grit(image, rng, 0.12)
    return image


def rug(rng: np.random.Generator, height: int, width: int) -> Image:
    """Paint a woven rug: a patchwork of diamonds in a border."""
    colours = palette("6b0f1a b91372 31081f f2c57c ddae7e 7fb685 426a5a ef6f6c 2f4858 f6e7cb")
    image = canvas(height, width, colours[0])
    step = 50
    for row, y in enumerate(range(0, height + step, step // 2)):
        for x in range(0, width + step, step):
            center = np.array([x + (step / 2 if row % 2 else 0), y], float)
            for size, share in ((0.5, 1.0), (0.34, 0.75), (0.17, 0.7)):
                if rng.random() < share:
                    corners = np.array([[0, -1], [1, 0], [0, 1], [-1, 0]]) * step * size
                    polygon(image, center + corners, vary(rng, pick(rng, colours), 0.2))
    for inset, colour in ((0, colours[3]), (14, colours[2]), (26, colours[6])):
        cv2.rectangle(image, (inset, inset), (width - inset, height - inset), colour, 12)
    chips(image, rng, colours, (2.5, 5.0), 8)
    stain(image, value_noise(rng, height, width, (3, 40), 2), 0.12)
    grit(image, rng, 0.14)
    return image


def book_shelf(rng: np.random.Generator, height: int, width: int) -> Image:
    """Paint shelves full of books with lettered spines."""
    image = canvas(height, width, (46, 32, 24))
    num_shelves = max(1, round(height / 165))
    shelf_h = height // num_shelves
    for shelf in range(num_shelves):
        floor = (shelf + 1) * shelf_h - 12
        x = 10.0
        while x < width - 24:
            thick, tall = rng.uniform(13, 40), shelf_h * rng.uniform(0.6, 0.86)
            _book(image, rng, (int(x), int(floor - tall)), (int(min(x + thick, width - 10)), floor))
            x += thick + (rng.uniform(0, 22) if rng.random() < 0.1 else 1)
        cv2.rectangle(image, (0, floor), (width, floor + 14), (122, 84, 54), cv2.FILLED)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (122, 84, 54), 16)
    grit(image, rng, 0.1)
    return image


def cardboard(rng: np.random.Generator, height: int, width: int) -> Image:
    """Paint the side of a parcel: tape, labels, stamps, bar codes."""
    image = canvas(height, width, vary(rng, (190, 150, 106), 0.1))
    stain(image, value_noise(rng, height, width, (60, 90), 5), 0.16)
    tape = int(height * rng.uniform(0.42, 0.5))
    cv2.rectangle(image, (0, tape), (width, tape + height // 9), (214, 190, 140), cv2.FILLED)
    glyphs(image, rng, palette("3a2a1e 7a1f1f 22405e"), (18.0, 60.0), height * width // 5000)
    for _ in range(max(2, height * width // 16_000)):
        label_h = int(height * rng.uniform(0.2, 0.45))
        painter = (code_card, text_page, picture)[int(rng.integers(3))]
        label = painter(rng, label_h, int(label_h * rng.uniform(1.0, 1.6)))
        x, y = rng.uniform((0, 0), (width, height))
        paste(image, label, (x, y), rng.normal(0, 0.2))
    chips(image, rng, _EARTH, (2.5, 6.0), 8)
    grit(image, rng, 0.1)
    return image


def terrazzo(rng: np.random.Generator, height: int, width: int) -> Image:
    """Paint polished stone chips of all sizes."""
    image = canvas(height, width, (222, 216, 204))
    shapes(image, rng, [*_STONE, *palette("a44a3f 2f5d62 e0a458")], (34.0, 3.0), 0.3)
    stain(image, value_noise(rng, height, width, (150, 150), 4), 0.1)
    grit(image, rng, 0.08)
    return image


def wood(rng: np.random.Generator, height: int, width: int) -> Image:
    """Paint grained wood with inlays."""
    image = canvas(height, width, vary(rng, (150, 104, 66), 0.15))
    stain(image, value_noise(rng, height, width, (8, 160), 4), 0.24)
    _knots(image, rng, height * width // 6000)
    shapes(image, rng, _EARTH, (10.0, 2.5), 0.04)
    grit(image, rng, 0.12)
    return image


def desk(rng: np.random.Generator, height: int, width: int) -> Image:
    """Paint a wooden top that is strewn with papers."""
    image = wood(rng, height, width)
    painters = (text_page, code_card, picture, town_map)
    for _ in range(max(4, height * width // 9000)):
        patch_h = int(rng.uniform(50, 110))
        patch = painters[int(rng.integers(4))](rng, patch_h, int(patch_h * rng.uniform(0.7, 1.4)))
        x, y = rng.uniform((0, 0), (width, height))
        paste(image, patch, (x, y), rng.uniform(-np.pi, np.pi))
    grit(image, rng, 0.08)
    return image


def sideboard(rng: np.random.Generator, height: int, width: int) -> Image:
    """Paint wooden doors with knobs and stickers."""
    image = wood(rng, height, width)
    num_doors = max(1, round(width / 200))
    edges = np.linspace(0, width, num_doors + 1).astype(int)
    for left, right in pairwise(edges.tolist()):
        cv2.rectangle(image, (left, 0), (right, height), (58, 38, 26), 5)
        if right - left < 90:
            continue
        for inset, colour in ((24, (92, 62, 40)), (30, (184, 136, 92))):
            frame = (left + inset, inset), (right - inset, height - inset)
            cv2.rectangle(image, *frame, colour, 4, cv2.LINE_AA)
        disc(image, np.array([right - 14.0, height * 0.4]), 8, (214, 186, 120))
        sticker_h = int(rng.uniform(50, 110))
        sticker = picture(rng, sticker_h, int(sticker_h * rng.uniform(0.8, 1.4)))
        x, y = rng.uniform((left + 60, 60), (right - 60, max(61, height - 60)))
        paste(image, sticker, (x, y), rng.normal(0, 0.3))
    return image


def _painted_letters(
    image: Image,
    rng: np.random.Generator,
    colours: list[Colour],
    heights: tuple[float, float],
    count: int,
) -> None:
    """Spray letters thinly: they let the wall below shine through."""
    layer = image.copy()
    glyphs(layer, rng, colours, heights, count)
    cv2.addWeighted(layer, 0.82, image, 0.18, 0, dst=image)


def _strokes(
    image: Image, rng: np.random.Generator, colours: list[Colour], count: int, thickest: int = 7
) -> None:
    height, width = image.shape[:2]
    for _ in range(count):
        path = rng.uniform((0, 0), (width, height)) + np.cumsum(rng.normal(0, 60, (4, 2)), axis=0)
        thickness = int(rng.integers(1, thickest + 1))
        colour = pick(rng, colours)
        cv2.polylines(image, [path.astype(np.int32)], False, colour, thickness, cv2.LINE_AA)


def _tile_motif(patch: Image, rng: np.random.Generator, colours: list[Colour]) -> None:
    height, width = patch.shape[:2]
    patch[:] = vary(rng, pick(rng, colours), 0.15)
    colour, accent = vary(rng, pick(rng, colours), 0.15), pick(rng, colours)
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], float)
    center = corners.mean(axis=0)
    first = int(rng.integers(4))
    kind = int(rng.integers(6))
    if kind == 0:  # quarter rings
        disc(patch, corners[first], 0.75 * width, colour)
        disc(patch, corners[first], 0.35 * width, accent)
    elif kind == 1:  # triangles
        polygon(patch, corners[[first, first - 1, first - 2]], colour)
        polygon(patch, np.array([corners[first], center, corners[first - 1]]), accent)
    elif kind == 2:  # a star of two squares
        polygon(patch, center + 0.36 * (corners - center) * 2, colour)
        polygon(
            patch, center + 0.6 * np.array([[0, -1], [1, 0], [0, 1], [-1, 0]]) * width / 2, accent
        )
    elif kind == 3:  # a letter
        glyphs(patch, rng, [colour, accent], (0.5 * width, 0.9 * width), 2)
    elif kind == 4:  # scattered shapes
        shapes(patch, rng, [colour, accent, pick(rng, colours)], (0.3 * width, 4.0), 0.3)
    else:  # petals
        for corner in corners:
            disc(patch, (corner + center) / 2, 0.23 * width, colour)
        disc(patch, center, 0.15 * width, accent)


def _knots(board: Image, rng: np.random.Generator, count: int | None = None) -> None:
    height, width = board.shape[:2]
    for _ in range(int(rng.integers(0, 4)) if count is None else count):
        center = rng.uniform((0, 0), (width, height))
        size = rng.uniform(3, 9)
        disc(board, center, size, (74, 46, 28))
        disc(board, center, size * 0.5, (40, 26, 18))


def _star(
    image: Image,
    rng: np.random.Generator,
    center: NDArray[np.float64],
    radius: float,
    colour: Colour,
) -> None:
    turn = rng.uniform(0, np.pi)
    for angle in (turn, turn + np.pi / 2):
        along = radius * np.array([np.cos(angle), np.sin(angle)])
        across = 0.28 * np.array([-along[1], along[0]])
        polygon(image, center + np.array([along, across, -along, -across]), colour)


def _book(
    image: Image, rng: np.random.Generator, top_left: tuple[int, int], bottom_right: tuple[int, int]
) -> None:
    (x0, y0), (x1, y1) = top_left, bottom_right
    if x1 - x0 < 6:
        return
    colour = vary(rng, pick(rng, BRIGHT_COLOURS), 0.35)
    cv2.rectangle(image, top_left, bottom_right, colour, cv2.FILLED)
    accent = pick(rng, [*PAPER_COLOURS, *BRIGHT_COLOURS])
    for _ in range(int(rng.integers(1, 4))):
        y = int(rng.uniform(y0 + 4, y1 - 8))
        cv2.rectangle(image, (x0, y), (x1, y + int(rng.integers(2, 9))), accent, cv2.FILLED)
    spine = canvas(x1 - x0, y1 - y0, colour)
    size = min(0.55 * (x1 - x0), 18.0)
    title = words(rng, int((y1 - y0) / size * 0.7)).upper()
    lettering(spine, title, (8, 0.5 * (x1 - x0 + size)), size, accent, int(rng.integers(4)), 0.12)
    turned = cv2.rotate(spine, cv2.ROTATE_90_CLOCKWISE)
    written = (turned != np.array(colour, np.uint8)).any(axis=2)
    image[y0:y1, x0:x1][written] = turned[written]
    cv2.line(image, (x1, y0), (x1, y1), (28, 22, 20), 2)
