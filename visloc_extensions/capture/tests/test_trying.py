from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from visloc.geometry import Camera, Pose
from visloc.pose.reprojection import project
from visloc_extensions.capture.choosing import ChosenFrames
from visloc_extensions.capture.frames import FilmedVideo
from visloc_extensions.capture.motion import Motion
from visloc_extensions.capture.trying import doubts_of_capture, out_of_order, try_photos
from visloc_extensions.films.video import VideoFacts

CAMERA = Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
FRAMES = 24
ORIGIN = np.array([10.0, -4.0, 2.0])
# A wall 5 m ahead of a camera that walks along it, 8 cm in each step.
POINTS = np.random.default_rng(0).uniform([-3, -2, 4.8], [5, 2, 5.2], (2000, 3))
# Where frames that lie away from the others are put.
AWAY = (1.5, 0.4, 0.0)
WALK = [Pose(np.eye(3), np.array([-0.08 * i, 0.0, 0.0])) for i in range(FRAMES)]


def moved(pose: Pose, by: tuple[float, float, float]) -> Pose:
    return Pose(pose.rotation, pose.translation - np.array(by))


def film(fast: Collection[int] = ()) -> FilmedVideo:
    """What was seen: each step moves the picture by 8 px of 640, and by 160 to a ``fast`` frame."""
    steps = np.array([8 / 640 if row not in fast else 160 / 640 for row in range(FRAMES)])
    motion = Motion(np.arange(FRAMES) / 5, np.ones(FRAMES), np.cumsum(steps))
    chosen = ChosenFrames(np.arange(FRAMES), np.zeros(FRAMES, bool))
    facts = VideoFacts(640, 480, FRAMES / 5, "", None, None)
    return FilmedVideo(Path("walk.mp4"), "", facts, motion, chosen)


def opened(poses: list[Pose], astray: Collection[int] = ()) -> Any:
    """The parts of a map that the order of a film asks for.

    Landmarks as the true walk saw them; frames that lie away have landmarks of their own.
    """
    seen = [visible(pose) + (len(POINTS) if row in astray else 0) for row, pose in enumerate(WALK)]
    rows = [[*p.rotation_wxyz, *(p.translation - p.rotation @ ORIGIN)] for p in poses]
    return SimpleNamespace(
        images=[SimpleNamespace(name=f"walk/{name}", camera="c") for name in film().names],
        image_poses=np.array(rows),
        cameras={"c": CAMERA},
        landmarks=np.r_[POINTS, POINTS + AWAY].astype(np.float32),
        observation_offsets=np.cumsum([0, *map(len, seen)]),
        observation_landmarks=np.concatenate(seen),
        manifest=SimpleNamespace(world=SimpleNamespace(origin=tuple(ORIGIN))),
    )


def visible(pose: Pose) -> NDArray[np.int64]:
    pixels = project(CAMERA, pose.apply(POINTS))
    return np.flatnonzero((pixels > 0).all(axis=1) & (pixels < (640, 480)).all(axis=1))


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize(
    "astray", [[], [0, 1, 2, 3], [11], [0, 1, 2, 9, 21], [17, 18, 19, 20, 21, 22, 23]]
)
def test_frames_whose_path_jumps_lie_away_from_the_rest(astray: list[int], turned: bool) -> None:
    poses = [
        pose
        if row not in astray
        else Pose(np.diag([1.0, -1, -1]), pose.translation)
        if turned
        else moved(pose, AWAY)
        for row, pose in enumerate(WALK)
    ]
    names = [f"walk/{name}" for name in film().names]
    assert out_of_order(opened(poses, astray), {"walk": film()}) == [names[row] for row in astray]


def test_a_fast_step_is_no_jump_where_landmarks_confirm_it() -> None:
    """The tracking saw less than the poses say, but the frames share landmarks."""
    ways = np.r_[np.arange(12) * 0.08, 11 * 0.08 + 1.5 + np.arange(12) * 0.08]
    poses = [Pose(np.eye(3), np.array([-way, 0.0, 0.0])) for way in ways]
    assert out_of_order(opened(poses), {"walk": film()}) == []
    assert len(out_of_order(opened(poses, range(12)), {"walk": film()})) == 12


def test_one_stray_frame_takes_none_along_that_share_landmarks_with_those_before() -> None:
    """The frame after it was seen to move so far that its poses do not contradict the stray one."""
    stray = [moved(p, AWAY) if row == 11 else p for row, p in enumerate(WALK)]
    (name,) = out_of_order(opened(stray, [11]), {"walk": film(fast=[12])})
    assert name == f"walk/{film().names[11]}"


def test_a_film_that_jumps_is_in_doubt_and_a_stray_frame_is_not() -> None:
    films = {"walk": film()}
    stray = [moved(p, AWAY) if row == 11 else p for row, p in enumerate(WALK)]
    assert doubts_of_capture(opened(stray, [11]), films, ()) == ()
    halves = [moved(p, AWAY) if row < 8 else p for row, p in enumerate(WALK)]
    (doubt,) = doubts_of_capture(opened(halves, range(8)), films, ())
    assert doubt.kind == "order"
    assert "8 of 24 frames" in doubt.message
    assert doubt.photos == tuple(f"walk/{name}" for name in film().names[:8])


def test_a_size_by_photos_that_do_not_come_back_is_in_doubt(build_sample: Any) -> None:
    sample = build_sample()
    trials = try_photos(sample, lambda *_: None)
    names = [sample.images[row].name for row in trials.images.tolist()]
    lost, back = names[int(np.argmin(trials.right))], names[int(np.argmax(trials.right))]
    (doubt,) = doubts_of_capture(sample, {}, (back, lost))
    assert (doubt.kind, doubt.photos) == ("scale", (lost,))
    assert doubts_of_capture(sample, {}, (back,)) == ()
