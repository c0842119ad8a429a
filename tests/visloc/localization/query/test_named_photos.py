"""Mapping photos that the caller names take the place of those that retrieval finds."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np
import pytest

from visloc.archive import MapStore
from visloc.errors import InvalidInput
from visloc.evaluation import pose_error
from visloc.features import make_local_features
from visloc.geometry import Camera, Pose
from visloc.localization.localizer import Localizer
from visloc.options import LocalizeOptions
from visloc.photos.reading import read_photo
from visloc.priors import PositionPrior, Priors
from visloc.types import Answer, Localized, NotLocalized, Reason


class Query(Protocol):
    image: bytes
    camera: Camera
    cam_from_world: Pose


@pytest.fixture
def localizer(built_maps: Path) -> Localizer:
    opened = MapStore(built_maps).open("room")
    kind = opened.manifest.local_features.fingerprint.name
    return Localizer(opened, make_local_features(kind))


def names(answer: Answer) -> tuple[str, ...]:
    return tuple(image.name for image in answer.evidence.retrieved)


def test_the_retrieved_photos_named_again_give_the_same_answer(
    localizer: Localizer, query: Query
) -> None:
    photo = read_photo(query.image)
    retrieved = localizer.localize(photo, query.camera, LocalizeOptions(top_k=5))
    # All of them are matched, whatever top_k is.
    named = LocalizeOptions(top_k=1, photos=names(retrieved))

    again = localizer.localize(photo, query.camera, named)

    assert isinstance(retrieved, Localized)
    assert isinstance(again, Localized)
    assert again.status == "localized"
    assert names(again) == names(retrieved)
    assert len(names(again)) == 5
    for first, second in zip(retrieved.evidence.retrieved, again.evidence.retrieved, strict=True):
        # Rows one by one, or in one product: other rounding.
        assert first.similarities == pytest.approx(second.similarities, abs=1e-6)
    assert (again.cam_from_world.center == retrieved.cam_from_world.center).all()


def test_photos_are_matched_in_the_callers_order(localizer: Localizer, query: Query) -> None:
    photo = read_photo(query.image)
    best = names(localizer.localize(photo, query.camera, LocalizeOptions(top_k=4)))

    answer = localizer.localize(photo, query.camera, LocalizeOptions(photos=best[::-1]))

    assert names(answer) == best[::-1]
    assert isinstance(answer, Localized)
    assert pose_error(answer.cam_from_world, query.cam_from_world)[0] < 0.05


def test_only_the_named_photos_are_matched(localizer: Localizer, query: Query) -> None:
    photo = read_photo(query.image)
    ranked = names(localizer.localize(photo, query.camera, LocalizeOptions(top_k=1000)))
    best, worst = (
        localizer.localize(photo, query.camera, LocalizeOptions(photos=(name,)))
        for name in (ranked[0], ranked[-1])
    )
    assert names(worst) == (ranked[-1],)
    assert worst.evidence.num_correspondences < best.evidence.num_correspondences


def test_priors_leave_out_named_photos_that_they_exclude(
    localizer: Localizer, query: Query
) -> None:
    photo = read_photo(query.image)
    far = Priors(position=PositionPrior(query.cam_from_world.center + np.array([500, 0, 0]), 1.0))
    first = localizer.map.images[0].name

    answer = localizer.localize(photo, query.camera, LocalizeOptions(photos=(first,)), far)

    assert isinstance(answer, NotLocalized)
    assert answer.reason is Reason.NO_PHOTO_NEAR
    assert answer.status == "not_localized"


def test_a_photo_that_the_map_lacks_is_refused_before_any_work(
    localizer: Localizer, query: Query
) -> None:
    options = LocalizeOptions(photos=("no such.jpg",))
    for ask in (
        lambda: localizer.check(options),
        lambda: localizer.localize(read_photo(query.image), query.camera, options),
    ):
        with pytest.raises(InvalidInput, match=r"no such\.jpg") as caught:
            ask()
        assert caught.value.code == "options.photos"


@pytest.mark.parametrize("photos", [(), ("a", "a"), tuple(map(str, range(1001)))])
def test_names_are_one_to_a_thousand_and_different(photos: tuple[str, ...]) -> None:
    with pytest.raises(InvalidInput) as caught:
        LocalizeOptions(photos=photos)
    assert caught.value.code == "options.photos"
