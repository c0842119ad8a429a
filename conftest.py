"""What all tests share."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from visloc.geometry import Camera, Pose

# One thread per library makes results independent of the machine's size, and leaves the processors
# to the other tests that run meanwhile: threads that wait for each other burn a quarter more.
# NumPy reads it once, when it is loaded: hence the imports inside the fixtures.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

SHARED = Path(__file__).resolve().parent.parent / "shared"


def _shared(name: str) -> Path:
    path = SHARED / name
    if not path.is_dir():
        pytest.skip(f"needs the shared folder {name!r} beside the repository, which is absent")
    return path


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real datasets; the test is skipped where it is absent."""
    return _shared("data")


@pytest.fixture(scope="session")
def shared_weights() -> Path:
    """Folder of published checkpoints; the test is skipped where it is absent."""
    return _shared("weights")


@dataclass(frozen=True)
class Query:
    """A photo with its true pose."""

    path: Path
    image: bytes
    camera: Camera
    cam_from_world: Pose


@pytest.fixture(scope="session")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Small sample dataset, ``mapping/`` (8 photos) and ``query/`` (3); only to be read."""
    from mapping.sample import write_sample

    folder = tmp_path_factory.mktemp("sample")
    write_sample(folder, images=8, size=(256, 192))
    return folder


@pytest.fixture(scope="session")
def built_maps(sample: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of maps with the map ``room`` of the sample, made with SIFT; only to be read."""
    from mapping.pipeline.build import build_map
    from mapping.pipeline.settings import BuildSettings

    maps = tmp_path_factory.mktemp("maps")
    build_map(
        BuildSettings(sample / "mapping", "room", maps, local_features="sift"), lambda *_: None
    )
    return maps


@pytest.fixture
def maps_dir(built_maps: Path, tmp_path: Path) -> Path:
    """A copy of the maps that a test may change."""
    return Path(shutil.copytree(built_maps, tmp_path / "maps"))


@pytest.fixture(scope="session")
def queries(sample: Path) -> list[Query]:
    """The queries of the sample."""
    from visloc.kapture import read_dataset

    dataset = read_dataset(sample / "query")
    found = []
    for record in dataset.images:
        camera, pose = dataset.sensors[record.sensor_id].camera, dataset.pose(record)
        assert camera is not None
        assert pose is not None
        path = dataset.path_of(record)
        found.append(Query(path, path.read_bytes(), camera, pose))
    return found


@pytest.fixture(scope="session")
def query(queries: list[Query]) -> Query:
    """The first query of the sample."""
    return queries[0]


@pytest.fixture(scope="session")
def photos_of_another_room(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three photos of a room of the same shape and quite other pictures."""
    from mapping.sample import write_sample

    folder = tmp_path_factory.mktemp("another_room")
    write_sample(folder, images=2, size=(256, 192), seed=1)
    return sorted(folder.rglob("*.jpg"))


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Let interrupts raise: processes in the background of a shell ignore them."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
