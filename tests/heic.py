"""HEIC photos for tests: HEVC of the encoder of PyAV, in the least container that ISO 23008-12 asks
for."""

from __future__ import annotations

import struct
from fractions import Fraction

import av
import numpy as np
from numpy.typing import NDArray

_VPS, _SPS, _PPS = 32, 33, 34
# EXIF orientation: quarter turns anticlockwise (irot), then the mirroring (imir) if any: 1 mirrors
# left and right, 0 top and bottom. ISO 23008-12, 6.5.10 and 6.5.12.
_TURNS = {1: (0, None), 2: (0, 1), 3: (2, None), 4: (0, 0), 5: (1, 0), 6: (3, None), 7: (1, 1)}
_TURNS[8] = (1, None)


def heic(
    rgb: NDArray[np.uint8],
    orientation: int = 1,
    *,
    exif: bytes = b"",
    size: tuple[int, int] | None = None,
    ten_bits: bool = False,
    brand: bytes = b"heic",
) -> bytes:
    """Encode a photo as HEIC.

    Args:
        rgb: (H, W, 3) pixels as the sensor saw them; H and W even.
        orientation: how the container turns it (irot and imir), in EXIF's words.
        exif: as Pillow's ``Exif.tobytes`` gives it.
        size: width and height that the container declares, if not those of the pixels.
    """
    units = _hevc(rgb, "yuv420p10le" if ten_bits else "yuv420p")
    picture = b"".join(
        struct.pack(">I", len(unit)) + unit for unit in units if _kind(unit) not in (32, 33, 34)
    )
    height, width = rgb.shape[:2]
    quarter_turns, mirror = _TURNS[orientation]
    properties = [
        _box(b"hvcC", _hvcc(units, 10 if ten_bits else 8)),
        _COLOURS,
        _box(b"ispe", bytes(4) + struct.pack(">II", *(size or (width, height)))),
        *([_box(b"irot", bytes([quarter_turns]))] if quarter_turns else []),
        *([] if mirror is None else [_box(b"imir", bytes([mirror]))]),
    ]
    items = [(1, b"hvc1", picture)]
    if exif:
        items.append((2, b"Exif", bytes(4) + exif.removeprefix(b"Exif\0\0")))
    ftyp = _box(b"ftyp", brand + bytes(4) + b"mif1heic")
    start = 0
    for _ in range(2):  # the second time, the places of the items are known
        meta = _meta(properties, items, start)
        start = len(ftyp) + len(meta) + 8
    return ftyp + meta + _box(b"mdat", b"".join(data for _, _, data in items))


def tiled_heic(tile: NDArray[np.uint8], rows: int, columns: int, size: tuple[int, int]) -> bytes:
    """Make a HEIC photo of ``size`` (width, height) whose tiles are all the same bytes."""
    units, (height, width) = _hevc(tile, "yuv420p"), tile.shape[:2]
    picture = b"".join(
        struct.pack(">I", len(unit)) + unit for unit in units if _kind(unit) not in (32, 33, 34)
    )
    properties = [
        _box(b"hvcC", _hvcc(units, 8)),
        _box(b"ispe", bytes(4) + struct.pack(">II", width, height)),
        _box(b"ispe", bytes(4) + struct.pack(">II", *size)),
        _COLOURS,
    ]
    tiles = range(2, 2 + rows * columns)
    grid = struct.pack(">BBBBII", 0, 1, rows - 1, columns - 1, *size)
    kinds = [(1, b"grid"), *((number, b"hvc1") for number in tiles)]
    entries = b"".join(
        _box(b"infe", struct.pack(">IHH4s", 2 << 24, number, 0, kind) + b"\0")
        for number, kind in kinds
    )
    links = struct.pack(">HBBB", 1, 2, 0x83, 0x84) + b"".join(
        struct.pack(">HBBBB", number, 3, 0x81, 0x82, 0x84) for number in tiles
    )
    made_of = struct.pack(f">HH{len(tiles)}H", 1, len(tiles), *tiles)
    ftyp, start = _box(b"ftyp", b"heic" + bytes(4) + b"mif1heic"), 0
    for _ in range(2):  # the second time, the places of the items are known
        places = struct.pack(">HHHII", 1, 0, 1, start, len(grid)) + b"".join(
            struct.pack(">HHHII", number, 0, 1, start + len(grid), len(picture)) for number in tiles
        )
        parts = [
            _box(b"hdlr", bytes(8) + b"pict" + bytes(13)),
            _box(b"pitm", struct.pack(">IH", 0, 1)),
            _box(b"iinf", struct.pack(">IH", 0, len(kinds)) + entries),
            _box(b"iloc", struct.pack(">IBBH", 0, 0x44, 0, len(kinds)) + places),
            _box(
                b"iprp",
                _box(b"ipco", b"".join(properties))
                + _box(b"ipma", struct.pack(">II", 0, len(kinds)) + links),
            ),
            _box(b"iref", bytes(4) + _box(b"dimg", made_of)),
        ]
        meta = _box(b"meta", bytes(4) + b"".join(parts))
        start = len(ftyp) + len(meta) + 8
    return ftyp + meta + _box(b"mdat", grid + picture)


def _hevc(rgb: NDArray[np.uint8], layout: str) -> list[bytes]:
    """Encode one key frame; return its NAL units."""
    encoder = av.CodecContext.create("libx265", "w")
    encoder.height, encoder.width = rgb.shape[:2]
    encoder.pix_fmt, encoder.time_base = layout, Fraction(1, 25)
    encoder.options = {"x265-params": "crf=4:log-level=none:keyint=1:info=0:pools=none"}
    frame = av.VideoFrame.from_ndarray(rgb, format="rgb24").reformat(
        format=layout, dst_colorspace="ITU601"
    )
    packets = [*encoder.encode(frame), *encoder.encode(None)]
    stream = b"".join(bytes(packet) for packet in packets)
    units = stream.replace(b"\0\0\0\1", b"\0\0\1").split(b"\0\0\1")
    return [unit for unit in units if unit]


def _kind(unit: bytes) -> int:
    return unit[0] >> 1 & 63


def _hvcc(units: list[bytes], bits: int) -> bytes:
    """Make the decoder's configuration (ISO 14496-15, 8.3.3.1)."""
    sets = {kind: [u for u in units if _kind(u) == kind] for kind in (_VPS, _SPS, _PPS)}
    profile = sets[_SPS][0].replace(b"\0\0\3", b"\0\0")[3:15]
    start = b"\1" + profile + bytes([0xF0, 0, 0xFC, 0xFD, 0xF8 | bits - 8, 0xF8 | bits - 8, 0, 0])
    arrays = b"".join(
        struct.pack(">BH", 0x80 | kind, len(found))
        + b"".join(struct.pack(">H", len(unit)) + unit for unit in found)
        for kind, found in sets.items()
    )
    return start + bytes([0x0F, len(sets)]) + arrays


def _meta(properties: list[bytes], items: list[tuple[int, bytes, bytes]], start: int) -> bytes:
    entries = b"".join(
        _box(b"infe", struct.pack(">IHH4s", 2 << 24, number, 0, kind) + b"\0")
        for number, kind, _ in items
    )
    places = b""
    for number, _, data in items:
        places += struct.pack(">HHHII", number, 0, 1, start, len(data))
        start += len(data)
    links = b"".join(bytes([0x80 | index]) for index in range(1, len(properties) + 1))
    parts = [
        _box(b"hdlr", bytes(8) + b"pict" + bytes(13)),
        _box(b"pitm", struct.pack(">IH", 0, 1)),
        _box(b"iinf", struct.pack(">IH", 0, len(items)) + entries),
        _box(b"iloc", struct.pack(">IBBH", 0, 0x44, 0, len(items)) + places),
        _box(
            b"iprp",
            _box(b"ipco", b"".join(properties))
            + _box(b"ipma", struct.pack(">IIHB", 0, 1, 1, len(properties)) + links),
        ),
    ]
    if len(items) > 1:
        about = _box(b"cdsc", struct.pack(">HHH", 2, 1, 1))
        parts.append(_box(b"iref", bytes(4) + about))
    return _box(b"meta", bytes(4) + b"".join(parts))


def _box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content) + 8) + kind + content


_COLOURS = _box(b"colr", b"nclx" + struct.pack(">HHHB", 1, 13, 6, 0))  # sRGB, BT.601, video levels
