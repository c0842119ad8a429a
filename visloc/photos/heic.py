"""HEIC photos: pixels as the sensor saw them, and how their container turns them.

libheif decodes, through pi-heif. It turns and mirrors as the container says (ISO/IEC 23008-12,
``irot`` and ``imir``), and ignores the orientation in EXIF, as the standard asks for. Here the
turning is undone, so that a HEIC photo is like the JPEG of the same camera: pixels as stored, and
an orientation in EXIF's words.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pi_heif
from numpy.typing import NDArray

# Photos within a photo (gain maps, thumbnails, depth) are not looked at.
pi_heif.options.THUMBNAILS = False
pi_heif.options.DEPTH_IMAGES = False
pi_heif.options.AUX_IMAGES = False
# A process of the service or of a build has one core.
pi_heif.options.DECODE_THREADS = 1

_MAX_BOXES = _MAX_PICTURES = 10_000
# EXIF's orientation by the quarter turns clockwise that it asks for, and by whether the picture is
# mirrored left and right afterwards.
_ORIENTATIONS = {
    (0, False): 1,
    (1, False): 6,
    (2, False): 3,
    (3, False): 8,
    (0, True): 2,
    (1, True): 5,
    (2, True): 4,
    (3, True): 7,
}


@dataclass(frozen=True, slots=True)
class HeicOutline:
    """What the boxes of a HEIC file say, before anything is decoded.

    Attributes:
        orientation: 1 to 8, what ``irot`` and ``imir`` of the main picture do.
        most_pixels: width times height of the largest picture in the file: also tiles, thumbnails
            and masks of transparency, all of which a decoder may allocate.
        decoded_pixels: width times height of the main picture, of its tiles and of what belongs to
            them, such as transparency, together. Tiles may be larger than the picture in which they
            lie, and of the same few bytes.
    """

    orientation: int
    most_pixels: int
    decoded_pixels: int


def heic_outline(data: bytes) -> HeicOutline:
    """Read the boxes of a HEIC file."""
    _check_item_types(data)
    meta = _only(data, 0, len(data), b"meta")
    parts = {kind: (start, end) for kind, start, end in _boxes(data, meta[0] + 4, meta[1])}
    if not parts.keys() >= {b"pitm", b"iprp"}:
        raise ValueError("the file names no main picture or none of its properties")
    properties = list(_boxes(data, *_only(data, *parts[b"iprp"], b"ipco")))
    sizes = {
        index: _number(data, start + 4, 4) * _number(data, start + 8, 4)
        for index, (kind, start, _) in enumerate(properties, start=1)
        if kind == b"ispe"
    }
    most_pixels = max(sizes.values(), default=0)
    start = parts[b"pitm"][0]
    main = _number(data, start + 4, 4 if data[start] else 2)
    links = _links(data, _only(data, *parts[b"iprp"], b"ipma"))
    areas = {
        item: max((sizes.get(index, 0) for index in linked), default=0)
        for item, linked in links.items()
    }
    pieces = _pieces(data, *parts[b"iref"]) if b"iref" in parts else {}
    linked = links.get(main, [])
    turns, mirrored = 0, False
    for index in linked:
        if not 1 <= index <= len(properties):
            continue
        kind, start, _ = properties[index - 1]
        if kind == b"irot":
            clockwise = -(_number(data, start, 1) & 3)
            # Turning what is mirrored is mirroring what is turned the other way.
            turns += -clockwise if mirrored else clockwise
        elif kind == b"imir":
            # Top and bottom is left and right, and half a turn.
            turns += 0 if _number(data, start, 1) & 1 else 2
            mirrored = not mirrored
    return HeicOutline(
        _ORIENTATIONS[turns % 4, mirrored],
        most_pixels,
        sum(areas.get(item) or most_pixels for item in _all_pieces(main, pieces)),
    )


def decode_heic(opened: pi_heif.HeifFile) -> NDArray[np.uint8]:
    """Decode the main picture as its container turns it: (H, W, 3) RGB, without transparency."""
    pixels = np.asarray(opened[opened.primary_index])
    if pixels.dtype == np.uint16:  # grey of 10 bits, moved up to 16
        pixels = (pixels >> 8).astype(np.uint8)
    if pixels.ndim == 2 or pixels.shape[2] < 3:
        grey = pixels if pixels.ndim == 2 else pixels[..., 0]
        pixels = np.repeat(grey[..., None], 3, axis=2)
    # A copy: the array looks into memory that libheif frees together with ``opened``.
    return np.array(pixels[..., :3], order="C")


def _only(data: bytes, start: int, end: int, wanted: bytes) -> tuple[int, int]:
    """Return where the content of the first box of a kind starts and ends."""
    for kind, first, last in _boxes(data, start, end):
        if kind == wanted:
            return first, last
    raise ValueError(f"the file has no box {wanted.decode()}")


def _boxes(data: bytes, start: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Yield kind, start and end of the content of each box (ISO/IEC 14496-12, 4.2)."""
    for _ in range(_MAX_BOXES):
        if start + 8 > end:
            return
        size, kind, head = _number(data, start, 4), data[start + 4 : start + 8], 8
        if size == 1:
            size, head = _number(data, start + 8, 8), 16
        elif size == 0:
            size = end - start
        if size < head or start + size > end:
            raise ValueError(f"the box at byte {start} is longer than what holds it")
        yield kind, start + head, start + size
        start += size
    raise ValueError(f"the file has more than {_MAX_BOXES} boxes")


def _check_item_types(data: bytes) -> None:
    """Refuse a file that names a kind of item in other than printable ASCII.

    pi-heif up to 1.4.0 crashes on a metadata item whose type is not valid UTF-8 (mended by
    pillow_heif's pull request 478). ISO/IEC 14496-12 asks for four printable characters.
    """
    for meta, meta_start, meta_end in _boxes(data, 0, len(data)):
        if meta != b"meta":
            continue
        for items, start, end in _boxes(data, meta_start + 4, meta_end):
            if items != b"iinf":
                continue
            for entry, first, last in _boxes(data, start + (8 if data[start] else 6), end):
                # Versions 0 and 1 have no type; version 3 has wider numbers.
                if entry != b"infe" or data[first] < 2:
                    continue
                place = first + (8 if data[first] == 2 else 10)
                kind = data[place : min(place + 4, last)]
                if len(kind) < 4 or not all(0x20 <= letter < 0x7F for letter in kind):
                    raise ValueError(f"the type {kind!r} of an item is not four printable letters")


def _links(data: bytes, box: tuple[int, int]) -> dict[int, list[int]]:
    """Return the properties of each item, numbered from 1 (ISO/IEC 23008-12, 9.3)."""
    start, end = box
    wide_items, wide_links = data[start] > 0, data[start + 3] & 1
    found: dict[int, list[int]] = {}
    position = start + 8
    for _ in range(min(_number(data, start + 4, 4), _MAX_BOXES)):
        if position >= end:
            break
        item = _number(data, position, 4 if wide_items else 2)
        position += 4 if wide_items else 2
        count = _number(data, position, 1)
        position += 1
        size = 2 if wide_links else 1
        numbers = [_number(data, position + size * row, size) for row in range(count)]
        found.setdefault(item, []).extend(n & (0x7FFF if wide_links else 0x7F) for n in numbers)
        position += size * count
    return found


def _pieces(data: bytes, start: int, end: int) -> dict[int, list[int]]:
    """Return the pictures that each is made of or that belong to it (ISO/IEC 14496-12, 8.11.12)."""
    size = 4 if data[start] else 2
    found: dict[int, list[int]] = {}
    for kind, first, _ in _boxes(data, start + 4, end):
        item, count = _number(data, first, size), _number(data, first + size, 2)
        places = range(first + size + 2, first + size + 2 + size * count, size)
        others = [_number(data, place, size) for place in places]
        if kind == b"dimg":
            found.setdefault(item, []).extend(others)
        elif kind == b"auxl":
            for other in others:
                found.setdefault(other, []).append(item)
    return found


def _all_pieces(main: int, pieces: Mapping[int, Sequence[int]]) -> list[int]:
    """Return a picture and all pieces of its pieces, each as often as it is decoded."""
    every = [main]
    for item in every:
        every += pieces.get(item, ())
        if len(every) > _MAX_PICTURES:
            raise ValueError(f"the picture is made of more than {_MAX_PICTURES} others")
    return every


def _number(data: bytes, start: int, size: int) -> int:
    if start + size > len(data):
        raise ValueError("the file is cut off")
    return int.from_bytes(data[start : start + size])
