"""Two small maps in two versions each, and photos of both places."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from mapping.maps.packing import write_packed
from mapping.methods.rgbd import DepthSettings
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from mapping.sample import write_sample
from visloc.archive import MapStore, verify_map
from visloc.geometry import Camera, Pose
from visloc.kapture import read_dataset

# Named so that no map is the beginning of another's name; each is another room of the sample.
SEEDS = {"hall": 1, "room": 0}
VOXEL_SIZES_M = (0.01, 0.02)
SIZE = (256, 192)


@dataclass(frozen=True)
class Photo:
    """An encoded photo, its camera, and where and when in a rig it was taken."""

    image: bytes
    camera: Camera
    sensor: str
    cam_from_rig: Pose
    timestamp: int


@dataclass(frozen=True)
class SampleMaps:
    """What the tests serve and ask.

    Attributes:
        folder: of the maps.
        versions: by map id, oldest first; all are published, the last is in use.
        photos: by map id, of its place.
        packed: the last version of ``room``, packed.
    """

    folder: Path
    versions: Mapping[str, Sequence[str]]
    photos: Mapping[str, Sequence[Photo]]
    packed: Path

    def copied_to(self, folder: Path) -> SampleMaps:
        """The same in a new folder, where it may be changed."""
        shutil.copytree(self.folder, folder)
        return replace(self, folder=folder)


def make_maps(work: Path) -> SampleMaps:
    """Render two rooms and build both versions of each; takes some 20 s.

    Args:
        work: an empty folder.
    """
    folder = work / "maps"
    photos = {}
    for map_id, seed in SEEDS.items():
        sample = work / map_id
        write_sample(sample, images=8, size=SIZE, seed=seed)
        for voxel_size_m in VOXEL_SIZES_M:
            build_map(
                BuildSettings(
                    sample / "mapping",
                    map_id,
                    folder,
                    local_features="sift",
                    depth=DepthSettings(voxel_size=voxel_size_m),
                    force=True,
                ),
                lambda *_: None,
            )
        photos[map_id] = read_photos(sample / "query")
    store = MapStore(folder)
    versions = {map_id: store.versions(map_id) for map_id in SEEDS}
    packed = work / "room.zip"
    write_packed(folder / "room" / versions["room"][-1], packed)
    return SampleMaps(folder, versions, photos, packed)


def read_photos(root: Path) -> list[Photo]:
    """Read the photos of a dataset of one rig whose cameras are all known."""
    dataset = read_dataset(root)
    (rig,) = dataset.rigs.values()
    photos = []
    for record in dataset.images:
        camera = dataset.sensors[record.sensor_id].camera
        cam_from_rig = rig[record.sensor_id]
        assert camera is not None
        assert cam_from_rig is not None
        image = dataset.path_of(record).read_bytes()
        photos.append(Photo(image, camera, record.sensor_id, cam_from_rig, record.timestamp))
    return photos


def tree_hash(root: Path) -> str:
    """Hash what a folder holds: names, bytes and times of change; locks have nothing in them."""
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*")):
        if path.is_file() and path.suffix != ".lock" and path.name != ".lock":
            about = path.stat()
            name = path.relative_to(root)
            digest.update(f"{name} {about.st_mode} {about.st_size} {about.st_mtime_ns}\n".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()


def verify_store(folder: Path) -> int:
    """Read every byte of every version that can be seen; the number of them.

    Raises:
        MapCorrupt: when one is torn.
        NotFound: when the version in use is not there.
    """
    store = MapStore(folder)
    count = 0
    for map_id in store.ids():
        store.folder(map_id)
        for version in store.versions(map_id):
            verify_map(folder / map_id / version)
            count += 1
    return count


def leftovers(folder: Path) -> list[str]:
    """Names of files of uploads and removals that are still there, besides locks."""
    hidden = (p for p in folder.rglob("*") if p.is_file() and p.suffix != ".lock")
    return [
        str(path.relative_to(folder))
        for path in hidden
        if any(part.startswith((".incoming", ".removed-")) for part in path.parts)
    ]
