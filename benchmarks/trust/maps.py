"""The maps that are asked: built with the defaults of ``mapping build`` where they are missing."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mapping.methods.sfm_settings import SfmSettings
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from mapping.sample import write_sample
from visloc.archive import MapStore
from visloc.geometry import PixelOrigin, Similarity
from visloc.kapture import Dataset, FileRecord, read_dataset, write_dataset

SAMPLE, FLOORS = "sample", "floors"
# The videos of floors 10 and 13 by the map that half of their photos make.
VIDEOS = {
    "floor10-lobby": "f10_elevator_main",
    "floor10-left": "f10_hallway_left",
    "floor10-right": "f10_hallway_right_",
    "floor10-right2": "f10_hallway_right2",
    "floor13-lobby": "f13_elevator_main",
    "floor13-left": "f13_hallway_left",
    "floor13-right": "f13_hallway_right",
}
FLOOR_11 = {"lobby11": "floor11_elevator_main", "hallway11": "floor11_hallway_right"}
# The floors lie so far apart in their set that no two of its maps can agree by chance.
APART = 10_000.0


@dataclass(frozen=True, slots=True)
class Places:
    """The folders that the questions read from and the maps are built in.

    Attributes:
        data: the shared data sets.
        maps: a store of maps.
    """

    data: Path
    maps: Path

    @property
    def made(self) -> Path:
        """Datasets that are made here."""
        return self.maps / ".datasets"

    @property
    def store(self) -> MapStore:
        return MapStore(self.maps)

    def dataset(self, map_id: str, part: str) -> Path:
        """Return the folder of a map's dataset; ``part`` is mapping or query."""
        if map_id == SAMPLE:
            return self.made / SAMPLE / part
        if map_id in VIDEOS:
            return self.made / map_id / part
        if map_id in FLOOR_11:
            return self.data / "ie_tower" / FLOOR_11[map_id] / part
        return self.data / map_id / part


# How each map is built.
SETTINGS: Mapping[str, Mapping[str, Any]] = {
    "redkitchen": {"method": "rgbd"},
    "castle": {"method": "sfm"},
    "kitti_curve": {"method": "sfm"},
    # Its poses were estimated from its photos, in a unit that nobody knows.
    "gardenspoint": {"method": "sfm", "metric": False},
    # Its calibration counts pixels from the middle of the first one.
    "virtual_gallery": {"method": "sfm", "pixel_origin": PixelOrigin.CENTER},
    SAMPLE: {"method": "rgbd"},
    **{map_id: {"method": "sfm"} for map_id in FLOOR_11},
    # Nobody measured their poses.
    **{map_id: {"method": "sfm", "sfm": SfmSettings(poses="estimate")} for map_id in VIDEOS},
}


def make_missing(places: Places, needed: set[str], tell: Callable[[str], None]) -> None:
    """Build the maps that the store does not have; what was interrupted goes on.

    Args:
        places: where data and maps lie.
        needed: ids of maps, or of the set of floors, which needs its maps.
        tell: called with a line for each map that is built.
    """
    there = set(places.store.ids()) if places.maps.is_dir() else set()
    if FLOORS in needed:
        needed = needed | set(FLOOR_11) | set(VIDEOS)
    for map_id, settings in SETTINGS.items():
        if map_id in needed:
            _make_dataset(places, map_id)
        if map_id in needed - there:
            tell(f"building {map_id}")
            dataset = places.dataset(map_id, "mapping")
            # Also a map that its own test doubts: such are part of what is tried.
            made = BuildSettings(dataset, map_id, maps_dir=places.maps, workers=2, accept=True)
            build_map(replace(made, **settings), lambda *_: None)
    if FLOORS in needed - there:
        from visloc_extensions.sets.publishing import publish_set  # only for this

        tell(f"making the set {FLOORS}")
        # Videos without poses may have become several maps.
        refs = [
            ref
            for map_id in (*FLOOR_11, *VIDEOS)
            for ref in (map_id, *places.store.open(map_id).manifest.pieces)
        ]
        tiles = [
            (ref, Similarity(1.0, np.eye(3), np.array([APART * i, 0.0, 0.0])))
            for i, ref in enumerate(refs)
        ]
        publish_set(places.store, FLOORS, tiles, lambda *_: None)


def floor_of(name: str) -> str:
    """Return the floor of a map (``id`` or ``id@version``) or of a photo, such as 11."""
    if name.partition("@")[0] in FLOOR_11:
        return "11"
    return name.removeprefix("floor")[:2]


def lookalikes(places: Places, videos: tuple[str, ...]) -> Iterator[FileRecord]:
    """Yield photos of videos, without those that map floor 11 or are held out of its map."""
    dataset = read_dataset(lookalike_root(places))
    known = {
        hashlib.sha256(photo.read_bytes()).digest()
        for name in FLOOR_11.values()
        for photo in (places.data / "ie_tower" / name).rglob("*.jpg")
    }
    for record in dataset.images:
        is_wanted = Path(record.path).name.startswith(videos)
        if is_wanted and _digest(dataset, record) not in known:
            yield record


def lookalike_root(places: Places) -> Path:
    """Return the dataset of photos of all floors, which have no poses."""
    return places.data / "ie_tower" / "lookalike" / "query"


def _digest(dataset: Dataset, record: FileRecord) -> bytes:
    return hashlib.sha256(dataset.path_of(record).read_bytes()).digest()


def _make_dataset(places: Places, map_id: str) -> None:
    """Make the dataset of a map that needs one: the sample, or every second photo of a video."""
    folder = places.made / map_id
    if (map_id != SAMPLE and map_id not in VIDEOS) or folder.is_dir():
        return
    partial = folder.with_name(f"{map_id}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    if map_id == SAMPLE:
        write_sample(partial)
    else:
        source = read_dataset(lookalike_root(places))
        records = tuple(lookalikes(places, (VIDEOS[map_id],)))
        for part, kept in (("mapping", records[::2]), ("query", records[1::2])):
            _write_part(source, kept, partial / part)
    partial.rename(folder)


def _write_part(source: Dataset, records: tuple[FileRecord, ...], root: Path) -> None:
    for record in records:
        photo = root / "sensors" / "records_data" / record.path
        photo.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source.path_of(record), photo)
    write_dataset(replace(source, root=root, images=records))
