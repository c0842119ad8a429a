"""Films among photos; their frames are read by an extension."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from mapping.importers import films, images
from tests.mapping.importers.conftest import panned
from visloc.errors import InvalidInput, TooLarge

MakeVideo = Callable[..., Path]


def opened(path: Path) -> None:
    with films.opened_film(path):
        pass


@pytest.mark.parametrize(
    ("photo", "film", "is_one"),
    [
        ("IMG_0001.JPG", "IMG_0001.MOV", True),
        ("IMG_0001.jpg", "img_0001.mov", True),
        ("IMG_0001.JPG", "IMG_0001_HEVC.MOV", True),  # as icloudpd names them
        ("PXL_1.MP.jpg", "PXL_1.MP.mp4", True),
        ("IMG_0001.JPG", "IMG_0002.MOV", False),
        ("IMG_0001.JPG", "long/IMG_0001.MOV", False),
    ],
)
def test_films_of_live_photos_are_told_from_others(
    make_video: MakeVideo, tmp_path: Path, photo: str, film: str, is_one: bool
) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    Image.new("RGB", (320, 240), (9, 90, 40)).save(folder / photo)
    seconds = 7 if film.startswith("long/") else 3  # of the same name, but a film of its own
    film = film.removeprefix("long/")
    made = make_video(panned(seconds * 10, step=4), f"made{Path(film).suffix.lower()}")
    shutil.move(made, folder / film)
    ((why, names),) = images.read(folder).left_out.items()
    assert names == [film]
    assert ("the photos are used" in why) == is_one


def test_pixels_of_no_camera_are_refused(make_video: MakeVideo) -> None:
    path = make_video(panned(3, step=4), sample_aspect_ratio=Fraction(9))
    with pytest.raises(InvalidInput, match="pixels that are 9 as wide as high"):
        opened(path)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"#EXTM3U\nhttp://127.0.0.1/secret.ts\n",
        b"ffconcat version 1.0\nfile /etc/passwd\n",
        b"\0\0\0\x18ftypisom" + bytes(12),
        b"\0\0\0\x18ftypisom" + bytes(range(256)) * 50,
        b"\x1aE\xdf\xa3" + bytes(range(256)) * 50,
    ],
)
def test_what_is_no_video_is_refused_by_name(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "walk.mp4"
    path.write_bytes(data)
    with pytest.raises(InvalidInput) as refused:
        opened(path)
    assert refused.value.code == "capture.video"
    assert refused.value.field == str(path)


@pytest.mark.parametrize("kept", [0.3, 0.6, 0.9])
def test_an_mp4_without_its_end_says_that_it_was_cut(make_video: MakeVideo, kept: float) -> None:
    """Cameras write the index last: without it, nothing can be decoded."""
    film = make_video(panned(40, step=4))
    data = film.read_bytes()
    film.write_bytes(data[: int(kept * len(data))])
    with pytest.raises(InvalidInput, match="ends too early: copy it again"):
        opened(film)


def test_sound_alone_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "sound.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=44100, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        frame.sample_rate = 44100
        assert isinstance(stream, av.AudioStream)
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with pytest.raises(InvalidInput, match="no video track"):
        opened(path)


def test_frames_that_are_too_large(make_video: MakeVideo, monkeypatch: pytest.MonkeyPatch) -> None:
    path = make_video(panned(3, step=4))
    monkeypatch.setattr(films, "_MAX_PIXELS", 320 * 240 - 1)
    with pytest.raises(TooLarge) as refused:
        opened(path)
    assert refused.value.code == "capture.video_size"
