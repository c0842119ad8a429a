"""Photos of turned cameras, without EXIF, that are asked of a set of maps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from time import time
from typing import Any

import numpy as np
import pytest

from service.engine.engine import Engine
from service.values import (
    Localization,
    MapFolder,
    Signals,
    WorkerSettings,
    photo_job,
)
from service.workers.vision import Vision
from tests.service.engine.engines import WithEngine, started
from tests.service.rooms import photos_of
from tests.turning import png, turned_camera, turned_pixels, turned_pose
from visloc.archive import MapStore
from visloc.evaluation import pose_error
from visloc.geometry import Camera, Pose, Similarity
from visloc.options import Inference, LocalizeOptions, ReadAs
from visloc.photos.reading import read_photo
from visloc.types import Reason, Refusal
from visloc_extensions.sets.choosing import RankedTiles
from visloc_extensions.sets.files import open_set
from visloc_extensions.sets.tests.map_sets import SITE_FROM_ROOM, SITE_FROM_STUDY

# Orientations of EXIF that a camera turned by quarters would have written, by clockwise degrees
# that turn its photo upright.
HELD = {90: 6, 180: 3, 270: 8}
SETTINGS = WorkerSettings(None, 1, 10**9, 8, 8, 10**8, 10**8, Inference.FP32)
LOW_RATIO = Refusal("gate", Reason.LOW_INLIER_RATIO, "as it was sent")


@pytest.fixture(scope="module")
def with_engine(upright_site: Path) -> Iterator[WithEngine]:
    with started(upright_site) as with_engine:
        yield with_engine


def ask(with_engine: WithEngine, image: bytes, camera: Camera, **options: Any) -> Localization:
    found: list[Localization] = []

    async def play(engine: Engine) -> None:
        job = photo_job(("site",), image, camera, LocalizeOptions(**options))
        found.append(await engine.localize(job))

    with_engine(play)
    return found[0]


def held(image: bytes, degrees: int) -> bytes:
    """Return the photo that a camera turned by so many degrees stores, without EXIF."""
    return png(turned_pixels(read_photo(image).rgb, HELD[degrees]))


def error(found: Localization, moved: Similarity, truth: Pose) -> tuple[float, float]:
    assert found.answer.pose is not None, found.answer.refusal
    return pose_error(found.answer.pose.rig_from_world, moved.move(truth))


@pytest.mark.parametrize("degrees", HELD)
def test_a_turned_photo_is_found_in_its_own_tile(
    degrees: int, with_engine: WithEngine, query: Any, study: Path
) -> None:
    here = (query.image, query.camera, query.cam_from_world)
    for tile, moved, (image, camera, pose) in (
        ("room@", SITE_FROM_ROOM, here),
        ("study@", SITE_FROM_STUDY, photos_of(study)[0]),
    ):
        exif = HELD[degrees]
        sent, own = held(image, degrees), turned_camera(camera, exif)

        found = ask(with_engine, sent, own)

        assert error(found, moved, turned_pose(pose, exif)) < (0.05, 1.0)
        assert found.tile is not None
        assert found.tile.startswith(tile)
        (shown,) = found.answer.images
        assert shown.evidence is not None
        assert shown.evidence.turned == degrees
        assert found.answer.seconds["turns"] > 0


def test_other_turns_are_left_where_the_photo_as_it_was_sent_is_found(
    with_engine: WithEngine, query: Any, study: Path
) -> None:
    for image, camera in ((query.image, query.camera), photos_of(study)[0][:2]):
        found = ask(with_engine, image, camera)
        assert found.answer.pose is not None
        (shown,) = found.answer.images
        assert shown.evidence is not None
        assert shown.evidence.turned == 0
        assert "turns" not in found.answer.seconds


def test_where_no_turn_helps_the_photo_is_refused_as_it_was_sent(
    with_engine: WithEngine, query: Any
) -> None:
    mirrored = png(read_photo(query.image).rgb[:, ::-1])  # a mirrored room is another one
    alone = ask(with_engine, mirrored, query.camera, read_as=ReadAs.UPRIGHT)
    assert alone.answer.refusal is not None
    assert "turns" not in alone.answer.seconds

    found = ask(with_engine, mirrored, query.camera)
    assert found.answer.refusal == alone.answer.refusal
    assert found.answer.num_inliers == alone.answer.num_inliers
    assert found.answer.seconds["turns"] > 0


def test_a_turned_photo_ranks_tiles_as_the_upright_one_does(
    upright_site: Path, query: Any, study: Path
) -> None:
    store, process = MapStore(upright_site), Vision(SETTINGS, Signals())
    opened = open_set(store.folder("site"))
    folder = MapFolder(opened.ref, store.folder("site"), is_set=True)

    def ranked(image: bytes, refused: Refusal | None, read_as: ReadAs = ReadAs.ANY) -> RankedTiles:
        options = LocalizeOptions(read_as=read_as)
        asked = options, np.ones(2, np.bool_), time(), refused
        found: RankedTiles = process.in_set(folder, "rank_tiles", image, *asked)
        return found

    for image in (query.image, photos_of(study)[0][0]):
        plain = png(read_photo(image).rgb)
        best, *_ = ranked(plain, None).scores
        for degrees in HELD:
            scores = ranked(held(image, degrees), LOW_RATIO).scores
            assert len(scores) == 2
            assert scores[0].tile == best.tile
            assert scores[0].score >= best.score - 1e-6
        # No other turn can help these.
        assert ranked(plain, replace(LOW_RATIO, reason=Reason.AMBIGUOUS)).scores == ()
        assert ranked(plain, LOW_RATIO, ReadAs.UPRIGHT).scores == ()
