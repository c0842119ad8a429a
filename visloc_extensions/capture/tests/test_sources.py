from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mapping.importers import write_imported
from mapping.stages.work_folder import WorkFolder
from tests.mapping.importers.conftest import panned
from visloc.errors import DatasetError, InvalidInput, NotFound
from visloc.kapture import read_dataset
from visloc_extensions.capture.frames import study_video, write_photos
from visloc_extensions.capture.sources import find_sources, read_capture, study_videos

MakeVideo = Callable[..., Path]


def quiet(*_: object) -> None:
    pass


def save_photos(folder: Path, count: int = 3) -> Path:
    folder.mkdir(parents=True)
    for i in range(count):
        Image.new("RGB", (320, 240), (i, 90, 40)).save(folder / f"{i}.jpg")
    return folder


def test_videos_and_folders_become_one_dataset(make_video: MakeVideo, tmp_path: Path) -> None:
    film = make_video(panned(20, step=8), "walk.mp4")
    folder = save_photos(tmp_path / "photos of the hall")
    shutil.copy(film, folder / "second.mp4")
    sources = find_sources([film, folder])
    assert set(sources.videos) == {"walk", "second"}
    work = tmp_path / "work"
    sources, videos = study_videos(sources, WorkFolder(work), 10, {}, quiet)
    model = read_capture(sources, videos, work, quiet)
    write_imported(model, tmp_path / "dataset")
    dataset = read_dataset(tmp_path / "dataset")
    assert {r.path.split("/")[0] for r in dataset.images} == {
        "walk", "second", "photos_of_the_hall",
    }  # fmt: skip
    assert all(dataset.has_file(record) for record in dataset.images)
    # One camera for each video and each kind of photos; no time twice.
    assert len(dataset.sensors) == 3
    assert len({record.timestamp for record in dataset.images}) == len(dataset.images)
    assert model.left_out == {}  # the video in the folder is used


def test_what_is_named_twice_counts_once(make_video: MakeVideo, tmp_path: Path) -> None:
    folder = save_photos(tmp_path / "photos")
    film = shutil.move(make_video(panned(4, step=8)), folder / "walk.mp4")
    for paths in ([film, folder, film], [folder, film, folder / "." / "walk.mp4", folder]):
        sources = find_sources(paths)
        assert sources.videos == {"walk": film}
        assert sources.folders == {"photos": folder}
    scan = tmp_path / "scan"
    scan.mkdir()
    (scan / "transforms.json").write_text("{}")
    for paths in ([scan, scan / "transforms.json"], [scan / "." / "transforms.json", scan]):
        assert set(find_sources(paths).exports) == {"scan"}


def test_a_link_that_leads_to_itself_is_passed_over(tmp_path: Path) -> None:
    folder = save_photos(tmp_path / "photos")
    (folder / "loop").symlink_to("loop")
    assert find_sources([folder]).folders == {"photos": folder}


def test_photos_are_named_by_their_time(make_video: MakeVideo, tmp_path: Path) -> None:
    film = make_video(panned(20, step=8))
    video = study_video(film, WorkFolder(tmp_path / "work"), 100, [], quiet)
    assert video.names[:2] == ["00000.000s.jpg", "00000.100s.jpg"]


def test_a_killed_capture_keeps_what_was_complete(make_video: MakeVideo, tmp_path: Path) -> None:
    film = make_video(panned(20, step=8))
    work = WorkFolder(tmp_path / "work")
    video = study_video(film, work, 100, [], quiet)
    folder = tmp_path / "frames"
    write_photos(video, folder, quiet)
    whole = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert sorted(whole) == video.names
    (folder / video.names[5]).unlink()
    untouched = (folder / video.names[0]).stat().st_mtime_ns
    steps: list[tuple[int, int]] = []
    again = study_video(film, work, 100, [], lambda d, t: steps.append((d, t)))
    assert steps == [(0, 2), (2, 2)]  # the pass over the video is kept
    steps.clear()
    write_photos(again, folder, lambda d, t: steps.append((d, t)))
    assert steps[0] == (len(whole) - 1, len(whole))
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == whole
    assert (folder / video.names[0]).stat().st_mtime_ns == untouched


def test_a_camera_that_stands_still_makes_no_map(make_video: MakeVideo, tmp_path: Path) -> None:
    film = make_video([panned(1, step=0)[0]] * 20)
    with pytest.raises(InvalidInput) as refused:
        study_video(film, WorkFolder(tmp_path / "work"), 100, [], quiet)
    assert refused.value.code == "capture.still"


def test_what_is_not_there_or_no_video(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match="no such file"):
        find_sources([tmp_path / "gone.mp4"])
    (tmp_path / "text.mp4").write_text("hello")
    with pytest.raises(InvalidInput) as refused:
        find_sources([tmp_path / "text.mp4"])
    assert refused.value.code == "capture.video"


@pytest.mark.parametrize(
    ("data", "part"),
    [
        (b"RIFF\0\0\0\0AVI LIST", "AVI videos are not read here; take frames out"),
        (b'<?xml version="1.0"?>\n<document version="2.0.0">', "poses of Metashape are not read"),
        (b"hello", "another kind of file"),
    ],
)
def test_files_of_another_kind_are_named(tmp_path: Path, data: bytes, part: str) -> None:
    (tmp_path / "file").write_bytes(data)
    with pytest.raises(InvalidInput, match=part) as refused:
        find_sources([tmp_path / "file"])
    assert refused.value.code == "capture.video"


def test_wanted_moments_become_photos(make_video: MakeVideo, tmp_path: Path) -> None:
    film = make_video(panned(40, step=8))
    sources = find_sources([film])
    _, videos = study_videos(sources, WorkFolder(tmp_path / "w"), 4, {"walk": [1.7]}, quiet)
    assert "00001.700s.jpg" in videos["walk"].names
    assert np.isclose(videos["walk"].motion.seconds[-1], 3.9)


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "transforms.json")
    with pytest.raises(InvalidInput) as caught:
        find_sources([tmp_path / "transforms.json"])
    assert caught.value.code == "capture.video"


def test_a_video_that_was_cut_while_it_was_copied_is_told(
    make_video: MakeVideo, tmp_path: Path
) -> None:
    film = make_video(panned(60, step=8), "walk.webm", codec="libvpx")
    notes = {}
    for name, share in (("whole", 1.0), ("cut", 0.5)):
        copied = tmp_path / name / "walk.webm"
        copied.parent.mkdir()
        copied.write_bytes(film.read_bytes()[: int(share * film.stat().st_size)])
        sources = find_sources([copied])
        _, videos = study_videos(sources, WorkFolder(tmp_path / name / "work"), 10, {}, quiet)
        notes[name] = read_capture(sources, videos, tmp_path / name / "work", quiet).notes

    assert notes["whole"] == ()
    (note,) = notes["cut"]
    assert "says that it lasts 6.0 s" in note


@pytest.mark.parametrize(
    ("photo", "film", "is_one"),
    [
        ("IMG_0001.JPG", "IMG_0001.MOV", True),
        ("IMG_0001.JPG", "long/IMG_0001.MOV", False),
    ],
)
def test_films_of_live_photos_are_left_out(
    make_video: MakeVideo, tmp_path: Path, photo: str, film: str, is_one: bool
) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    Image.new("RGB", (320, 240), (9, 90, 40)).save(folder / photo)
    seconds = 7 if film.startswith("long/") else 3  # of the same name, but a film of its own
    film = film.removeprefix("long/")
    made = make_video(panned(seconds * 10, step=4), f"made{Path(film).suffix.lower()}")
    shutil.move(made, folder / film)
    sources = find_sources([folder])
    assert (set(sources.videos.values()) == set()) == is_one
    sources, videos = study_videos(sources, WorkFolder(tmp_path / "work"), 10, {}, quiet)
    model = read_capture(sources, videos, tmp_path / "work", quiet)
    left_out = {name: why for why, names in model.left_out.items() for name in names}
    assert list(left_out) == ([f"photos/{film}"] if is_one else [])
    assert all("the photos are used" in why for why in left_out.values())
    assert len(model.images) == (1 if is_one else 1 + len(videos[Path(film).stem].names))


def test_one_bad_film_of_a_folder_is_left_out(make_video: MakeVideo, tmp_path: Path) -> None:
    folder = tmp_path / "films"
    folder.mkdir()
    shutil.move(make_video(panned(20, step=8)), folder / "good.mp4")
    still = shutil.move(make_video([panned(1, step=0)[0]] * 20), folder / "still.mp4")
    (folder / "cut.mp4").write_bytes((folder / "good.mp4").read_bytes()[:2000])
    sources = find_sources([folder])
    sources, videos = study_videos(sources, WorkFolder(tmp_path / "work"), 10, {}, quiet)
    assert set(videos) == set(sources.videos) == {"good"}
    model = read_capture(sources, videos, tmp_path / "work", quiet)
    left_out = {name: why for why, names in model.left_out.items() for name in names}
    assert "did not move" in left_out.pop("films/still.mp4")
    assert "copy it again" in left_out.pop("films/cut.mp4")
    assert left_out == {}
    named = find_sources([folder, still])  # named twice: found in the folder first
    assert "still" in named.found
    with pytest.raises(InvalidInput) as refused:  # the film that was asked for
        study_videos(find_sources([still]), WorkFolder(tmp_path / "w"), 10, {}, quiet)
    assert refused.value.code == "capture.still"


def test_a_folder_of_nothing_but_bad_films_says_why(make_video: MakeVideo, tmp_path: Path) -> None:
    folder = tmp_path / "films"
    folder.mkdir()
    shutil.move(make_video([panned(1, step=0)[0]] * 20), folder / "still.mp4")
    sources = find_sources([folder])
    sources, videos = study_videos(sources, WorkFolder(tmp_path / "work"), 10, {}, quiet)
    with pytest.raises(DatasetError, match=r"did not move.*films/still\.mp4") as refused:
        read_capture(sources, videos, tmp_path / "work", quiet)
    assert refused.value.code == "import.empty"
