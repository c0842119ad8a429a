"""What the tests of whole builds by matches, features and models share."""

from __future__ import annotations

import secrets
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import fsspec
import numpy as np
import pytest
from moto.server import ThreadedMotoServer
from numpy.typing import NDArray
from s3fs import S3FileSystem

from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from mapping.sample import write_sample
from visloc.archive import Map, MapStore
from visloc.evaluation import pose_error
from visloc.features import make_local_features
from visloc.geometry import Camera, Pose
from visloc.kapture import read_dataset, write_dataset
from visloc.localization.localizer import Localizer
from visloc.options import LocalizeOptions
from visloc.photos.reading import read_photo_file
from visloc.types import Localized


class _WalkQuery(Protocol):
    path: Path
    camera: Camera
    cam_from_world: Pose


def _quiet(_stage: str, _done: int, _total: int) -> None:
    pass


def _build_walk(dataset: Path, maps_dir: Path, **changes: object) -> Map:
    """Build the map ``walk`` by matches, with small settings."""
    values: dict[str, object] = {
        "method": "sfm",
        "local_features": "sift",
        "global_features": ("localvlad",),
        "max_keypoints": 500,
        "force": True,
    } | changes
    build_map(BuildSettings(dataset, "walk", maps_dir, **values), _quiet)  # type: ignore[arg-type]
    return MapStore(maps_dir).open("walk")


@pytest.fixture(scope="session")
def build_sample(sample: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Map]:
    """Build the map ``room`` of the sample by depth, with settings of its own; only to be read."""

    @cache
    def build(**settings: Any) -> Map:
        maps = tmp_path_factory.mktemp("maps of the sample")
        build_map(
            BuildSettings(sample / "mapping", "room", maps, local_features="sift", **settings),
            _quiet,
        )
        return MapStore(maps).open("room")

    return build


def _localization_errors(opened: Map, dataset: Path) -> NDArray[np.float64]:
    """(n, 2): metres and degrees of all photos of a dataset, each of which must be localized."""
    localizer = Localizer(opened, make_local_features("sift"))
    queries, errors = read_dataset(dataset), []
    for record in queries.images:
        camera, truth = queries.sensors[record.sensor_id].camera, queries.pose(record)
        answer = localizer.localize(
            read_photo_file(queries.path_of(record)), camera, LocalizeOptions()
        )
        assert isinstance(answer, Localized), answer
        assert truth is not None
        errors.append(pose_error(answer.cam_from_world, truth))
    return np.array(errors)


def _rewrite(dataset: Path, **changes: object) -> None:
    """Write what a dataset says again, with other parts; its files stay."""
    changed = replace(read_dataset(dataset), **changes)  # type: ignore[arg-type]
    for path in (dataset / "sensors").glob("*.txt"):
        path.unlink()
    write_dataset(changed)


@pytest.fixture(scope="session")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sample of 16 photos in ``mapping/`` and 5 in ``query/``; only to be read."""
    folder = tmp_path_factory.mktemp("walk")
    write_sample(folder, images=16, size=(256, 192))
    return folder


@pytest.fixture
def walk_copy(walk: Path, tmp_path: Path) -> Path:
    """A copy of the walk's mapping dataset that a test may change; photos are links."""
    copy = tmp_path / "dataset"
    shutil.copytree(walk / "mapping", copy, ignore=shutil.ignore_patterns("records_data"))
    (copy / "sensors" / "records_data").symlink_to(walk / "mapping" / "sensors" / "records_data")
    return copy


@pytest.fixture(scope="session")
def build_walk() -> Callable[..., Map]:
    return _build_walk


@pytest.fixture(scope="session")
def localization_errors() -> Callable[[Map, Path], NDArray[np.float64]]:
    return _localization_errors


@pytest.fixture(scope="session")
def rewrite() -> Callable[..., None]:
    return _rewrite


@pytest.fixture(scope="session")
def rgbd_walk(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Map:
    """The walk as a map by depth; only to be read."""
    return _build_walk(walk / "mapping", tmp_path_factory.mktemp("rgbd"), method="rgbd")


@pytest.fixture(scope="session")
def sfm_walk(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Map:
    """The walk as a map by matches with default settings; only to be read."""
    return _build_walk(walk / "mapping", tmp_path_factory.mktemp("sfm"))


@pytest.fixture(scope="module")
def bucket(walk: Path) -> Iterator[str]:
    """The URL of a bucket that holds the walk's dataset in ``walk``."""
    server = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        patch.setenv("AWS_ACCESS_KEY_ID", "AKIDEXAMPLE")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        S3FileSystem.clear_instance_cache()  # of other servers
        storage = fsspec.filesystem("s3", use_listings_cache=False)
        name = f"bucket-{secrets.token_hex(4)}"  # what is in a server outlives it in a process
        storage.mkdir(name)
        storage.put(f"{walk / 'mapping'}/", f"{name}/walk/", recursive=True)
        yield f"s3://{name}"
    S3FileSystem.clear_instance_cache()
    server.stop()
