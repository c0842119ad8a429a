from __future__ import annotations

import contextlib
import io
import math
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps, TiffImagePlugin

from tests.heic import heic, tiled_heic
from visloc.errors import InvalidInput, NotFound, TooLarge
from visloc.photos import formats as photo_formats
from visloc.photos.reading import (
    ImageLimits,
    read_photo,
    read_photo_file,
    stored_from_upright,
    turn_of,
    upright,
    upright_from_stored,
    with_mask,
)

ORIENTATIONS = range(1, 9)
LOSSLESS = {"PNG": {}, "BMP": {}, "TIFF": {}, "WEBP": {"lossless": True, "exact": True}}


def texture(width: int = 48, height: int = 32, seed: int = 0) -> NDArray[np.uint8]:
    noise = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (5, 5), 1.5), dtype=np.uint8)


def encode(image: Image.Image, file_format: str, **options: object) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, file_format, **options)
    return buffer.getvalue()


def exif_with(orientation: int | None = None, **details: object) -> Image.Exif:
    exif = Image.Exif()
    if orientation is not None:
        exif[ExifTags.Base.Orientation] = orientation
    ifd = exif.get_ifd(ExifTags.IFD.Exif)
    for name, value in details.items():
        ifd[ExifTags.Base[name]] = value
    return exif


def png_header(width: int, height: int) -> bytes:
    body = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunk = struct.pack(">I", 13) + body + struct.pack(">I", zlib.crc32(body))
    return b"\x89PNG\r\n\x1a\n" + chunk + struct.pack(">I", 10) + b"IDAT" + bytes(10)


def refusal(data: bytes, limits: ImageLimits | None = None) -> InvalidInput:
    with pytest.raises(InvalidInput) as caught:
        read_photo(data, limits or ImageLimits())
    return caught.value


# What comes out


@pytest.mark.parametrize("file_format", LOSSLESS)
@pytest.mark.parametrize("mode", ["RGB", "L", "P", "1"])
def test_every_colour_kind_of_every_format_gives_its_rgb_pixels(
    file_format: str, mode: str
) -> None:
    image = Image.fromarray(texture())
    image = image.quantize(64) if mode == "P" else image.convert(mode)
    if file_format == "WEBP":
        image = image.convert("RGB")

    photo = read_photo(encode(image, file_format, **LOSSLESS[file_format]))

    assert photo.rgb.dtype == np.uint8
    assert photo.rgb.flags.c_contiguous
    assert (photo.width, photo.height) == (48, 32)
    np.testing.assert_array_equal(photo.rgb, np.asarray(image.convert("RGB")))


@pytest.mark.parametrize("file_format", ["PNG", "WEBP", "BMP", "TIFF"])
def test_transparency_is_ignored_and_colours_stay(file_format: str) -> None:
    image = Image.fromarray(texture())
    image.putalpha(Image.fromarray(texture(seed=1)[..., 0]))

    photo = read_photo(encode(image, file_format, **LOSSLESS[file_format]))

    np.testing.assert_array_equal(photo.rgb, texture())


def test_transparency_of_a_palette_or_of_grey_is_ignored() -> None:
    palette = Image.fromarray(texture()).quantize(64)
    some = bytes(range(0, 256, 4))
    photo = read_photo(encode(palette, "PNG", transparency=some))
    np.testing.assert_array_equal(photo.rgb, np.asarray(palette.convert("RGB")))

    grey = Image.fromarray(texture()).convert("LA")
    np.testing.assert_array_equal(
        read_photo(encode(grey, "PNG")).rgb, np.asarray(grey.convert("L").convert("RGB"))
    )


@pytest.mark.parametrize("extension", [".png", ".tiff"])
@pytest.mark.parametrize("channels", [1, 3])
def test_16_bit_photos_keep_their_upper_byte(extension: str, channels: int) -> None:
    wide = np.random.default_rng(0).integers(0, 65536, (32, 48, channels)).astype(np.uint16)
    data = cv2.imencode(extension, wide[..., ::-1])[1].tobytes()

    difference = read_photo(data).rgb.astype(int) - (wide >> 8)

    assert np.abs(difference).max() <= 1  # TIFF colours are rounded, the others cut


@pytest.mark.parametrize("mode", ["RGB", "L", "CMYK"])
def test_jpeg_is_decoded_as_pillow_does(mode: str) -> None:
    data = encode(Image.fromarray(texture()).convert(mode), "JPEG", quality=95)
    expected = np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)

    assert np.abs(read_photo(data).rgb - expected).max() <= 2


def test_a_photo_of_one_pixel_is_a_photo() -> None:
    photo = read_photo(encode(Image.new("RGB", (1, 1), (1, 2, 3)), "PNG"))

    assert photo.rgb.tolist() == [[[1, 2, 3]]]


# Orientation


@pytest.mark.parametrize("file_format", ["PNG", "TIFF", "JPEG", "WEBP"])
@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_pixels_come_as_stored_whatever_the_orientation(file_format: str, orientation: int) -> None:
    options = LOSSLESS.get(file_format, {"quality": 100, "subsampling": 0})
    data = encode(Image.fromarray(texture()), file_format, exif=exif_with(orientation), **options)

    photo = read_photo(data)

    assert photo.exif_orientation == orientation
    assert np.abs(photo.rgb.astype(int) - texture()).mean() < 3


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_upright_is_pillows_exif_transpose(orientation: int) -> None:
    image = Image.fromarray(texture(7, 5))
    image.getexif()[ExifTags.Base.Orientation] = orientation

    turned = upright(texture(7, 5), orientation)

    np.testing.assert_array_equal(turned, np.asarray(ImageOps.exif_transpose(image)))
    assert turned.flags.c_contiguous


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_points_of_the_upright_photo_return_to_the_stored_pixel(orientation: int) -> None:
    height, width = 5, 7
    stored_index = np.arange(height * width * 3).astype(np.uint8).reshape(height, width, 3)
    turned = upright(stored_index, orientation)
    rows, columns = np.mgrid[: turned.shape[0], : turned.shape[1]]
    centres = np.column_stack([columns.ravel(), rows.ravel()]) + 0.5

    stored = stored_from_upright(centres, orientation, width, height)

    column, row = np.floor(stored).astype(int).T
    np.testing.assert_array_equal(stored - np.floor(stored), 0.5)
    np.testing.assert_array_equal(stored_index[row, column], turned.reshape(-1, 3))


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_points_go_to_the_upright_photo_and_come_back(orientation: int) -> None:
    stored = np.random.default_rng(0).uniform(0, 5, (20, 2)).astype(np.float32)

    there = upright_from_stored(stored, orientation, 7, 5)
    back = stored_from_upright(there, orientation, 7, 5)

    assert there.dtype == np.float32
    np.testing.assert_allclose(back, stored, atol=1e-6)


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_the_turn_of_an_orientation_is_all_of_it_but_the_mirroring(orientation: int) -> None:
    asked, turned = (upright(texture(7, 5), one) for one in (orientation, turn_of(orientation)))

    mirrored = orientation in (2, 4, 5, 7)
    np.testing.assert_array_equal(turned, asked[:, ::-1] if mirrored else asked)
    assert turn_of(orientation) in (1, 3, 6, 8)


def test_moving_points_keeps_their_type_and_takes_none() -> None:
    points = np.array([[0.25, 1.75]], dtype=np.float32)

    assert stored_from_upright(points, 6, 4, 3).dtype == np.float32
    np.testing.assert_array_equal(stored_from_upright(points, 6, 4, 3), [[1.75, 2.75]])
    assert stored_from_upright(np.empty((0, 2)), 8, 4, 3).shape == (0, 2)


@pytest.mark.parametrize("orientation", [0, 9, 65535])
def test_an_invalid_orientation_counts_as_none(orientation: int) -> None:
    for file_format in ("JPEG", "TIFF"):
        data = encode(Image.fromarray(texture()), file_format, exif=exif_with(orientation))
        assert read_photo(data).exif_orientation == 1
        assert read_photo(data).rgb.shape == (32, 48, 3)


# Focal length


def focal_length_of(width: int = 400, height: int = 300, **details: object) -> float | None:
    data = encode(Image.new("RGB", (width, height)), "JPEG", exif=exif_with(None, **details))
    return read_photo(data).focal_length_px


def test_focal_length_from_the_35_mm_equivalent_compares_diagonals() -> None:
    expected = 26 / math.hypot(36, 24) * 500

    assert focal_length_of(FocalLengthIn35mmFilm=26) == pytest.approx(expected)
    assert focal_length_of(300, 400, FocalLengthIn35mmFilm=26) == pytest.approx(expected)


def test_focal_length_from_the_sensors_resolution() -> None:
    sensor = {"FocalLength": 8.0, "FocalPlaneXResolution": 1000.0}  # 8 inch at 1000 px per inch

    assert focal_length_of(
        **sensor, FocalPlaneResolutionUnit=3, ExifImageWidth=400, ExifImageHeight=300
    ) == pytest.approx(8.0 * 1000 / 10)
    assert focal_length_of(**sensor) == pytest.approx(8.0 * 1000 / 25.4, rel=1e-6)
    # Taken with 800 x 600 pixels and made smaller since.
    assert focal_length_of(
        **sensor, FocalPlaneResolutionUnit=3, ExifImageWidth=800, ExifImageHeight=600
    ) == pytest.approx(400)


@pytest.mark.parametrize(
    "details",
    [
        {},
        {"FocalLengthIn35mmFilm": 26, "DigitalZoomRatio": 2.0},  # with it, or without?
        {"FocalLengthIn35mmFilm": 0},  # EXIF's word for unknown
        {"FocalLengthIn35mmFilm": 1},  # implausible
        {"FocalLength": 4.2},  # says nothing without the sensor's size
        {"FocalLength": 0.0, "FocalPlaneXResolution": 1000.0},
        {"FocalLength": 8.0, "FocalPlaneXResolution": 1000.0, "FocalPlaneResolutionUnit": 9},
    ],
)
def test_an_absent_or_implausible_focal_length_is_none(details: dict[str, object]) -> None:
    assert focal_length_of(**details) is None


def test_exif_is_read_without_decoding_a_png_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    data = encode(Image.fromarray(texture()), "PNG")
    monkeypatch.setattr("PIL.ImageFile.ImageFile.load", lambda _: pytest.fail("decoded"))

    assert read_photo(data).exif_orientation == 1


@pytest.mark.filterwarnings("ignore::UserWarning")  # Pillow's, about what it finds
def test_broken_exif_counts_as_absent() -> None:
    exif = exif_with(6, FocalLengthIn35mmFilm=26).tobytes()
    random = np.random.default_rng(0)
    image = Image.fromarray(texture())
    for _ in range(200):
        broken = bytearray(exif)
        for position in random.integers(6, len(broken), 4):
            broken[position] = random.integers(256)
        photo = read_photo(encode(image, "JPEG", exif=bytes(broken)))
        assert 1 <= photo.exif_orientation <= 8
        assert photo.focal_length_px is None or photo.focal_length_px > 0


# Refusals


def test_no_bytes_are_refused() -> None:
    error = refusal(b"")

    assert (error.code, error.field, error.got) == ("image.empty", "image", "0 bytes")


@pytest.mark.parametrize(
    "data",
    [
        b"hello, this is no image at all",
        b"\x00",
        b"GIF89a" + bytes(100),
        b"%PDF-1.7" + bytes(100),
        b"RIFF\x00\x00\x00\x00WAVE" + bytes(100),
        b"<svg xmlns='http://www.w3.org/2000/svg'/>",
    ],
)
def test_what_is_not_an_image_is_refused_with_the_formats_that_are_read(data: bytes) -> None:
    error = refusal(data)

    assert error.code == "image.format"
    assert error.expected == "JPEG, HEIC, PNG, WebP, AVIF, TIFF or BMP"


@pytest.mark.parametrize(
    ("data", "name", "part"),
    [
        (b"\0\0\0\x0cJXL \r\n\x87\n", "JPEG XL", "convert them to JPEG"),
        (b"II*\0\x10\0\0\0CR\2\0", "raw", "develop them to JPEG"),
        (b"\0\0\0\x14ftypqt  \0\0\0\0qt  ", "MOV", "mapping capture VIDEO"),
        (b"\0\0\0\x18ftypmp42\0\0\0\0mp42isom", "MP4", "mapping capture VIDEO"),
        (b"GIF89a" + bytes(100), "GIF", "save them as PNG"),
    ],
)
def test_a_kind_that_is_not_read_is_named_with_what_to_do(
    data: bytes, name: str, part: str
) -> None:
    error = refusal(data)

    assert (error.code, error.got) == ("image.format", name)
    assert part in error.message


def test_a_raw_photo_is_not_taken_for_its_thumbnail() -> None:
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags[50706] = b"\x01\x04\x00\x00"  # DNGVersion
    file = io.BytesIO()
    Image.fromarray(texture(40, 30)).save(file, "TIFF", tiffinfo=tags)

    error = refusal(file.getvalue())

    assert (error.code, error.got) == ("image.format", "raw")


@pytest.mark.parametrize("file_format", ["JPEG", "PNG", "WEBP", "TIFF", "BMP"])
@pytest.mark.parametrize("kept", [0.05, 0.3, 0.6, 0.95])
@pytest.mark.filterwarnings("ignore:Truncated File Read", "ignore:Corrupt EXIF data")
def test_a_photo_that_is_cut_off_is_refused(file_format: str, kept: float) -> None:
    data = encode(Image.fromarray(texture(200, 150)), file_format)

    error = refusal(data[: int(len(data) * kept)])

    assert error.code == "image.undecodable"
    assert "cut off" in error.message


def test_a_jpeg_with_a_damaged_middle_that_decodes_is_accepted() -> None:
    data = bytearray(encode(Image.fromarray(texture(200, 150)), "JPEG"))
    middle = len(data) // 2
    data[middle : middle + 50] = bytes(50)

    assert read_photo(bytes(data)).rgb.shape == (150, 200, 3)


def test_too_many_bytes_are_refused_before_they_are_looked_at() -> None:
    with pytest.raises(TooLarge) as caught:
        read_photo(b"not an image", ImageLimits(max_bytes=11))

    error = caught.value
    assert (error.code, error.expected, error.got) == (
        "image.too_large",
        "at most 11 bytes",
        "12 bytes",
    )


@pytest.mark.parametrize("size", [(8000, 8000), (2**31 - 1, 1), (1, 2**31 - 1), (10**6, 10**6)])
def test_too_many_pixels_are_refused_from_the_header(
    size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))

    with pytest.raises(TooLarge) as caught:
        read_photo(png_header(*size))

    error = caught.value
    assert error.code == "image.too_many_pixels"
    assert error.expected == "at most 50000000 pixels"
    assert error.got == f"{size[0]} x {size[1]}"


@pytest.mark.parametrize("position", [33, -12])
def test_a_png_chunk_that_claims_gigabytes_never_reaches_the_decoder(
    position: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    # OpenCV would allocate what the chunk claims: found by fuzzing.
    data = encode(Image.fromarray(texture()), "PNG")
    position %= len(data)
    lying = data[:position] + struct.pack(">I", 2**31 - 1) + b"aBCd" + data[position:]
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))

    assert refusal(lying).code == "image.undecodable"


# Work


def progressive(
    mode: str = "RGB", more: bytes = b"", times: int = 1, size: tuple[int, int] = (48, 32)
) -> bytes:
    """A JPEG with ``more`` and a copy of its last scan, so many times, before its end."""
    jpeg = encode(Image.fromarray(texture(*size)).convert(mode), "JPEG", progressive=True)
    last, end = jpeg.rindex(b"\xff\xda"), jpeg.rindex(b"\xff\xd9")
    return jpeg[:end] + (more + jpeg[last:end]) * (times if more or times > 1 else 0) + jpeg[end:]


@pytest.mark.parametrize(
    "before_each",
    [
        *(b"\xff" * 3, b"\0\1 garbage \xff\0", b"\xff\xd0\xff\xd7", b"\xff\x01\xff\xbf"),
        *(b"\xff\xfe\0\2", b"\xff\xe1\0\4\xff\xd9", b"\xff\xfe\0\0", b"\xff\xdd\0\4\0\1"),
        *(b"\xff\xd8", b"\xff\xf0\0\xff", b"\xff\xc8"),
    ],
)
def test_a_jpeg_of_very_many_scans_is_refused_before_it_is_decoded(
    before_each: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "visloc.photos.formats._decode_with_opencv", lambda *_: pytest.fail("it was decoded")
    )

    error = refusal(progressive(more=before_each, times=300))

    assert isinstance(error, TooLarge)
    assert (error.code, error.field) == ("image.too_complex", "image")
    assert (error.expected, error.got) == ("at most 100 scans of 48 x 32 pixels", "310 scans")


def test_the_largest_photos_may_have_fewer_scans() -> None:
    limits = ImageLimits(max_pixels=48 * 32)

    assert read_photo(progressive(times=10), limits).width == 48  # 10 of its own
    error = refusal(progressive(times=11), limits)

    assert (error.code, error.got) == ("image.too_complex", "21 scans")


def jpeg_in_tiff(jpeg: bytes, width: int, height: int) -> bytes:
    """A TIFF of one strip with compression 7 (JPEG), in colour (YCbCr)."""
    bits = 8 + 2 + 12 * 10 + 4  # behind the header and the directory
    fields = [
        *((256, 4, 1, width), (257, 4, 1, height), (258, 3, 3, bits), (259, 3, 1, 7)),
        *((262, 3, 1, 6), (273, 4, 1, bits + 6), (277, 3, 1, 3), (278, 4, 1, height)),
        *((279, 4, 1, len(jpeg)), (530, 3, 2, 2 | 2 << 16)),
    ]
    directory = b"".join(struct.pack("<HHII", *field) for field in fields)
    return (
        (b"II*\0" + struct.pack("<IH", 8, len(fields)) + directory + bytes(4))
        + struct.pack("<HHH", 8, 8, 8)
        + jpeg
    )


def test_a_jpeg_within_a_tiff_has_no_more_scans_than_the_largest_photo() -> None:
    assert read_photo(jpeg_in_tiff(progressive(times=8), 48, 32)).width == 48

    assert refusal(jpeg_in_tiff(progressive(times=40), 48, 32)).code == "image.undecodable"


@pytest.mark.parametrize("mode", ["L", "RGB", "CMYK"])
def test_what_encoders_write_is_far_from_too_many_scans(mode: str) -> None:
    image = Image.fromarray(texture()).convert(mode)
    for options in ({}, {"progressive": True}, {"restart_marker_blocks": 1}):
        read_photo(encode(image, "JPEG", **options), ImageLimits(max_pixels=48 * 32))


def test_scans_of_thumbnails_and_of_what_follows_the_picture_do_not_count() -> None:
    other = progressive(times=50)
    parts = b"".join(
        b"\xff\xe2" + (len(other) + 2).to_bytes(2, "big") + other  # a thumbnail
        for _ in range(10)
    )
    jpeg = encode(Image.fromarray(texture()), "JPEG")

    photo = read_photo(jpeg[:2] + parts + jpeg[2:] + other * 10 + b"\xff\xda" * 1000)

    np.testing.assert_array_equal(photo.rgb, read_photo(jpeg).rgb)


@pytest.mark.parametrize(
    "filler",
    [
        b"\xff\xfe\0\2" * 100_001,  # comments without a word
        b"\xff" * 100_001,
        b"\xff\0" * 50_001,
        b"\xff\xd0" * 50_001,
        b"\xff\xd9" + b"\xff\xe1\0\2" * 100_001,
    ],
)
def test_a_jpeg_of_very_many_segments_is_refused(filler: bytes) -> None:
    jpeg = encode(Image.fromarray(texture()), "JPEG")

    assert refusal(jpeg[:2] + filler + jpeg[2:]).code == "image.too_complex"


def test_a_png_of_very_many_chunks_is_refused() -> None:
    png = encode(Image.fromarray(texture()), "PNG")
    chunk = struct.pack(">I4sI", 0, b"prVt", zlib.crc32(b"prVt"))

    assert refusal(png[:33] + chunk * 100_000 + png[33:]).code == "image.too_complex"
    assert read_photo(png[:33] + chunk * 90_000 + png[33:]).width == 48


def test_a_png_with_two_headers_is_refused() -> None:
    # Whose size was checked, and whose is decoded?
    small = encode(Image.fromarray(texture()), "PNG")
    two = png_header(30_000, 30_000)[:33] + small[8:]

    assert refusal(two, ImageLimits(max_pixels=10**10)).code == "image.undecodable"
    assert refusal(small[:33] + small[8:]).code == "image.undecodable"


def test_an_animation_gives_its_first_picture() -> None:
    first, second = (Image.fromarray(texture(seed=seed)) for seed in (0, 1))
    for file_format in ("PNG", "TIFF", "WEBP"):
        data = encode(
            first, file_format, save_all=True, append_images=[second], **LOSSLESS[file_format]
        )
        np.testing.assert_array_equal(read_photo(data).rgb, texture())


def test_the_limits_themselves_are_allowed() -> None:
    data = encode(Image.fromarray(texture()), "PNG")

    read_photo(data, ImageLimits(max_bytes=len(data), max_pixels=48 * 32))
    assert refusal(data, ImageLimits(max_pixels=48 * 32 - 1)).code == "image.too_many_pixels"


def test_a_tiff_whose_strips_claim_gigabytes_never_reaches_the_decoder(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = encode(Image.fromarray(texture()), "TIFF", tiffinfo={278: 8_000_000})
    assert TiffImagePlugin.TiffImageFile(io.BytesIO(data)).tag_v2[278] == 8_000_000
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))

    assert refusal(data).code == "image.format"


def test_exif_that_points_at_itself_counts_as_none() -> None:
    # One directory whose entry for the Exif part, and whose next directory, is itself.
    entry = struct.pack("<HHII", ExifTags.IFD.Exif, 4, 1, 8)
    looped = b"Exif\0\0II*\0" + struct.pack("<IH", 8, 1) + entry + struct.pack("<I", 8)

    for file_format in ("JPEG", "PNG", "WEBP", "AVIF"):
        photo = read_photo(encode(Image.fromarray(texture()), file_format, exif=looped))
        assert (photo.exif_orientation, photo.focal_length_px) == (1, None)
    assert read_photo(heic(texture(), exif=looped)).exif_orientation == 1


@pytest.mark.parametrize("kept", [0.05, 0.3, 0.6, 0.95])
@pytest.mark.parametrize("file_format", ["HEIC", "AVIF"])
def test_a_photo_of_boxes_that_is_cut_off_is_refused(file_format: str, kept: float) -> None:
    rgb = texture(200, 152)
    data = heic(rgb) if file_format == "HEIC" else encode(Image.fromarray(rgb), "AVIF")

    assert refusal(data[: int(len(data) * kept)]).code == "image.undecodable"


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA"])
def test_avif_of_every_kind_of_pixels_reads_as_pillow_shows_it(mode: str) -> None:
    data = encode(Image.fromarray(texture()).convert(mode), "AVIF")

    photo = read_photo(data)

    np.testing.assert_array_equal(photo.rgb, Image.open(io.BytesIO(data)).convert("RGB"))
    assert photo.rgb.flags.writeable


@pytest.mark.parametrize("declared", [(48, 34), (8, 8), (4000, 4000), (0, 0), (48, 0)])
def test_a_heic_photo_of_another_size_than_it_declares_is_refused(
    declared: tuple[int, int],
) -> None:
    assert refusal(heic(texture(), size=declared)).code == "image.undecodable"


@pytest.mark.parametrize("options", [{}, {"lossless": True}, {"exif": b"Exif\0\0"}])
def test_a_webp_photo_is_measured_before_memory_is_set_aside(
    options: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whichever chunk says its size: lossy, lossless and extended."""
    data = encode(Image.fromarray(texture()), "WEBP", **options)
    pixels = texture().shape[0] * texture().shape[1]
    assert read_photo(data, ImageLimits(max_pixels=pixels)).rgb.shape == texture().shape

    monkeypatch.delattr(photo_formats, "_READERS")
    error = refusal(data, ImageLimits(max_pixels=pixels - 1))
    assert error.code == "image.too_many_pixels"
    assert f"{pixels} pixels" in str(error)


def test_a_tiff_photo_whose_rows_per_strip_are_bytes_is_refused() -> None:
    """Found by the fuzzer."""
    data = encode(Image.fromarray(texture()), "TIFF", compression="tiff_lzw")
    at = next(
        data.index(entry)
        for entry in (struct.pack("<2H", 278, 3), struct.pack("<2H", 278, 4))
        if entry in data
    )
    undefined = struct.pack("<2HI", 278, 7, 4)

    error = refusal(data[:at] + undefined + data[at + len(undefined) :])

    assert error.code == "image.undecodable"
    assert "tag 278 is bytes" in str(error)


def test_a_heic_item_whose_type_is_not_text_is_refused() -> None:
    """pi-heif 1.4.0 ends the process on it. Found by the fuzzer."""
    data = heic(texture(), exif=Image.Exif().tobytes())
    start = data.index(b"Exif")

    for kind in (b"Ex\xef" + b"f", b"\xff" * 4, b"Exi\0"):
        error = refusal(data[:start] + kind + data[start + 4 :])
        assert error.code == "image.undecodable"
        assert "printable" in str(error)


def test_a_heic_photo_that_declares_too_many_pixels_is_refused_from_its_header() -> None:
    error = refusal(heic(texture(), size=(20_000, 20_000)))

    assert (error.code, error.got) == ("image.too_many_pixels", "20000 x 20000")


def test_a_heic_photo_of_tiles_is_read_and_one_of_very_many_is_refused() -> None:
    tile = np.full((256, 256, 3), 90, np.uint8)
    limits = ImageLimits(max_pixels=512 * 512)

    photo = read_photo(tiled_heic(tile, 2, 2, (512, 512)), limits)
    error = refusal(tiled_heic(tile, 5, 5, (256, 256)), limits)

    assert photo.rgb.shape == (512, 512, 3)
    assert np.abs(photo.rgb.astype(int) - 90).max() <= 2
    assert (error.code, error.got) == ("image.too_complex", f"{26 * 256 * 256} pixels")


@pytest.mark.parametrize("side", [64, 1024])
def test_the_pixels_of_a_heic_photo_stay_when_the_decoder_is_gone(side: int) -> None:
    rgb = read_photo(heic(np.full((side, side, 3), 90, np.uint8))).rgb

    assert np.abs(rgb.astype(int) - 90).max() <= 2


# Photos of very many pixels


def test_a_large_jpeg_is_reduced_while_it_is_decoded() -> None:
    smooth = cv2.GaussianBlur(texture(403, 301), (0, 0), 8)
    data = encode(Image.fromarray(smooth), "JPEG", quality=95, subsampling=0)

    photo = read_photo(data, ImageLimits(max_pixels=403 * 301 // 2))

    assert (photo.reduced, photo.file_size) == (2, (403, 301))
    assert (photo.width, photo.height) == (201, 150)
    # A pixel is the mean of those that it spans, so that (u, v) becomes (u / 2, v / 2).
    spanned = smooth[:300, :402].reshape(150, 2, 201, 2, 3).mean(axis=(1, 3))
    assert np.abs(photo.rgb - spanned).mean() < 1


def test_a_mask_is_reduced_as_its_photo_is() -> None:
    shown = np.zeros((301, 403), np.uint8)
    shown[:, 200:] = 255
    photo = encode(Image.fromarray(texture(403, 301)), "JPEG")
    mask = encode(Image.fromarray(shown), "JPEG")
    limits = ImageLimits(max_pixels=403 * 301 // 2)

    masked = with_mask(read_photo(photo, limits), mask, limits)

    assert masked.reduced == 2
    points = np.array([[10.0, 10.0], [95.0, 149.0], [105.0, 10.0], [201.0, 150.0]])
    assert masked.counts(points).tolist() == [False, False, True, True]


@pytest.mark.parametrize("file_format", ["PNG", "TIFF"])
def test_masks_in_16_bits_or_with_transparent_pixels_are_refused_by_name(file_format: str) -> None:
    photo = read_photo(encode(Image.fromarray(texture(40, 30)), "JPEG"))
    objects = np.full((30, 40), 7, np.uint16)  # all black in 8 bits
    cut_out = np.full((30, 40, 4), 255, np.uint8)
    opaque = encode(Image.fromarray(cut_out), file_format)
    cut_out[:, :20, 3] = 0

    for pixels, got in ((objects, "16 bits per sample"), (cut_out, "transparent pixels")):
        with pytest.raises(InvalidInput) as caught:
            with_mask(photo, encode(Image.fromarray(pixels), file_format), field="masks/a.png")
        assert (caught.value.code, caught.value.field) == ("mask.kind", "masks/a.png")
        assert caught.value.got == got
    assert with_mask(photo, opaque).mask is not None


def test_the_focal_length_of_a_reduced_photo_is_in_its_pixels() -> None:
    data = encode(Image.new("RGB", (400, 300)), "JPEG", exif=exif_with(FocalLengthIn35mmFilm=26))

    reduced = read_photo(data, ImageLimits(max_pixels=30_000))

    assert (reduced.reduced, reduced.width) == (2, 200)
    assert reduced.focal_length_px == pytest.approx(26 / math.hypot(36, 24) * 250)


def test_a_large_jpeg_that_would_take_memory_for_all_its_pixels_is_refused() -> None:
    data = encode(Image.fromarray(texture(400, 300)), "JPEG", progressive=True)

    assert refusal(data, ImageLimits(max_pixels=60_000)).code == "image.too_complex"


@pytest.mark.parametrize("file_format", ["JPEG", "PNG", "WEBP", "AVIF", "TIFF", "BMP"])
def test_only_jpegs_may_have_more_pixels_than_the_limit(file_format: str) -> None:
    data = encode(Image.fromarray(texture(400, 300)), file_format)
    few = ImageLimits(max_pixels=(30_000 if file_format == "JPEG" else 120_000) - 1)

    error = refusal(data, few)

    most = few.max_pixels * (4 if file_format == "JPEG" else 1)
    assert (error.code, error.expected) == ("image.too_many_pixels", f"at most {most} pixels")


def test_a_tiff_of_floats_is_refused() -> None:
    data = cv2.imencode(".tiff", texture().astype(np.float32) / 255)[1].tobytes()

    assert refusal(data).code in ("image.format", "image.undecodable")


@pytest.mark.filterwarnings("ignore::UserWarning")  # Pillow's, about what it finds
@pytest.mark.parametrize("file_format", ["JPEG", "PNG", "WEBP", "AVIF", "TIFF", "BMP"])
def test_damaged_files_are_read_or_refused_and_nothing_else(file_format: str) -> None:
    data = encode(
        Image.fromarray(texture()),
        file_format,
        **({} if file_format == "BMP" else {"exif": exif_with(6, FocalLengthIn35mmFilm=26)}),
    )
    random = np.random.default_rng(1)
    limits = ImageLimits(max_pixels=100_000)
    for _ in range(400):
        damaged = bytearray(data)
        # The first bytes decide most; a few hits anywhere.
        for position in (*random.integers(2, 200, 2), *random.integers(2, len(data), 2)):
            damaged[min(position, len(data) - 1)] = random.integers(256)
        if random.random() < 0.2:
            del damaged[random.integers(len(data)) :]
        with contextlib.suppress(InvalidInput):
            photo = read_photo(bytes(damaged), limits)
            assert photo.width * photo.height <= limits.max_pixels


# Files


def test_a_file_is_read_and_named_when_it_is_wrong(tmp_path: Path) -> None:
    good, bad = tmp_path / "good.png", tmp_path / "bad.png"
    good.write_bytes(encode(Image.fromarray(texture()), "PNG"))
    bad.write_bytes(b"no image")

    np.testing.assert_array_equal(read_photo_file(good).rgb, texture())
    with pytest.raises(InvalidInput) as caught:
        read_photo_file(bad)
    assert (caught.value.code, caught.value.field) == ("image.format", str(bad))


def test_a_missing_or_unreadable_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(NotFound) as missing:
        read_photo_file(tmp_path / "absent.jpg")
    with pytest.raises(InvalidInput) as folder:
        read_photo_file(tmp_path)

    assert (missing.value.code, missing.value.field) == (
        "image.missing",
        str(tmp_path / "absent.jpg"),
    )
    assert folder.value.code == "image.unreadable"


def test_a_file_above_the_limit_is_refused_without_reading_it_all(tmp_path: Path) -> None:
    huge = tmp_path / "huge.jpg"
    with huge.open("wb") as file:
        file.truncate(2**40)

    with pytest.raises(TooLarge) as caught:
        read_photo_file(huge)
    assert caught.value.code == "image.too_large"
