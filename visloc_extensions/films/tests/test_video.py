from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from mapping.importers.films import is_video
from tests.mapping.importers.conftest import Picture, panned
from tests.turning import turned_film
from visloc.errors import InvalidInput, TooLarge
from visloc_extensions.films import video
from visloc_extensions.films.video import frames_of, video_facts

MakeVideo = Callable[..., Path]
# tkhd's matrix, rows (a, b, u), (c, d, v), (x, y, w): p' = (a x + c y, b x + d y), y down.
_PLAIN = (1, 0, 0, 1)
# What shows right (1, 0) down (0, 1) turns the picture clockwise: a phone held upright.
_CLOCKWISE, _HALF, _ANTICLOCKWISE = (0, 1, -1, 0), (-1, 0, 0, -1), (0, -1, 1, 0)


def corner_marked(width: int = 320, height: int = 240) -> Picture:
    """Grey, with a red top-left quarter."""
    picture = np.full((height, width, 3), 90, np.uint8)
    picture[: height // 2, : width // 2] = (250, 20, 20)
    return picture


def red_corner(rgb: Picture) -> tuple[bool, bool]:
    """Whether the red quarter is at the bottom, and at the right."""
    red = rgb[..., 0].astype(int) - rgb[..., 2]
    rows, columns = np.nonzero(red > 100)
    return bool(rows.mean() > rgb.shape[0] / 2), bool(columns.mean() > rgb.shape[1] / 2)


@pytest.mark.parametrize(
    ("matrix", "size", "corner"),
    [
        (_PLAIN, (240, 320), (False, False)),
        (_CLOCKWISE, (320, 240), (False, True)),
        (_HALF, (240, 320), (True, True)),
        (_ANTICLOCKWISE, (320, 240), (True, False)),
    ],
)
def test_frames_are_turned_as_the_container_says(
    make_video: MakeVideo,
    matrix: tuple[int, int, int, int],
    size: tuple[int, int],
    corner: tuple[bool, bool],
) -> None:
    path = turned_film(make_video([corner_marked()] * 3), matrix)
    rgb = next(frames_of(path)).upright_rgb()
    assert rgb.shape == (*size, 3)
    assert red_corner(rgb) == corner


@pytest.mark.parametrize(
    ("name", "codec"),
    [("a.mp4", "libx264"), ("a.mov", "libx265"), ("a.webm", "libvpx-vp9"), ("a.mp4", "libsvtav1")],
)
def test_usual_kinds_are_read(make_video: MakeVideo, name: str, codec: str) -> None:
    pictures = panned(8, step=4)
    path = make_video(pictures, name, codec=codec)
    assert is_video(path)
    frames = [frame.upright_rgb() for frame in frames_of(path)]
    assert len(frames) == 8
    for shown, made in zip(frames, pictures, strict=True):
        assert np.abs(shown.astype(int) - made).mean() < 12


def test_times_are_those_of_presentation(make_video: MakeVideo) -> None:
    times_ms = [0, 33, 67, 500, 533, 1200]
    path = make_video(panned(6, step=2), times_ms=times_ms)
    seconds = [frame.seconds for frame in frames_of(path)]
    assert np.allclose(seconds, np.array(times_ms) / 1000, atol=0.002)


def test_ten_bits_and_hdr_become_standard_pictures(make_video: MakeVideo) -> None:
    ramp = np.repeat(np.linspace(20, 235, 320).astype(np.uint8)[None, :, None], 240, axis=0)
    pictures = [np.repeat(ramp, 3, axis=2)] * 3
    for transfer in (1, 16, 18):  # BT.709, PQ, HLG
        path = make_video(
            pictures, f"{transfer}.mp4", codec="libx265", pix_fmt="yuv420p10le",
            color_trc=transfer, options={"x265-params": f"transfer={transfer}:log-level=none"},
        )  # fmt: skip
        frame = next(frames_of(path))
        assert int(frame.decoded.color_trc) == transfer
        columns = frame.upright_rgb().astype(int).mean(axis=(0, 2))
        assert (np.diff(np.convolve(columns, np.ones(9) / 9, "valid")) > -0.5).all()
        assert columns[-1] - columns[0] > 150


def test_what_the_container_tells(make_video: MakeVideo) -> None:
    tags = {
        "com.apple.quicktime.make": "Apple",
        "com.apple.quicktime.model": "iPhone 15",
        "com.apple.quicktime.location.ISO6709": "+45.2178+005.8083+310.5/",
        "com.apple.quicktime.camera.focal_length.35mm_equivalent": "26",
    }
    facts = video_facts(make_video(panned(3, step=4), "a.mov", tags=tags))
    assert facts.device == "Apple iPhone 15"
    assert facts.position == (45.2178, 5.8083, 310.5)
    assert facts.focal_length_px == pytest.approx(26 * 400 / 43.2666, rel=1e-4)


@pytest.mark.parametrize("place", ["+91.0+005.0/", "+00.0000+000.0000/", "somewhere", "+9" * 500])
def test_places_that_are_none(make_video: MakeVideo, place: str) -> None:
    tags = {"com.apple.quicktime.location.ISO6709": place}
    assert video_facts(make_video(panned(2, step=4), "a.mov", tags=tags)).position is None


@pytest.mark.parametrize(
    ("first", "count", "suffix"),
    [
        ((384, 288), 1, "mp4"),  # a cover picture
        ((1280, 960), 1, "mp4"),  # one that is larger than the film
        ((1280, 960), 1, "mkv"),
        ((96, 72), 12, "mov"),  # a small copy of the film
    ],
)
def test_the_film_is_read_whatever_track_comes_first(
    tmp_path: Path, first: tuple[int, int], count: int, suffix: str
) -> None:
    path = tmp_path / f"walk.{suffix}"
    with av.open(str(path), "w") as container:
        tracks = []
        for (width, height), codec in ((first, "mjpeg"), ((320, 240), "libx264")):
            stream = container.add_stream(codec, rate=10)
            assert isinstance(stream, av.VideoStream)
            stream.width, stream.height = width, height
            stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
            tracks.append(stream)
        for stream, pictures in zip(
            tracks, (panned(count, 1, first), panned(12, step=8)), strict=True
        ):
            for picture in pictures:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            container.mux(stream.encode())
    frames = list(frames_of(path))
    assert [frame.rgb().shape for frame in frames] == [(240, 320, 3)] * 12
    facts = video_facts(path)
    assert (facts.width, facts.height) == (320, 240)


@pytest.mark.parametrize(
    ("aspect", "size"),
    [
        (Fraction(4, 3), (427, 240)),
        (Fraction(3, 4), (320, 320)),
        (Fraction(1), (320, 240)),
        (Fraction(2000, 2001), (320, 240)),  # less than a pixel
    ],
)
def test_pixels_become_square(
    make_video: MakeVideo, aspect: Fraction, size: tuple[int, int]
) -> None:
    path = make_video([corner_marked()] * 3, sample_aspect_ratio=aspect)
    facts = video_facts(path)
    assert (facts.width, facts.height) == size
    frame = next(frames_of(path))
    assert frame.rgb().shape == (size[1], size[0], 3)
    assert frame.grey(10_000).shape == size[::-1]
    red = frame.rgb()[..., 0].astype(int) - frame.rgb()[..., 2] > 100
    assert red.mean() == pytest.approx(0.25, abs=0.01)  # still a quarter, at the top left
    assert red_corner(frame.rgb()) == (False, False)
    turned_film(path, _CLOCKWISE)  # first squared, then turned
    assert next(frames_of(path)).upright_rgb().shape == (*size, 3)


# Hostile files


def test_a_video_that_is_cut_off(make_video: MakeVideo) -> None:
    whole = make_video(panned(40, step=4), "whole.webm", codec="libvpx-vp9")
    data = whole.read_bytes()
    cut = whole.with_name("cut.webm")
    cut.write_bytes(data[: len(data) // 2])
    assert 0 < len(list(frames_of(cut))) < 40


def test_damage_within_is_passed_over_or_refused(make_video: MakeVideo) -> None:
    path = make_video(panned(30, step=4))
    data = bytearray(path.read_bytes())
    noise = np.random.default_rng(0)
    for at in noise.integers(200, len(data) - 200, 40).tolist():
        data[at] = int(noise.integers(256))
    path.write_bytes(bytes(data))
    frames, code = 0, None
    try:
        frames = len(list(frames_of(path)))
    except InvalidInput as refused:
        code = refused.code
    assert frames <= 30
    assert code in (None, "capture.video")


def test_a_video_without_end(make_video: MakeVideo, monkeypatch: pytest.MonkeyPatch) -> None:
    path = make_video(panned(20, step=4))
    monkeypatch.setattr(video, "_MAX_FRAMES", 10)
    frames = frames_of(path)
    with pytest.raises(TooLarge) as refused:
        list(frames)
    assert refused.value.code == "capture.video_length"
