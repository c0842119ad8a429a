"""Papers of the sample world: pages, pictures, maps, cards and posters.

Each function paints one paper, (height, width, 3) uint8 RGB, 2 mm per texel.
"""

from __future__ import annotations

import cv2
import numpy as np

from samples.textures import (
    Colour,
    Image,
    Paint,
    canvas,
    glyphs,
    grit,
    lettering,
    palette,
    pick,
    polygon,
    shapes,
    vary,
    words,
)

PAPER_COLOURS = palette("f4efe2 efe6d0 fbf8f0 e6ecec f3e3d3")
INK_COLOURS = palette("22242b 2b2a33 1f3b57 5a2328 274a3a")
BRIGHT_COLOURS = palette(
    "d7263d f46036 2e86ab 1b998b f2c14e 6a4c93 f7f4ea 22333b c5283d 3d5a80 8ac926"
)


def art_poster(rng: np.random.Generator, height: int, width: int) -> Image:
    """Paint a framed poster: a picture over a title and small print."""
    return _poster(rng, height, width, picture)


def map_poster(rng: np.random.Generator, height: int, width: int) -> Image:
    """Paint a framed poster: the map of a town over its name and small print."""
    return _poster(rng, height, width, town_map)


def text_page(rng: np.random.Generator, height: int, width: int) -> Image:
    """Paint a printed page with a headline."""
    image = canvas(height, width, pick(rng, PAPER_COLOURS))
    ink = pick(rng, INK_COLOURS)
    head = height * 0.13
    lettering(image, words(rng, max(3, int(width / head))).upper(), (8, head * 1.4), head, ink, 1)
    size = rng.uniform(8, 14)
    _print_lines(image, rng, (8, head * 1.8, width - 8, height - 8), size, ink)
    return image


def picture(rng: np.random.Generator, height: int, width: int) -> Image:
    """Paint a small abstract picture in four colours of its own."""
    colours = [pick(rng, BRIGHT_COLOURS) for _ in range(4)] + [pick(rng, PAPER_COLOURS)]
    image = canvas(height, width, pick(rng, colours))
    shapes(image, rng, colours, (0.45 * min(height, width), 4.0), 0.6)
    glyphs(
        image,
        rng,
        [*colours, *INK_COLOURS],
        (14.0, 0.4 * min(height, width)),
        height * width // 9000,
    )
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), PAPER_COLOURS[2], 5)
    return image


def town_map(rng: np.random.Generator, height: int, width: int) -> Image:
    """Paint a map of a town: blocks split again and again, streets, names."""
    image = canvas(height, width, (238, 228, 206))
    blocks = palette("9cc28a c6dfa8 f2b880 c9b8a8 7fc4c9 e5777c 8fb36b f3d3b8 b9a06a 7d8fb3")
    _split_block(image, rng, blocks, (3, 3, width - 3, height - 3))
    river = np.column_stack(
        [np.linspace(0, width, 9), rng.uniform(0, height) + np.cumsum(rng.normal(0, 18, 9))]
    )
    cv2.polylines(image, [river.astype(np.int32)], False, (111, 168, 201), 9, cv2.LINE_AA)
    for _ in range(height * width // 7000):
        x, y = rng.uniform((0, 0), (width, height))
        lettering(image, words(rng, 6), (x - 20, y), rng.uniform(8, 15), pick(rng, INK_COLOURS))
    return image


def code_card(rng: np.random.Generator, height: int, width: int) -> Image:
    """Paint a card of black and white cells over a line of print."""
    image = canvas(height, width, (248, 247, 243))
    cell = int(rng.integers(7, 12))
    window = image[8 : 8 + int(0.74 * height), 8 : max(8, width - 8)]
    rows, columns = window.shape[0] // cell + 1, window.shape[1] // cell + 1
    cells = (rng.random((rows, columns)) < 0.5).astype(np.uint8) * np.uint8(220) + np.uint8(24)
    code = np.kron(cells, np.ones((cell, cell), dtype=np.uint8))
    window[:] = code[: window.shape[0], : window.shape[1], None]
    digits = "".join(str(d) for d in rng.integers(0, 10, max(1, width // 16)))
    lettering(image, digits, (8, height - 6), min(16.0, height * 0.14), (30, 30, 34))
    return image


def _poster(rng: np.random.Generator, height: int, width: int, paint: Paint) -> Image:
    image = canvas(height, width, pick(rng, PAPER_COLOURS))
    art_h = int(height * 0.78)
    image[12:art_h, 12 : width - 12] = paint(rng, art_h - 12, width - 24)
    ink = pick(rng, INK_COLOURS)
    title_h = (height - art_h) * 0.34
    title = words(rng, max(4, int(width / (title_h * 1.1)))).upper()
    lettering(image, title, (18, art_h + title_h * 1.5), title_h, ink, 1, 0.14)
    _print_lines(image, rng, (18, art_h + title_h * 1.9, width - 18, height - 16), 11, ink)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), vary(rng, (58, 44, 36), 0.4), 14)
    grit(image, rng, 0.06)
    return image


def _print_lines(
    image: Image,
    rng: np.random.Generator,
    box: tuple[float, float, float, float],
    size: float,
    ink: Colour,
) -> None:
    """Fill a box (left, top, right, bottom) with lines of print, ``size`` texels high."""
    left, top, right, bottom = box
    y = top + size
    while y < bottom:
        num_letters = int((right - left) / size * rng.uniform(0.75, 1.0) * 1.05)
        if rng.random() < 0.88 and num_letters > 0:
            lettering(image, words(rng, num_letters), (left, y), size, ink, 0, 0.12)
        y += 1.75 * size


def _split_block(
    image: Image,
    rng: np.random.Generator,
    colours: list[Colour],
    box: tuple[float, float, float, float],
) -> None:
    left, top, right, bottom = box
    width, height = right - left, bottom - top
    if max(width, height) < rng.uniform(18, 60) or min(width, height) < 8:
        corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
        polygon(image, corners + rng.uniform(-2, 2, (4, 2)), vary(rng, pick(rng, colours), 0.2))
        return
    share, street = rng.uniform(0.3, 0.7), rng.uniform(1.5, 4.0)
    if width > height:
        cut = left + share * width
        _split_block(image, rng, colours, (left, top, cut - street, bottom))
        _split_block(image, rng, colours, (cut + street, top, right, bottom))
    else:
        cut = top + share * height
        _split_block(image, rng, colours, (left, top, right, cut - street))
        _split_block(image, rng, colours, (left, cut + street, right, bottom))
