from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from mapping.methods.sparse.intrinsics import CAMERAS, CameraOrigin, Reason
from visloc.archive.schema import Doubt
from visloc_extensions.capture.account import fates, film_again, verdict
from visloc_extensions.capture.choosing import ChosenFrames
from visloc_extensions.capture.frames import FilmedVideo
from visloc_extensions.capture.job import Captured
from visloc_extensions.capture.motion import Motion
from visloc_extensions.capture.picture import draw_walk
from visloc_extensions.capture.trying import Trials, try_photos
from visloc_extensions.films.video import VideoFacts


class _Image:
    def __init__(self, name: str) -> None:
        self.name = name


class _Opened:
    """The parts of a map that an account asks for."""

    def __init__(self, names: list[str], map_id: str = "room") -> None:
        self.images = [_Image(name) for name in names]
        self.manifest = SimpleNamespace(id=map_id)
        self.cameras: dict[str, None] = {}


def captured() -> Captured:
    """Ten seconds at 2 frames a second: used, still, blurred, not connected."""
    seconds = np.arange(20) / 2
    path = np.where(seconds < 4, seconds / 10, np.where(seconds < 6, 0.4, seconds / 10 - 0.2))
    blurred = (seconds >= 6) & (seconds < 8)
    rows = np.array([0, 2, 4, 6, 16, 18])
    facts = VideoFacts(640, 480, 10.0, "", None, None)
    video = FilmedVideo(
        Path("walk.mp4"), "", facts, Motion(seconds, np.ones(20), path), ChosenFrames(rows, blurred)
    )
    return Captured(
        Path("map"),
        {"walk": video},
        [*(f"walk/{n}" for n in video.names), "photos/a.jpg"],
        (),
        Path(),
    )


def test_every_second_has_a_fate() -> None:
    names = [f"walk/0000{i}.000s.jpg" for i in range(4)]
    opened: Any = _Opened([*names, "photos/a.jpg"])
    assert [(s.source, s.what, s.fate) for s in fates(captured(), opened)] == [
        ("walk", "second 0 to 4", "used"),
        ("walk", "second 4 to 6", "camera did not move"),
        ("walk", "second 6 to 8", "too blurred"),
        ("walk", "second 8 to 10", "not connected"),
        ("photos", "1 photo: a.jpg", "used"),
    ]


def test_one_photo_that_joined_does_not_speak_for_a_second() -> None:
    """Four photos in the first second: one of them in the map, or half."""
    one = captured()
    video = one.videos["walk"]
    seconds = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
    motion = Motion(seconds, np.ones(5), seconds)
    chosen = ChosenFrames(np.arange(4), np.zeros(5, np.bool_))
    one = replace(one, videos={"walk": replace(video, motion=motion, chosen=chosen)}, photos=())
    for joined, fate in (1, "not connected"), (2, "used"):
        opened: Any = _Opened([f"walk/{name}" for name in one.videos["walk"].names[:joined]])
        assert fates(one, opened)[0].fate == fate, joined


def test_what_another_piece_has_is_not_to_be_filmed_again() -> None:
    opened: Any = _Opened([f"walk/0000{i}.000s.jpg" for i in range(4)])
    piece: Any = _Opened(["walk/00008.000s.jpg", "walk/00009.000s.jpg", "photos/a.jpg"], "room-2")
    stretches = fates(captured(), opened, pieces=[piece])
    assert [(s.source, s.what, s.fate) for s in stretches if "used" in s.fate] == [
        ("walk", "second 0 to 4", "used"),
        ("walk", "second 8 to 10", "used in room-2"),
        ("photos", "1 photo: a.jpg", "used in room-2"),
    ]
    trials = Trials(np.arange(4), np.ones(4, np.bool_))
    assert [line[:21] for line in film_again(trials, stretches, opened)] == [
        "walk, second 6 to 8: "
    ]


def test_what_to_film_again() -> None:
    opened: Any = _Opened([f"{i}.jpg" for i in range(6)])
    trials = Trials(np.arange(6), np.array([True, False, False, True, True, False]))
    lines = film_again(trials, fates(captured(), opened), opened)
    assert any("second 6 to 8: too blurred" in line for line in lines)
    assert any("second 8 to 10: not linked to the rest" in line for line in lines)
    assert any("1.jpg to 2.jpg" in line for line in lines)
    assert any(line.startswith("5.jpg: photos there were not found") for line in lines)


def test_weak_spots_of_films_are_told_in_seconds_and_single_photos_of_good_maps_not() -> None:
    times = [*range(20), 3]
    names = [f"{'hall' if i == 20 else 'walk'}/{s:05}.400s.jpg" for i, s in enumerate(times)]
    opened: Any = _Opened(names)
    right = np.ones(21, np.bool_)
    right[[7, 20]] = False
    assert film_again(Trials(np.arange(21), right), [], opened) == []
    right[[8, 20]] = False, True
    (line,) = film_again(Trials(np.arange(21), right), [], opened)
    assert line.startswith("walk, second 7.4 to 8.4: photos there")
    right[[14, 15, 19, 20]] = False  # not good any more
    said = [line.partition(":")[0] for line in film_again(Trials(np.arange(21), right), [], opened)]
    assert said == [
        "walk, second 7.4 to 8.4",
        "walk, second 14.4 to 15.4",
        "walk/00019.400s.jpg to hall/00003.400s.jpg",
    ]


def test_a_map_of_the_sample_is_judged_and_drawn(build_sample: Any, tmp_path: Path) -> None:
    opened = build_sample()
    trials = try_photos(opened, lambda *_: None)
    # Of eight photos around a room, those with good neighbours come back, and others do not.
    assert len(trials.images) == len(opened.images)
    assert 0 < trials.right.sum() < len(trials.right)
    names = [image.name for image in opened.images]
    text = verdict(trials, Captured(opened.path, {}, names, (), Path()), opened)
    assert f"{len(names)} of {len(names)} photos are in it" in text
    assert "As a test, each photo was hidden from the map together with its neighbours" in text
    assert f": {trials.right.sum()} of {len(names)} were found where the map has them." in text
    assert "Its unit is a metre." in text
    target = tmp_path / "walk.png"
    draw_walk(opened, trials, target)
    picture = cv2.imread(str(target))
    assert picture is not None
    for colour in ((115, 158, 0), (0, 94, 213)):
        assert (picture[:1000] == colour).all(axis=2).sum() > 100


def _manifest(doubts: Sequence[Doubt] = (), **cameras: CameraOrigin) -> SimpleNamespace:
    settings = {CAMERAS: {name: origin.model_dump() for name, origin in cameras.items()}}
    return SimpleNamespace(
        world=SimpleNamespace(metric=False),
        parts=SimpleNamespace(doubts=doubts),
        method=SimpleNamespace(settings=settings),
    )


@pytest.mark.parametrize(
    ("doubt", "refined", "said"),
    [("undetermined", 570.5, True), ("undetermined", 430.0, False), (None, 570.5, False)],
)
def test_a_focal_length_that_the_photos_dispute_is_told(
    doubt: Reason | None, refined: float, said: bool
) -> None:
    opened: Any = _Opened(["a.jpg"])
    opened.cameras = {"drone": None}
    opened.manifest = _manifest(
        drone=CameraOrigin(source="exif", prior_px=424.3, doubt=doubt, refined_px=refined)
    )
    trials = Trials(np.arange(1), np.ones(1, np.bool_))
    text = verdict(trials, Captured(Path("map"), {}, ["a.jpg"], (), Path()), opened)
    assert (
        "may be 34% off: the map uses a focal length of 424 px, but 570 px fit the photos" in text
    ) is said
    assert ("focal length" in text) is said


@pytest.mark.parametrize(
    ("placed", "grade"), [(1, "poor"), (2, "usable"), (3, "good"), (4, "good")]
)
def test_a_map_that_lost_photos_is_not_good(placed: int, grade: str) -> None:
    names = ["a.jpg", "b.jpg", "c.jpg", "d.jpg"]
    opened: Any = _Opened(names[:placed])
    opened.manifest = _manifest()
    trials = Trials(np.arange(placed), np.ones(placed, np.bool_))
    text = verdict(trials, Captured(Path("map"), {}, names, (), Path()), opened)
    assert f"The map is {grade}: {placed} of 4 photos" in text
    assert "Its size is not known" in text


@pytest.mark.parametrize(("kind", "grade"), [("size", "good"), ("order", "poor")])
def test_a_lost_size_makes_no_poor_map_but_is_told(kind: str, grade: str) -> None:
    names = ["a.jpg", "b.jpg"]
    opened: Any = _Opened(names)
    opened.manifest = _manifest([Doubt(kind=kind, message="the size of this one is not known")])
    trials = Trials(np.arange(2), np.ones(2, np.bool_))
    text = verdict(trials, Captured(Path("map"), {}, names, (), Path()), opened)
    assert f"The map is {grade}" in text
    assert "What speaks against it: the size of this one is not known." in text


def test_where_not_all_photos_are_tried_their_number_is_told() -> None:
    names = ["a.jpg", "b.jpg", "c.jpg"]
    opened: Any = _Opened(names)
    opened.manifest = _manifest()
    trials = Trials(np.array([0, 2]), np.array([True, False]))
    text = verdict(trials, Captured(Path("map"), {}, names, (), Path()), opened)
    assert "As a test, each of 2 photos was hidden" in text
    assert "1 of 2 were found where the map has them. (This does not measure" in text
