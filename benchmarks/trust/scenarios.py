"""What is tried: each function yields queries, with their truth where it is known."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.trust.maps import (
    FLOOR_11,
    FLOORS,
    SAMPLE,
    VIDEOS,
    Places,
    floor_of,
    lookalike_root,
    lookalikes,
)
from benchmarks.trust.outcomes import Query, RigPhoto
from benchmarks.trust.queries import (
    corner,
    cut_to,
    enlarged_half,
    mirrored,
    print_corners,
    stretched,
    with_focal_length,
    with_print,
)
from visloc.evaluation import Threshold
from visloc.geometry import Camera, PixelOrigin, Pose
from visloc.kapture import Dataset, read_dataset
from visloc.photos.reading import Photo, read_photo_file

KITCHEN = "redkitchen"
RIGHT = Threshold(0.5, 5.0)
RIGHT_AT_NIGHT = Threshold(1.0, 10.0)
# A night photo is at the place of its number, whichever way it looks.
RIGHT_BY_NUMBER = Threshold(2.5, 180.0)
# The lobby's poses are rough: they come from eight photos that see little of the same.
RIGHT_IN_LOBBY = Threshold(5.0, 10.0)
# A photo that was spoiled is answered wrongly further than this from the truth.
SPOILED = Threshold(0.15, 180.0)
FOCAL_FACTORS = (0.7, 0.9, 1.1, 1.3)
PRINT_SHARES = (0.3, 0.5, 0.7)
SCENE_SIZE = 1280, 960

# The photos that a map was made for: scenario, map, part of its data, and when an answer is right.
OWN: tuple[tuple[str, str, str, Threshold], ...] = (
    ("redkitchen", KITCHEN, "query", RIGHT),
    ("castle", "castle", "query", RIGHT),
    ("kitti_curve", "kitti_curve", "query", RIGHT),
    ("gardenspoint day", "gardenspoint", "query", RIGHT),
    ("gardenspoint night", "gardenspoint", "query_night", RIGHT_AT_NIGHT),
    ("virtual_gallery", "virtual_gallery", "query", RIGHT),
    ("sample", SAMPLE, "query", RIGHT),
)
RIG = "kitti_curve rig"


def own(places: Places) -> Iterator[Query]:
    """Photos of the place that the map is of; kitti_curve as single photos and as a rig."""
    for scenario, map_id, part, within in OWN:
        yield from photos_of(places, scenario, map_id, part, within)
    yield from _rig(places, RIG, "kitti_curve")


def photos_of(
    places: Places, scenario: str, map_id: str, part: str, within: Threshold
) -> Iterator[Query]:
    """Yield the photos of a dataset, each with its camera and its pose."""
    dataset = _read(places, map_id, part)
    for record in dataset.images:
        camera = dataset.sensors[record.sensor_id].camera
        photo = read_photo_file(dataset.path_of(record))
        yield _single(scenario, map_id, record.path, photo, camera, dataset.pose(record), within)


def focal(places: Places) -> Iterator[Query]:
    """The kitchen's photos with wrong focal lengths."""
    for factor in FOCAL_FACTORS:
        for query in _kitchen(places):
            yield _spoiled(query, f"focal x{factor}", partial(with_focal_length, factor=factor))


def prints(places: Places) -> Iterator[Query]:
    """Every third photo of the kitchen as a print in a photo of the castle; no pose is right."""
    dataset = _read(places, "castle", "query")
    scenes = []
    for record in dataset.images:
        camera = dataset.sensors[record.sensor_id].camera
        assert camera is not None
        scenes.append(cut_to(read_photo_file(dataset.path_of(record)), camera, *SCENE_SIZE))
    for share in PRINT_SHARES:
        random = np.random.default_rng(0)
        for i, query in enumerate(list(_kitchen(places))[::3]):
            printed = query.photos[0].photo
            scene, camera = scenes[i % len(scenes)]
            corners = print_corners(printed, camera, share, random)
            photo, camera = with_print(scene, camera, printed, corners)
            name = f"print {share:.0%}"
            yield _single(name, KITCHEN, query.name, photo, camera, None, None)


def mirrors(places: Places) -> Iterator[Query]:
    """The kitchen's photos mirrored."""
    return (_spoiled(query, "mirrored", mirrored) for query in _kitchen(places))


def halves(places: Places) -> Iterator[Query]:
    """The middle halves of the kitchen's photos, enlarged, with the camera of the whole photo."""
    return (_spoiled(query, "enlarged half", enlarged_half) for query in _kitchen(places))


def shapes(places: Places) -> Iterator[Query]:
    """The kitchen's photos cropped or stretched, with the camera of the whole photo."""
    for query in _kitchen(places):
        yield _spoiled(query, "corner", corner)
        yield _spoiled(query, "stretched", stretched)


def floors(places: Places) -> Iterator[Query]:
    """Maps of floor 11 asked about the same rooms of floors 10 and 13, and held-out photos."""
    dataset = read_dataset(lookalike_root(places))
    rooms = {"lobby11": "lobby", "hallway11": "hallway"}
    for map_id in FLOOR_11:
        is_lobby = rooms[map_id] == "lobby"
        videos = tuple(v for m, v in VIDEOS.items() if m.endswith("lobby") == is_lobby)
        for record in lookalikes(places, videos):
            camera = dataset.sensors[record.sensor_id].camera
            photo = read_photo_file(dataset.path_of(record))
            scenario = f"{map_id}: other floors"
            yield _single(scenario, map_id, record.path, photo, camera, None, None)
        within = RIGHT_IN_LOBBY if is_lobby else RIGHT
        yield from photos_of(places, f"{map_id}: held out", map_id, "query", within)


def floor_set(places: Places) -> Iterator[tuple[Query, Path]]:
    """Photos of floors 10, 11 and 13 asked of the set of all floors, with their files."""
    for map_id in (*FLOOR_11, *VIDEOS):
        dataset = _read(places, map_id, "query")
        for record in dataset.images:
            camera = dataset.sensors[record.sensor_id].camera
            path = dataset.path_of(record)
            photo = read_photo_file(path)
            scenario = f"floors as a set: {floor_of(map_id)}"
            yield _single(scenario, FLOORS, record.path, photo, camera, None, RIGHT), path


def night(places: Places) -> Iterator[Query]:
    """All night photos of gardenspoint, each at the place of the day photo of its number."""
    folder = places.data / "gardenspoint"
    camera = _read(places, "gardenspoint", "query_night").sensors["phone_night"].camera
    with (folder / "night_all.csv").open(encoding="utf-8") as lines:
        for row in csv.DictReader(lines):
            photo = read_photo_file(folder / "night_all" / row["night"])
            numbers = [float(row[name]) for name in ("qw", "qx", "qy", "qz", "tx", "ty", "tz")]
            truth = Pose.from_quaternion(numbers[:4], numbers[4:])
            yield _single(
                "night by number", "gardenspoint", row["night"], photo, camera, truth,
                RIGHT_BY_NUMBER,
            )  # fmt: skip


def elsewhere(places: Places) -> Iterator[Query]:
    """Photos of each place asked of the maps of all others; no pose is right."""
    sets = [(map_id, part) for _, map_id, part, _ in OWN]
    sets += [(map_id, "query") for map_id in FLOOR_11]
    maps = sorted({map_id for map_id, _ in sets})
    for map_id, part in sets:
        for query in photos_of(places, f"photos of {map_id}", map_id, part, RIGHT):
            for other in maps:
                # The lobby may be seen from the hallway.
                if other != map_id and not {other, map_id} <= set(FLOOR_11):
                    yield replace(query, map_id=other, truth=None, within=None)


# What is tried, by the name that ``--only`` takes. ``floor-set`` is asked of a set.
SCENARIOS: Mapping[str, Callable[[Places], Iterator[Query]]] = {
    "own": own,
    "focal": focal,
    "prints": prints,
    "mirrored": mirrors,
    "halves": halves,
    "shapes": shapes,
    "floors": floors,
    "night": night,
    "elsewhere": elsewhere,
}
FLOOR_SET = "floor-set"
# The maps that each needs.
_PLACES = {map_id for _, map_id, _, _ in OWN}
NEEDED: Mapping[str, set[str]] = {
    **{name: {KITCHEN} for name in ("focal", "prints", "mirrored", "halves", "shapes")},
    "own": _PLACES,
    "floors": set(FLOOR_11),
    "night": {"gardenspoint"},
    "elsewhere": _PLACES | set(FLOOR_11),
    FLOOR_SET: {FLOORS},
}


def _read(places: Places, map_id: str, part: str) -> Dataset:
    dataset = read_dataset(places.dataset(map_id, part))
    is_centred = map_id == "virtual_gallery"
    return dataset.with_pixels_from(PixelOrigin.CENTER) if is_centred else dataset


def _kitchen(places: Places) -> Iterator[Query]:
    return photos_of(places, KITCHEN, KITCHEN, "query", SPOILED)


def _spoiled(
    query: Query, scenario: str, spoil: Callable[[Photo, Camera], tuple[Photo, Camera]]
) -> Query:
    (only,) = query.photos
    assert only.camera is not None
    photo, camera = spoil(only.photo, only.camera)
    return replace(query, scenario=scenario, photos=(replace(only, photo=photo, camera=camera),))


def _single(
    scenario: str,
    map_id: str,
    name: str,
    photo: Photo,
    camera: Camera | None,
    truth: Pose | None,
    within: Threshold | None,
) -> Query:
    photos = (RigPhoto("camera", Pose.identity(), photo, camera),)
    return Query(scenario, map_id, name, photos, truth, within)


def _rig(places: Places, scenario: str, map_id: str) -> Iterator[Query]:
    """Yield the instants of a dataset's only rig."""
    dataset = _read(places, map_id, "query")
    (rig,) = dataset.rigs.values()
    for timestamp in sorted({record.timestamp for record in dataset.images}):
        photos, truth = [], None
        for record in dataset.images:
            cam_from_rig = rig.get(record.sensor_id)
            pose = dataset.pose(record)
            if record.timestamp != timestamp or cam_from_rig is None or pose is None:
                continue
            photo = read_photo_file(dataset.path_of(record))
            camera = dataset.sensors[record.sensor_id].camera
            photos.append(RigPhoto(record.sensor_id, cam_from_rig, photo, camera))
            truth = cam_from_rig.inverse() @ pose
        yield Query(scenario, map_id, str(timestamp), tuple(photos), truth, RIGHT)
