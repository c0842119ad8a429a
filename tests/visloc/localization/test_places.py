"""Photos that show a place which is not the first that was searched."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np
import pytest
from numpy.typing import NDArray

from visloc.archive import MapStore
from visloc.evaluation import pose_error
from visloc.features import make_local_features
from visloc.geometry import Camera, Pose
from visloc.localization.acceptance.rivals import Proposed
from visloc.localization.localizer import Localizer
from visloc.localization.places import look_at_one_place, solve_photo
from visloc.localization.solving import Look, Matches, SeenImage, Solved
from visloc.matching.correspondences import Proposals
from visloc.options import LocalizeOptions
from visloc.photos.reading import read_photo
from visloc.pose.motion import moved_origin
from visloc.priors import NO_PRIORS, PositionPrior, Priors
from visloc.types import CameraSource, Reason

OPTIONS = LocalizeOptions()


class Query(Protocol):
    image: bytes
    camera: Camera
    cam_from_world: Pose


@pytest.fixture(scope="module")
def room(built_maps: Path) -> Localizer:
    return Localizer(MapStore(built_maps).open("room"), make_local_features("sift"))


def apart(room: Localizer, truth: Pose) -> NDArray[np.int64]:
    pose = moved_origin(truth, -room.geometry.origin)
    return np.argsort(room.geometry.viewpoints.apart_from(pose))


def seen_at_night(room: Localizer, query: Query, rights: int) -> Look:
    """Return a look in which photos of other places come first and take the keypoints.

    Args:
        room: the map.
        query: a photo.
        rights: how many of its matches with the photos of its place are left.
    """
    look = room.look(read_photo(query.image), query.camera, OPTIONS)
    assert look.shown is not None
    assert look.proposed is not None
    random, photos = np.random.default_rng(0), apart(room, query.cam_from_world)
    near, others = photos[:2], photos[-4:]
    there = look.proposed.photos[look.proposed.pairs.ranks]
    kept = random.permutation(np.flatnonzero(np.isin(there, near)))[:rights]
    order = np.concatenate([others, near])
    right = look.proposed.pairs.of(kept)
    ranks = np.argmax(order[None] == there[kept][:, None], axis=1)
    pairs = replace(right, ranks=ranks)
    num = len(look.shown.keypoints)
    for rank, photo in enumerate(others):
        landmarks = room.geometry.observed(photo)[0].astype(np.int64)
        wrong = random.permutation(landmarks)[:num]
        keypoints = random.permutation(num)[: len(wrong)]
        some = Proposals(
            keypoints, wrong, np.full(len(wrong), rank), np.ones(len(wrong), np.float32)
        )
        pairs = Proposals(
            *(
                np.concatenate([getattr(some, name), getattr(pairs, name)])
                for name in ("keypoints", "landmarks", "ranks", "similarities")
            )
        )
    settled = pairs.settled()
    return replace(
        look,
        matches=Matches(
            look.shown.keypoints[settled.keypoints].astype(float),
            room.geometry.points(settled.landmarks).astype(float),
        ),
        landmarks=settled.landmarks,
        proposed=Proposed(look.shown, pairs, room.geometry.points(pairs.landmarks), order),
    )


def solved(room: Localizer, look: Look) -> tuple[SeenImage, Solved, Solved]:
    """Return the photo as it was solved, its answer, and the answer without a second look."""
    first = room.solve([SeenImage.alone(look)], OPTIONS)
    return *solve_photo(SeenImage.alone(look), room.geometry, OPTIONS, NO_PRIORS), first


def test_a_photo_whose_place_was_searched_last_is_found(room: Localizer, query: Query) -> None:
    look = seen_at_night(room, query, 150)

    image, found, first = solved(room, look)
    assert first.answer.refusal is not None
    assert first.answer.refusal.reason is Reason.TOO_FEW_INLIERS
    assert found.answer.pose is not None, found.answer.refusal
    assert pose_error(found.answer.pose.rig_from_world, query.cam_from_world) < (0.02, 0.5)
    assert found.answer.seconds["places"] > 0
    # The inliers are of the matches that were solved.
    assert image.look is not None
    (inliers,) = found.inliers
    assert len(inliers) == len(image.look.matches.pixels) == len(image.look.landmarks)
    assert image.look.evidence.num_correspondences == len(inliers)
    (shown,) = found.answer.images
    assert shown.evidence is not None
    assert shown.evidence.num_inliers == inliers.sum() >= 100


def test_a_photo_that_shows_none_of_the_places_keeps_its_refusal(
    room: Localizer, query: Query
) -> None:
    image, found, first = solved(room, seen_at_night(room, query, 0))
    assert found.answer.pose is None
    assert first.answer.refusal is not None
    assert found.answer.refusal == first.answer.refusal
    assert len(image.look.matches.pixels if image.look else ()) > 100  # as it was sent
    assert found.answer.seconds["places"] > 0


def test_photos_that_priors_exclude_are_not_matched(room: Localizer, query: Query) -> None:
    look = seen_at_night(room, query, 150)
    reason = Reason.LOW_INLIER_RATIO
    found = look_at_one_place(look, reason, room.geometry, OPTIONS, NO_PRIORS)
    assert found is not None
    assert found.proposed is not None
    nowhere = Priors(position=PositionPrior(np.array([1000.0, 0.0, 0.0]), 1.0))
    assert look_at_one_place(look, reason, room.geometry, OPTIONS, nowhere) is None


@pytest.mark.parametrize(
    ("reason", "options", "source"),
    [
        (Reason.UNLIKELY_POSE, OPTIONS, CameraSource.GIVEN),
        (Reason.LOW_INLIER_RATIO, LocalizeOptions(min_inliers=50), CameraSource.GIVEN),
        (Reason.LOW_INLIER_RATIO, LocalizeOptions(preset="config1"), CameraSource.GIVEN),
        (Reason.LOW_INLIER_RATIO, OPTIONS, CameraSource.GUESS),
    ],
)
def test_no_second_look_where_the_first_one_says_enough(
    room: Localizer,
    query: Query,
    reason: Reason,
    options: LocalizeOptions,
    source: CameraSource,
) -> None:
    look = seen_at_night(room, query, 150)
    look = replace(look, evidence=replace(look.evidence, camera_source=source))
    assert look_at_one_place(look, reason, room.geometry, options, NO_PRIORS) is None


def test_who_names_photos_gets_no_others_matched(room: Localizer, query: Query) -> None:
    look = seen_at_night(room, query, 150)
    assert look.proposed is not None
    named = tuple(room.map.images[photo].name for photo in look.proposed.photos)
    asked = Reason.LOW_INLIER_RATIO, room.geometry

    free = look_at_one_place(look, *asked, OPTIONS, NO_PRIORS)
    bound = look_at_one_place(look, *asked, LocalizeOptions(photos=named), NO_PRIORS)

    assert free is not None
    assert free.proposed is not None
    assert len(free.proposed.photos) > len(look.proposed.photos)
    assert bound is not None
    assert bound.proposed is not None
    assert bound.proposed.photos.tolist() == look.proposed.photos.tolist()
