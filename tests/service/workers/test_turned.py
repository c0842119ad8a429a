"""Photos of turned cameras, as a worker localizes them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from time import time
from typing import Protocol

import pytest

from service.values import Abandoned, MapFolder, Signals, WorkerSettings, photo_job
from service.workers.vision import Vision
from tests.turning import png, turned_camera, turned_pixels, turned_pose
from visloc.archive import MapStore
from visloc.evaluation import pose_error
from visloc.geometry import Camera, Pose
from visloc.localization.turning import TurnFinder
from visloc.options import Inference, LocalizeOptions, ReadAs
from visloc.photos.reading import read_photo

SETTINGS = WorkerSettings(None, 1, 10**9, 8, 8, 10**8, 10**8, Inference.FP32)


class Query(Protocol):
    image: bytes
    camera: Camera
    cam_from_world: Pose


def test_a_photo_of_a_turned_camera_is_found_and_drawn(
    upright_room: Path, query: Query, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = MapStore(upright_room)
    maps = [MapFolder(store.open("room").ref, store.folder("room"))]
    image = png(turned_pixels(read_photo(query.image).rgb, 3))
    camera, truth = turned_camera(query.camera, 3), turned_pose(query.cam_from_world, 3)
    process = Vision(SETTINGS, Signals())

    job = photo_job(("room",), image, camera, LocalizeOptions())
    found = process.localize(replace(job, debug=True), maps, time())
    assert found.answer.pose is not None, found.answer.refusal
    assert pose_error(found.answer.pose.rig_from_world, truth) < (0.02, 0.5)
    (shown,) = found.answer.images
    assert shown.evidence is not None
    assert shown.evidence.turned == 180
    assert shown.evidence.camera == camera
    assert found.answer.seconds["turns"] > 0
    assert found.debug is not None
    assert len(found.debug.keypoints) == shown.evidence.num_correspondences

    upright = LocalizeOptions(read_as=ReadAs.UPRIGHT)
    alone = process.localize(photo_job(("room",), image, camera, upright), maps, time())
    assert alone.answer.refusal is not None
    assert "turns" not in alone.answer.seconds

    # Where no turn helps, the time they took is stated too; and a caller who leaves ends it.
    rgb = read_photo(query.image).rgb[:, ::-1]  # a mirrored room is another one
    mirrored = photo_job(("room",), png(rgb), camera, LocalizeOptions())
    elsewhere = process.localize(mirrored, maps, time())
    assert elsewhere.answer.refusal is not None
    assert elsewhere.answer.seconds["turns"] > 0
    signals = Signals()
    leaving = Vision(SETTINGS, signals)
    leaving.load(maps[0])

    def leave(*_: object) -> int:
        signals.abandoned = True
        return 0

    monkeypatch.setattr(TurnFinder, "_clear_matches", leave)
    with pytest.raises(Abandoned):
        leaving.localize(mirrored, maps, time())
