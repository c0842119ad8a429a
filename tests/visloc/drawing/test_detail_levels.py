from __future__ import annotations

import os
import shutil
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from visloc.archive import Map, MapOutline, MapStore, checks, open_map, read_any_outline
from visloc.archive.photos import read_photos
from visloc.drawing.detail_levels import _LEVELS, _cells, detail_order, read_landmarks
from visloc.drawing.point_bytes import HEADER_BYTES, ROW_BYTES, packed_points, read_points
from visloc.errors import MapCorrupt
from visloc.geometry import Pose

Points = NDArray[np.float32]

# The order


def is_permutation(order: NDArray[np.uint32], num: int) -> bool:
    return order.dtype == np.uint32 and np.array_equal(np.sort(order), np.arange(num))


def farthest(points: Points, beginning: Points) -> float:
    """How far from the points of a beginning a point may lie."""
    return float(cKDTree(beginning).query(points)[0].max())


@pytest.fixture(scope="module")
def room() -> Points:
    """20 000 points in a room of 8 m, denser to one side."""
    random = np.random.default_rng(3)
    return (random.random((20_000, 3)) ** (2, 1, 1) * 8 - 4).astype(np.float32)


@settings(max_examples=100, deadline=None)
@given(
    arrays.arrays(
        np.float32,
        st.tuples(st.integers(0, 60), st.just(3)),
        elements=st.floats(allow_nan=False, allow_infinity=False, width=32),
    )
)
def test_any_finite_points_are_each_taken_once(points: Points) -> None:
    order = detail_order(points)

    assert is_permutation(order, len(points))
    np.testing.assert_array_equal(order, detail_order(points.copy()))


@pytest.mark.parametrize("num", [0, 1, 2, 1000])
@pytest.mark.parametrize("value", [0.0, -7.5, 3e38, 1e-45])
def test_points_that_are_all_equal_are_each_taken_once(num: int, value: float) -> None:
    assert is_permutation(detail_order(np.full((num, 3), value, np.float32)), num)


def test_every_beginning_covers_the_whole_scene(room: Points) -> None:
    order = detail_order(room)

    # A grid of n points, evenly laid, leaves 8 m / n^(1/3) between neighbours.
    for num in (8, 64, 512, 4096):
        assert farthest(room, room[order[:num]]) < 3 * 8 / num ** (1 / 3)


def test_a_level_is_whole_before_the_next_begins(room: Points) -> None:
    order = detail_order(room)
    finest = _cells(room)

    for level in range(_LEVELS + 1):
        cells = finest >> np.uint64(3 * (_LEVELS - level))
        occupied = len(np.unique(cells))
        assert len(np.unique(cells[order[:occupied]])) == occupied


def test_few_points_far_from_most_are_seen_early() -> None:
    random = np.random.default_rng(4)
    corner = random.normal(0, 0.1, (99_000, 3))
    rest = random.uniform(-50, 50, (1000, 3))
    points = np.concatenate([corner, rest]).astype(np.float32)

    beginning = points[detail_order(points)[:2000]]

    assert farthest(points, beginning) < 25
    assert (np.linalg.norm(beginning, axis=1) < 1).sum() > 500  # and the corner is


@pytest.mark.parametrize("distance", [1e3, 1e6, 1e30])
def test_outliers_do_not_take_the_detail_from_the_scene(room: Points, distance: float) -> None:
    random = np.random.default_rng(5)
    outliers = random.normal(0, distance, (100, 3)).astype(np.float32)
    points = np.concatenate([room, outliers])

    beginning = points[detail_order(points)[:1000]]

    assert farthest(room, beginning[np.abs(beginning).max(axis=1) <= 4]) < 3
    assert (np.abs(beginning).max(axis=1) > 4).sum() < 200


def test_where_nearly_all_are_in_one_place_the_others_still_count() -> None:
    points = np.zeros((10_000, 3), np.float32)
    points[:20] = np.arange(60).reshape(20, 3)

    order = detail_order(points)

    assert is_permutation(order, len(points))
    assert set(range(20)) <= set(order[:40].tolist())


def test_points_in_a_plane_or_line_are_covered_as_well(room: Points) -> None:
    for flat in (room * (1, 1, 0), room * (1, 0, 0)):
        points = flat.astype(np.float32)
        assert farthest(points, points[detail_order(points)[:64]]) < 3


# The bytes


@pytest.fixture(scope="module")
def opened(built_maps: Path) -> Map:
    return MapStore(built_maps).open("room")


def parsed(body: bytes) -> tuple[tuple[object, ...], NDArray[np.void]]:
    row = [("position", "<f4", 3), ("rgb", "u1", 3), ("photos", "u1")]
    return struct.unpack("<4s5I3d", body[:48]), np.frombuffer(body, row, offset=48)


def test_the_bytes_say_where_each_landmark_is_and_how_it_looks(opened: Map) -> None:
    order = detail_order(opened.landmarks)

    head, rows = parsed(packed_points(opened, order, 100, 50))

    total = opened.manifest.counts.landmarks
    colored = opened.colors is not None
    assert head == (b"VLPT", 1, total, 100, 50, int(colored), *opened.manifest.world.origin)
    chosen = order[100:150]
    np.testing.assert_array_equal(rows["position"], opened.landmarks[chosen])
    expected = opened.colors[chosen] if opened.colors is not None else np.zeros((50, 3))
    np.testing.assert_array_equal(rows["rgb"], expected)
    np.testing.assert_array_equal(rows["photos"], opened.track_lengths[chosen])


def test_pages_make_up_the_whole_and_end(opened: Map) -> None:
    order = detail_order(opened.landmarks)
    num = len(order)

    whole = packed_points(opened, order, 0, num)
    pages = [packed_points(opened, order, first, 700) for first in range(0, num, 700)]

    assert len(whole) == HEADER_BYTES + num * ROW_BYTES == 48 + num * 16
    assert b"".join(page[48:] for page in pages) == whole[48:]
    assert len(packed_points(opened, order, num, 700)) == 48
    assert parsed(packed_points(opened, order, num - 1, 700))[0][4] == 1
    assert parsed(packed_points(opened, order, 2**32 - 1, 700))[0][3:5] == (2**32 - 1, 0)


def test_a_map_may_have_colours_and_landmarks_that_many_photos_see(opened: Map) -> None:
    num = opened.manifest.counts.landmarks
    rgb = np.arange(num * 3).reshape(num, 3).astype(np.uint8)
    lengths = np.full(num, 300, np.uint16)
    lengths[0] = 254
    for colors in (rgb, None):
        drawn = replace(opened, track_lengths=lengths, colors=colors)
        head, rows = parsed(packed_points(drawn, np.arange(num, dtype=np.uint32), 0, 3))
        assert head[5] == (colors is not None)
        assert rows["photos"].tolist() == [254, 255, 255]
        np.testing.assert_array_equal(rows["rgb"], rgb[:3] if colors is not None else 0)


# Reading without what localizes


@pytest.fixture
def folder(maps_dir: Path) -> Path:
    return MapStore(maps_dir).folder("room")


@pytest.fixture
def outline(folder: Path) -> MapOutline:
    read = read_any_outline(folder)
    assert isinstance(read, MapOutline)
    return read


@pytest.mark.parametrize("block", [1, 7, 1000, 10**6])
def test_rows_that_are_read_are_those_of_the_open_map(
    block: int, folder: Path, outline: MapOutline, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checks, "_BLOCK_ROWS", block)
    opened = open_map(folder)
    order = detail_order(read_landmarks(folder, outline.manifest))

    for first, count in ((0, 20), (3, 400), (len(order) - 1, 5), (len(order), 5)):
        read = read_points(folder, outline.manifest, order[first : first + count], first)
        assert read == packed_points(opened, order, first, count)


def test_colours_are_read_with_the_rest(tmp_path: Path, opened: Map) -> None:
    num = opened.manifest.counts.landmarks
    colors = np.arange(num * 3).reshape(num, 3).astype(np.uint8)
    for name in ("landmarks.npy", "landmark_track_length.npy"):
        shutil.copy(opened.path / name, tmp_path)
    np.save(tmp_path / "landmark_rgb.npy", colors)
    files = opened.manifest.files | {"landmark_rgb.npy": opened.manifest.files["landmarks.npy"]}
    manifest = opened.manifest.model_copy(update={"files": files})
    order = detail_order(opened.landmarks)

    read = read_points(tmp_path, manifest, order[5:25], 5)

    assert read == packed_points(replace(opened, colors=colors), order, 5, 20)


def test_arrays_in_column_order_are_read_as_well(folder: Path, outline: MapOutline) -> None:
    opened = open_map(folder)
    order = detail_order(opened.landmarks)
    expected = packed_points(opened, order, 0, 50)
    np.save(folder / "landmarks.npy", np.asfortranarray(opened.landmarks))

    assert read_points(folder, outline.manifest, order[:50], 0) == expected


def test_photos_are_where_they_were_taken(folder: Path, outline: MapOutline) -> None:
    photos, opened = read_photos(folder, outline), open_map(folder)

    assert photos.images == opened.images
    for row, position, orientation in zip(
        opened.image_poses, photos.positions, photos.orientations, strict=True
    ):
        cam_from_world = Pose.from_quaternion(row[:4], row[4:])
        np.testing.assert_allclose(position, cam_from_world.center, atol=1e-12)
        world_from_cam = cam_from_world.inverse()
        np.testing.assert_allclose(orientation, world_from_cam.rotation_wxyz, atol=1e-12)


@pytest.mark.parametrize("name", ["landmarks.npy", "landmark_track_length.npy"])
def test_points_that_are_cut_short_are_refused(
    name: str, folder: Path, outline: MapOutline
) -> None:
    (folder / name).write_bytes((folder / name).read_bytes()[:-4])

    with pytest.raises(MapCorrupt) as caught:
        read_points(folder, outline.manifest, np.arange(3, dtype=np.uint32), 0)
    assert caught.value.code == "map.array"


def test_a_file_that_is_cut_short_while_it_is_read_is_refused(
    folder: Path, outline: MapOutline, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As by a copy in place. Mapped into memory, it would end the process.
    header = checks._array_header

    def cut_after_the_check(path: Path, *about: Any) -> Any:
        found = header(path, *about)
        os.truncate(path, 4096)
        return found

    rows = np.arange(outline.manifest.counts.landmarks, dtype=np.uint32)
    monkeypatch.setattr(checks, "_array_header", cut_after_the_check)
    for read in (
        lambda: read_points(folder, outline.manifest, rows, 0),
        lambda: read_landmarks(folder, outline.manifest),
    ):
        with pytest.raises(MapCorrupt) as caught:
            read()
        assert caught.value.code == "map.array"
        assert str(caught.value.field).endswith("landmarks.npy")


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_landmarks_that_are_nowhere_are_refused(
    value: float, folder: Path, outline: MapOutline
) -> None:
    landmarks = np.load(folder / "landmarks.npy")
    landmarks[3, 1] = value
    np.save(folder / "landmarks.npy", landmarks)

    with pytest.raises(MapCorrupt) as caught:
        read_landmarks(folder, outline.manifest)
    assert caught.value.code == "map.range"


@pytest.mark.parametrize(
    ("name", "text", "code"),
    [
        ("images.json", b'{"images": []}', "map.images"),
        ("images.json", b"[", "map.json"),
        ("image_poses.npy", b"", "map.array"),
    ],
)
def test_photos_that_do_not_fit_the_map_are_refused(
    name: str, text: bytes, code: str, folder: Path, outline: MapOutline
) -> None:
    (folder / name).write_bytes(text)

    with pytest.raises(MapCorrupt) as caught:
        read_photos(folder, outline)
    assert caught.value.code == code
