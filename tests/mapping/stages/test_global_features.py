"""The stages of a global descriptor: what is made, with which settings, and what is found again."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from mapping.cluster.workers import Workers
from mapping.stages.context import BuildContext
from mapping.stages.global_features import DescribeTask, describe_photos, describe_with_model
from mapping.stages.local_features import ExtractedFeatures
from mapping.stages.networks import Networks, open_descriptor
from mapping.stages.photos import MappingPhoto, collect_photos
from mapping.stages.work_folder import WorkFolder
from visloc.archive import GlobalFeatures, Map
from visloc.errors import Unavailable
from visloc.features import GLOBAL_FEATURES, ImageDescriptor
from visloc.kapture import read_dataset
from visloc.options import Inference
from visloc.photos.reading import read_photo_file
from visloc.types import Fingerprint

WEIGHTS = Path("weights")


class Corner(ImageDescriptor):
    """The colours of a corner, as a network that takes its settings."""

    seen = 0
    computed_with = "paper"
    asked: tuple[object, ...] = ()

    @property
    def fingerprint(self) -> Fingerprint:
        return Fingerprint("corner", 1, {}, "a" * 64)

    def look(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        Corner.seen += 1
        corner = rgb[:8, :8].astype(np.float32).ravel() - 128
        unit: NDArray[np.float32] = corner / np.linalg.norm(corner)
        return unit


def load_corner(*settings: object) -> Corner:
    Corner.asked = settings
    return Corner()


@pytest.fixture(autouse=True)
def _corner(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    module = ModuleType("corner_features")
    module.load_corner = load_corner  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "corner_features", module)
    monkeypatch.setitem(GLOBAL_FEATURES, "corner", ("corner_features", "load_corner"))  # type: ignore[arg-type]
    monkeypatch.setattr(Corner, "seen", 0)
    open_descriptor.cache_clear()
    yield
    open_descriptor.cache_clear()


@pytest.fixture
def photos(walk: Path) -> list[MappingPhoto]:
    return collect_photos(read_dataset(walk / "mapping"), progress=lambda *_: None)[0][:5]


@pytest.fixture
def work(tmp_path: Path) -> WorkFolder:
    return WorkFolder(tmp_path / "work")


def sift(work: WorkFolder, max_keypoints: int = 100) -> ExtractedFeatures:
    networks = Networks(None, Inference.TORCH)
    extractor = networks.extractor("sift")
    return ExtractedFeatures(
        work,
        "sift",
        networks,
        max_keypoints,
        extractor.fingerprint,
        extractor.descriptor_dim,
        extractor.computed_with,
    )


def describe(
    work: WorkFolder,
    photos: list[MappingPhoto],
    name: str = "corner",
    features: ExtractedFeatures | None = None,
) -> tuple[GlobalFeatures, list[str]]:
    stages: list[str] = []
    with Workers(1) as workers:
        context = BuildContext(
            work,
            features or sift(work),
            Networks(WEIGHTS, Inference.TORCH),
            workers,
            lambda stage, *_: stages.append(stage),
        )
        found = describe_photos(context, photos, name)
    return found, stages


def test_a_descriptor_without_vocabulary_has_one_stage_and_rows_as_a_query_would_have(
    work: WorkFolder, photos: list[MappingPhoto]
) -> None:
    found, stages = describe(work, photos)
    assert set(stages) == {"corner", "corner projection"}
    assert Corner.asked == (WEIGHTS, Inference.TORCH, 1)
    assert found.descriptors.shape == (5, 4)
    assert set(found.model) == {"mean", "axes"}
    assert found.fingerprint.weights_sha256 == "a" * 64
    rgb, local = read_photo_file(photos[3].path).rgb, sift(work).read(photos[3])
    asked = Corner().describe(rgb, local, found.model)
    assert_allclose(asked, found.descriptors[3], atol=1e-6)


def test_a_descriptor_that_learns_nothing_on_the_map_has_an_empty_model(
    work: WorkFolder, photos: list[MappingPhoto], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Corner, "learn_projection", lambda *_: {})
    monkeypatch.setattr(Corner, "project", lambda _, pooled, __: pooled)
    for _ in range(2):  # made, and found again
        found, _stages = describe(work, photos)
        assert found.descriptors.shape == (5, 8 * 8 * 3)
        assert found.model == {}


def test_a_descriptor_of_pixels_is_found_again_whatever_the_local_features(
    work: WorkFolder, photos: list[MappingPhoto]
) -> None:
    first, _ = describe(work, photos)
    again, _ = describe(work, photos, features=sift(work, max_keypoints=50))
    assert Corner.seen == len(photos)
    assert_array_equal(first.descriptors, again.descriptors)
    assert not (work.root / "local_features").exists()  # nor are they looked for


@pytest.mark.parametrize("change", ["photo", "fingerprint", "computed_with"])
def test_it_is_computed_again_when_what_it_depends_on_changes(
    work: WorkFolder, photos: list[MappingPhoto], change: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    describe(work, photos)
    if change == "photo":
        photos[2] = replace(photos[2], sha256="0" * 64)
    elif change == "fingerprint":
        monkeypatch.setattr(Corner, "fingerprint", Fingerprint("corner", 2, {}))
    else:
        monkeypatch.setattr(Corner, "computed_with", "pencil")
    describe(work, photos)
    assert Corner.seen == len(photos) + (1 if change == "photo" else len(photos))


def test_a_descriptor_of_local_features_is_made_again_with_them(
    work: WorkFolder, photos: list[MappingPhoto]
) -> None:
    _, stages = describe(work, photos, "localvlad")
    steps = ("words", "vocabulary", "projection")
    assert set(stages) == {"localvlad", *(f"localvlad {step}" for step in steps)}
    pooled = set((work.root / "pooled").iterdir())
    describe(work, photos, "localvlad", sift(work, max_keypoints=50))
    assert len(set((work.root / "pooled").iterdir()) - pooled) == len(photos)


def test_photos_of_later_are_described_by_the_model_of_the_map(
    rgbd_walk: Map, work: WorkFolder, photos: list[MappingPhoto]
) -> None:
    """As queries are, whatever other photos come with them."""

    def described(some: list[MappingPhoto]) -> NDArray[np.float32]:
        local = sift(work, rgbd_walk.manifest.local_features.max_keypoints)
        with Workers(1) as workers:
            context = BuildContext(work, local, local.networks, workers, lambda *_: None)
            return describe_with_model(context, rgbd_walk, some, "localvlad")

    found = described(photos)
    assert_array_equal(described(photos[3:4]), found[3:4])
    # These are the map's own photos: stored in 8 bits, and so is the model.
    rows = rgbd_walk.global_descriptors["localvlad"][:5]
    assert (found * rows).sum(axis=1).min() > 0.999


def test_a_machine_that_computes_in_another_way_is_refused(
    work: WorkFolder, photos: list[MappingPhoto]
) -> None:
    on_gpu = replace(sift(work), computed_with="torch 2.13.0 on H200")
    with pytest.raises(Unavailable) as caught:
        on_gpu.prepare(photos[0])
    error = caught.value
    assert (error.code, error.field) == ("build.other_computing", "--inference")
    assert (error.expected, error.got) == (on_gpu.computed_with, sift(work).computed_with)
    assert not work.has(on_gpu.key(photos[0]))


def test_a_machine_that_describes_in_another_way_is_refused(
    work: WorkFolder, photos: list[MappingPhoto]
) -> None:
    local = sift(work)
    context = BuildContext(work, local, local.networks, Workers(1), lambda *_: None)
    task = DescribeTask.of(context, "localvlad")
    with pytest.raises(Unavailable) as caught:
        replace(task, computed_with="torch 2.13.0 on H200").find_words(photos[0])
    assert caught.value.code == "build.other_computing"
