"""Brushes that every surface of the sample world is painted with.

Images are (H, W, 3) uint8 RGB, painted in place; lengths are in texels. Everything random comes
from the generator that is passed in.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Colour = tuple[int, int, int]
Paint = Callable[[np.random.Generator, int, int], Image]  # (rng, height, width)

# Drawing with 1/16 texel keeps edges where they were meant to be.
_SHIFT = 4
_FONTS = (
    cv2.FONT_HERSHEY_SIMPLEX,
    cv2.FONT_HERSHEY_DUPLEX,
    cv2.FONT_HERSHEY_COMPLEX,
    cv2.FONT_HERSHEY_TRIPLEX,
)
_LETTERS = "ABCDEFGHIJKLMNOPRSTUVWXYZ"
_SYLLABLES = (
    *("ka", "lo", "mi", "ter", "ra", "ven", "so", "lu", "pha", "dor", "nix", "el", "ba", "cu"),
    *("gra", "stel", "o", "quin", "ber", "tha", "ju", "wen", "zi", "mar", "hol", "ty", "fe", "us"),
)


def palette(text: str) -> list[Colour]:
    """Parse blank-separated hexadecimal colours, such as ``"d7263d f46036"``."""
    return [(int(c[0:2], 16), int(c[2:4], 16), int(c[4:6], 16)) for c in text.split()]


def canvas(height: int, width: int, colour: Colour) -> Image:
    """Return a plain image (height, width, 3) of one colour."""
    image = np.empty((height, width, 3), dtype=np.uint8)
    image[:] = colour
    return image


def pick(rng: np.random.Generator, colours: list[Colour]) -> Colour:
    """Pick one colour."""
    return colours[int(rng.integers(len(colours)))]


def vary(rng: np.random.Generator, colour: Colour, amount: float) -> Colour:
    """Return the colour, lighter or darker by up to ``amount`` and slightly off in hue."""
    factors = (1.0 + rng.uniform(-amount, amount)) * (1.0 + rng.uniform(-0.04, 0.04, 3))
    r, g, b = np.clip(np.multiply(colour, factors), 0, 255).astype(int).tolist()
    return r, g, b


def value_noise(
    rng: np.random.Generator, height: int, width: int, cell: tuple[float, float], octaves: int
) -> NDArray[np.float32]:
    """Sum smooth random fields, each of half the amplitude and half the cell of the one before.

    Args:
        width: columns of the result.
        cell: (along rows, along columns) size in texels of the largest cells.

    Returns:
        (height, width) float32, about -1 to 1.
    """
    total = np.zeros((height, width), dtype=np.float32)
    amplitude, (cell_y, cell_x) = 1.0, cell
    for _ in range(octaves):
        rows, columns = int(height / cell_y) + 3, int(width / cell_x) + 3
        grid = (rng.random((rows, columns), dtype=np.float32) * 2 - 1) * np.float32(amplitude)
        total += stretch(grid, height, width)
        amplitude, cell_y, cell_x = amplitude / 2, max(cell_y / 2, 1.0), max(cell_x / 2, 1.0)
    return total


def stretch(field: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
    """Interpolate a coarse field smoothly to (height, width)."""
    fine = cv2.resize(field, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(fine, dtype=np.float32)


def stain(image: Image, field: NDArray[np.float32], strength: float) -> None:
    """Make the image lighter and darker by a noise field (H, W)."""
    gain = np.float32(1.0) + np.float32(strength) * field
    for channel in range(3):
        painted = cv2.multiply(image[..., channel], gain, dtype=cv2.CV_8U)
        image[..., channel] = painted


def grit(image: Image, rng: np.random.Generator, strength: float) -> None:
    """Roughen the image with noise of a few texels, so that no spot is without detail."""
    stain(image, value_noise(rng, image.shape[0], image.shape[1], (7, 7), 2), strength)


def polygon(image: Image, points: NDArray[np.float64], colour: Colour) -> None:
    """Fill a convex polygon; points (N, 2) are (x, y)."""
    fixed = np.round(points * (1 << _SHIFT)).astype(np.int32)
    cv2.fillConvexPoly(image, fixed, colour, cv2.LINE_AA, _SHIFT)


def disc(
    image: Image,
    center: NDArray[np.float64],
    radius: float,
    colour: Colour,
    thickness: int = cv2.FILLED,
) -> None:
    """Draw a disc, or a ring of the given thickness."""
    x, y, r = (round(float(v) * (1 << _SHIFT)) for v in (center[0], center[1], radius))
    cv2.circle(image, (x, y), r, colour, thickness, cv2.LINE_AA, _SHIFT)


def shapes(
    image: Image,
    rng: np.random.Generator,
    colours: list[Colour],
    radii: tuple[float, float],
    coverage: float,
) -> None:
    """Scatter random polygons, discs and rings from large to small, as leaves that fell.

    The smaller the more of them, as in photos of nature, so that there is detail at every
    distance.

    Args:
        radii: (largest, smallest) in texels.
        coverage: share of the image that the largest would cover if they did not overlap; each
            halving of the size covers 0.8 times as much.
    """
    height, width = image.shape[:2]
    radius = radii[0]
    while radius >= radii[1]:
        count = max(1, round(coverage * height * width / (np.pi * radius**2)))
        _scatter(image, rng, colours, radius * rng.uniform(0.7, 1.4, count), round_share=0.2)
        radius, coverage = radius / 2, 0.8 * coverage


def chips(
    image: Image,
    rng: np.random.Generator,
    colours: list[Colour],
    radii: tuple[float, float],
    density: float,
) -> None:
    """Scatter small angular chips, ``density`` per 100 x 100 texels, radius within ``radii``."""
    height, width = image.shape[:2]
    count = round(density * height * width / 1e4)
    sizes = np.exp(rng.uniform(np.log(radii[0]), np.log(radii[1]), count))
    _scatter(image, rng, colours, sizes, round_share=0.0)


def words(rng: np.random.Generator, num_letters: int) -> str:
    """Return pseudo-words of about that many letters."""
    text = ""
    while len(text) < num_letters:
        parts = rng.choice(_SYLLABLES, int(rng.integers(1, 4)))
        text += ("" if not text else " ") + "".join(parts)
    return text[: max(1, num_letters)]


def lettering(
    image: Image,
    text: str,
    origin: tuple[float, float],
    height: float,
    colour: Colour,
    font: int = 0,
    weight: float = 0.1,
) -> None:
    """Write text whose capitals are ``height`` texels high; origin (x, y) is the lower left."""
    scale = height / 21.0  # a Hershey capital is about 21 units high
    cv2.putText(
        image,
        text,
        (round(origin[0]), round(origin[1])),
        _FONTS[font % len(_FONTS)],
        scale,
        colour,
        max(1, round(height * weight)),
        cv2.LINE_AA,
    )


def glyphs(
    image: Image,
    rng: np.random.Generator,
    colours: list[Colour],
    heights: tuple[float, float],
    count: int,
) -> None:
    """Scatter single letters and digits of random size, ``heights`` texels high, and colour."""
    rows, columns = image.shape[:2]
    for _ in range(count):
        height = float(np.exp(rng.uniform(np.log(heights[0]), np.log(heights[1]))))
        x, y = rng.uniform((-height / 2, height / 2), (columns, rows + height / 2))
        letter = str(rng.choice(list(_LETTERS + "23456789&%?")))
        font, weight = int(rng.integers(4)), rng.uniform(0.08, 0.2)
        lettering(image, letter, (x, y), height, pick(rng, colours), font, weight)


def paste(
    image: Image, patch: Image, center: tuple[float, float], angle: float, shadow: bool = True
) -> None:
    """Lay a patch onto the image, turned by ``angle`` (rad) about ``center`` (x, y)."""
    height, width = patch.shape[:2]
    cos, sin = np.cos(angle), np.sin(angle)
    image_from_patch = np.array(
        [
            [cos, -sin, center[0] - 0.5 * (width * cos - height * sin)],
            [sin, cos, center[1] - 0.5 * (width * sin + height * cos)],
        ]
    )
    reach = 0.5 * float(np.hypot(height, width)) + 6
    rows, columns = image.shape[:2]
    x0, x1 = (int(np.clip(center[0] + s * reach, 0, columns)) for s in (-1, 1))
    y0, y1 = (int(np.clip(center[1] + s * reach, 0, rows)) for s in (-1, 1))
    if x0 >= x1 or y0 >= y1:
        return
    image_from_patch[:, 2] -= (x0, y0)
    size = (x1 - x0, y1 - y0)
    window = image[y0:y1, x0:x1]
    if shadow:
        below = image_from_patch.copy()
        below[:, 2] += (3, 4)
        mask = cv2.warpAffine(np.full((height, width), 90, np.uint8), below, size)
        shade = cv2.GaussianBlur(mask, (9, 9), 2).astype(np.float32)
        window[:] = (window * (1 - shade[..., None] / 255)).astype(np.uint8)
    mask = cv2.warpAffine(np.full((height, width), 255, np.uint8), image_from_patch, size)
    warped = cv2.warpAffine(patch, image_from_patch, size, borderMode=cv2.BORDER_REPLICATE)
    alpha = mask[..., None].astype(np.float32) / 255
    window[:] = (window * (1 - alpha) + warped * alpha + 0.5).astype(np.uint8)


def _scatter(
    image: Image,
    rng: np.random.Generator,
    colours: list[Colour],
    sizes: NDArray[np.float64],
    round_share: float,
) -> None:
    """Draw shapes of the given radii (N,) at random places; a share of them is round."""
    height, width = image.shape[:2]
    count = len(sizes)
    centers = rng.uniform((0, 0), (width, height), (count, 2))
    tints = np.array(colours)[rng.integers(len(colours), size=count)]
    tints = tints * rng.uniform(0.72, 1.28, (count, 1)) * rng.uniform(0.96, 1.04, (count, 3))
    tints = np.clip(tints, 0, 255).astype(int).tolist()
    kinds = rng.random(count)
    num_corners = rng.integers(3, 6, count)
    angles = (np.arange(5) + rng.uniform(-0.3, 0.3, (count, 5))) * (
        2 * np.pi / num_corners[:, None]
    )
    flatness, turn = rng.uniform(0.4, 1.0, (count, 1)), rng.uniform(0, 2 * np.pi, (count, 1))
    x, y = np.cos(angles), flatness * np.sin(angles)
    outlines = np.stack(
        [np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y], axis=-1
    )
    outlines = centers[:, None] + sizes[:, None, None] * outlines
    for i, (r, g, b) in enumerate(tints):
        if kinds[i] < 0.6 * round_share:
            disc(image, centers[i], 0.8 * sizes[i], (r, g, b))
        elif kinds[i] < round_share:
            disc(image, centers[i], 0.8 * sizes[i], (r, g, b), max(1, round(0.2 * sizes[i])))
        else:
            polygon(image, outlines[i, : num_corners[i]], (r, g, b))
