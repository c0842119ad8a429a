"""Localization by some of a map's global descriptors, fused as the query or the map says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np
import pytest
from numpy.typing import NDArray

from visloc.archive import MapStore
from visloc.archive.schema import RetrievalRecord
from visloc.errors import InvalidInput
from visloc.features import GlobalDescriptor, make_global_descriptor, make_local_features
from visloc.geometry import Camera, Pose
from visloc.localization.localizer import Localizer
from visloc.options import Fusion, LocalizeOptions
from visloc.photos.reading import Photo, read_photo
from visloc.priors import PositionPrior, Priors
from visloc.types import Answer, LocalFeatures, Localized, QueryFeatures, Reason, RetrievedImage

LOCALVLAD = {"localvlad": 1.0}


class Query(Protocol):
    image: bytes
    camera: Camera
    cam_from_world: Pose


class Counting:
    """A global descriptor that tells how often it was computed."""

    def __init__(self, inner: GlobalDescriptor) -> None:
        self._inner = inner
        self.computed = 0

    def __getattr__(self, name: str) -> object:
        return getattr(self._inner, name)

    def describe(
        self,
        rgb: NDArray[np.uint8],
        local: LocalFeatures,
        model: Mapping[str, NDArray[np.float32]],
    ) -> NDArray[np.float32]:
        self.computed += 1
        return self._inner.describe(rgb, local, model)


@pytest.fixture
def counted() -> dict[str, Counting]:
    return {name: Counting(make_global_descriptor(name)) for name in ("densevlad", "localvlad")}


@pytest.fixture
def localizer(built_maps: Path, counted: dict[str, Counting]) -> Localizer:
    opened = MapStore(built_maps).open("room")
    return Localizer(opened, make_local_features("sift"), counted.__getitem__)


@pytest.fixture
def with_default(localizer: Localizer, counted: dict[str, Counting]) -> Localizer:
    """The same map, whose default is localvlad alone."""
    opened = localizer.map
    record = RetrievalRecord(fusion=Fusion.MIN, weights=LOCALVLAD)
    manifest = opened.manifest.model_copy(update={"retrieval": record})
    return Localizer(
        replace(opened, manifest=manifest), make_local_features("sift"), counted.__getitem__
    )


@pytest.fixture
def photo(query: Query) -> Photo:
    return read_photo(query.image)


def retrieved(answer: Answer) -> tuple[RetrievedImage, ...]:
    assert isinstance(answer, Localized), answer
    return answer.evidence.retrieved


def test_what_is_left_out_is_not_computed(
    localizer: Localizer, counted: dict[str, Counting], photo: Photo, query: Query
) -> None:
    options = LocalizeOptions(fusion_weights=LOCALVLAD)
    found = retrieved(localizer.localize(photo, query.camera, options))
    assert {name: one.computed for name, one in counted.items()} == {
        "densevlad": 0,
        "localvlad": 1,
    }
    for image in found:
        assert image.similarities == {"localvlad": image.score}


@pytest.mark.parametrize("fusion", Fusion)
def test_every_operator_localizes(
    localizer: Localizer, photo: Photo, query: Query, fusion: Fusion
) -> None:
    found = retrieved(
        localizer.localize(photo, query.camera, LocalizeOptions(top_k=3, fusion=fusion))
    )
    assert len(found) == 3
    scores = [image.score for image in found]
    assert scores == sorted(scores, reverse=True)
    assert {tuple(image.similarities) for image in found} == {("densevlad", "localvlad")}


def test_the_default_is_the_map_s_and_a_query_may_differ(
    with_default: Localizer, photo: Photo, query: Query
) -> None:
    def similarities(options: LocalizeOptions) -> list[str]:
        return list(retrieved(with_default.localize(photo, query.camera, options))[0].similarities)

    assert similarities(LocalizeOptions()) == ["localvlad"]
    assert similarities(LocalizeOptions(fusion=Fusion.MEAN)) == ["localvlad"]
    both = {"localvlad": 1.0, "densevlad": 2.0}
    assert similarities(LocalizeOptions(fusion_weights=both)) == ["densevlad", "localvlad"]


def test_weights_change_scores_as_the_operator_says(
    localizer: Localizer, photo: Photo, query: Query
) -> None:
    options = LocalizeOptions(
        fusion=Fusion.MEAN, fusion_weights={"densevlad": 3.0, "localvlad": 1.0}
    )
    for image in retrieved(localizer.localize(photo, query.camera, options)):
        expected = 0.75 * image.similarities["densevlad"] + 0.25 * image.similarities["localvlad"]
        assert image.score == pytest.approx(expected)


def test_equal_options_with_weights_have_equal_hashes() -> None:
    one, same = (LocalizeOptions(fusion_weights=dict(LOCALVLAD)) for _ in range(2))
    assert one == same
    assert hash(one) == hash(same)
    assert one != LocalizeOptions()


def test_unknown_names_are_refused_before_anything_is_computed(
    localizer: Localizer, counted: dict[str, Counting], photo: Photo, query: Query
) -> None:
    options = LocalizeOptions(fusion_weights={"localvlad": 1.0, "gem": 1.0})
    features = QueryFeatures("sift", np.empty((0, 2)), np.empty((0, 128)))
    for ask in (
        lambda: localizer.localize(photo, query.camera, options),
        lambda: localizer.localize_features(features, query.camera, options),
    ):
        with pytest.raises(InvalidInput, match="weights of densevlad, localvlad") as caught:
            ask()
        assert (caught.value.code, caught.value.got) == ("options.fusion_weights", "gem")
    assert not any(one.computed for one in counted.values())


def test_a_descriptor_that_is_left_out_need_not_be_sent(
    localizer: Localizer, photo: Photo, query: Query
) -> None:
    local = make_local_features("sift").extract(photo.rgb, max_keypoints=2500)
    features = QueryFeatures("sift", local.keypoints, local.descriptors)
    with pytest.raises(InvalidInput) as caught:
        localizer.localize_features(features, query.camera, LocalizeOptions())
    assert caught.value.code == "features.global_descriptors"
    options = LocalizeOptions(fusion_weights=LOCALVLAD)
    found = retrieved(localizer.localize_features(features, query.camera, options))
    assert list(found[0].similarities) == ["localvlad"]


def test_a_map_whose_other_descriptors_come_from_elsewhere_takes_photos_without_them(
    localizer: Localizer, photo: Photo, query: Query
) -> None:
    opened = localizer.map
    densevlad, localvlad = opened.manifest.global_features
    named = densevlad.fingerprint.model_copy(update={"name": "kapture:DV"})
    manifest = opened.manifest.model_copy(
        update={"global_features": (densevlad.model_copy(update={"fingerprint": named}), localvlad)}
    )
    rows, models = opened.global_descriptors, opened.global_models
    elsewhere = Localizer(
        replace(
            opened,
            manifest=manifest,
            global_descriptors={"kapture:DV": rows["densevlad"], "localvlad": rows["localvlad"]},
            global_models={"kapture:DV": {}, "localvlad": models["localvlad"]},
        ),
        make_local_features("sift"),
    )
    with pytest.raises(InvalidInput) as caught:
        elsewhere.localize(photo, query.camera, LocalizeOptions())
    assert caught.value.code == "features.required"
    assert caught.value.expected == "features of kind sift, with kapture:DV, localvlad"
    weights = {"kapture:DV": 1.0}
    with pytest.raises(InvalidInput) as caught:
        elsewhere.localize(photo, query.camera, LocalizeOptions(fusion_weights=weights))
    assert caught.value.expected == "features of kind sift, with kapture:DV"
    options = LocalizeOptions(fusion_weights=LOCALVLAD)
    assert retrieved(elsewhere.localize(photo, query.camera, options))


@pytest.mark.parametrize("fusion", Fusion)
def test_priors_work_with_every_operator(
    localizer: Localizer, photo: Photo, query: Query, fusion: Fusion
) -> None:
    options = LocalizeOptions(fusion=fusion)
    right = Priors(PositionPrior(query.cam_from_world.center, 1.0))
    assert retrieved(localizer.localize(photo, query.camera, options, right))
    wrong = Priors(PositionPrior(query.cam_from_world.center + 1000.0, 1.0))
    answer = localizer.localize(photo, query.camera, options, wrong)
    assert not isinstance(answer, Localized)
    assert answer.reason is Reason.NO_PHOTO_NEAR
