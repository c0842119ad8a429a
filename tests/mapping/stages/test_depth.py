from __future__ import annotations

import math
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from mapping.stages.depth import (
    DepthMatcher,
    depth_at,
    photo_depth,
    read_depth,
    register_depth,
)
from visloc.errors import DatasetError, InvalidInput, TooLarge
from visloc.geometry import Camera, Pose
from visloc.kapture import Dataset, FileRecord, Sensor, read_dataset
from visloc.pose.reprojection import normalized_rays, project

SMALL = Camera("SIMPLE_PINHOLE", 4, 3, (4.0, 2.0, 1.5))
DEPTH = Camera("SIMPLE_PINHOLE", 320, 240, (290.0, 160.0, 120.0))
PHOTO = Camera("SIMPLE_PINHOLE", 320, 240, (250.0, 158.0, 122.0))


def pixel_centers(camera: Camera) -> NDArray[np.float64]:
    rows, columns = np.indices((camera.height, camera.width))
    centers: NDArray[np.float64] = np.column_stack([columns.ravel(), rows.ravel()]) + np.float64(
        0.5
    )
    return centers


def plane_depth(
    camera: Camera, normal: NDArray[np.float64], distance: float
) -> NDArray[np.float32]:
    """Depth (H, W) of the plane ``normal . x = distance`` in the camera's frame."""
    depth = distance / (normalized_rays(camera, pixel_centers(camera)) @ normal)
    return depth.reshape(camera.height, camera.width).astype(np.float32)


def small_turn(degrees: float, translation: tuple[float, float, float]) -> Pose:
    half = math.radians(degrees) / 2
    return Pose.from_quaternion([math.cos(half), 0, math.sin(half), 0], translation)


# Reading


def write_raw(path: Path, values: list[float]) -> Path:
    np.array(values, dtype="<f4").tofile(path)
    return path


def write_png(path: Path, units: NDArray[np.generic]) -> Path:
    Image.fromarray(units).save(path, format="PNG")
    return path


def test_a_raw_map_is_metres_row_by_row(tmp_path: Path) -> None:
    path = write_raw(tmp_path / "a.depth.reg", [float(i) for i in range(1, 13)])
    depth = read_depth(path, SMALL, 0.001)
    assert depth.dtype == np.float32
    assert depth.tolist() == [[1, 2, 3, 4], [5, 6, 7, 8], [9, 10, 11, 12]]


def test_invalid_values_of_a_raw_map_are_nan(tmp_path: Path) -> None:
    values = [0.0, -0.0, -1.0, math.nan, math.inf, -math.inf, 65.535]
    valid = [65.534, 65.536, 1e-5, 250.0, 5000.0]
    depth = read_depth(write_raw(tmp_path / "a", values + valid), SMALL, 0.001).ravel()
    assert np.isnan(depth[:7]).all()
    np.testing.assert_array_equal(depth[7:], np.array(valid, dtype=np.float32))


@pytest.mark.parametrize("name", ["a.png", "a.depth"])
@pytest.mark.parametrize("scale", [0.001, 0.0002, 0.01])
def test_a_png_is_known_by_its_content_and_scaled(tmp_path: Path, name: str, scale: float) -> None:
    units = np.arange(1000, 13000, 1000, dtype=np.uint16).reshape(3, 4)
    units[0, 0], units[2, 3], units[1, 1] = 0, 65535, 65534
    depth = read_depth(write_png(tmp_path / name, units), SMALL, scale)
    assert np.isnan(depth[[0, 2], [0, 3]]).all()
    units[[0, 2], [0, 3]] = 1
    expected = units * scale
    valid = np.isfinite(depth)
    assert valid.sum() == 10
    np.testing.assert_allclose(depth[valid], expected[valid], rtol=1e-6)


@pytest.mark.parametrize("num_values", [0, 11, 13, 12 * 2])
def test_a_raw_map_of_the_wrong_size_is_refused(tmp_path: Path, num_values: int) -> None:
    path = write_raw(tmp_path / "a.depth", [1.0] * num_values)
    with pytest.raises(DatasetError) as caught:
        read_depth(path, SMALL, 0.001)
    assert caught.value.code == "depth.size"
    assert caught.value.field == str(path)
    assert caught.value.expected == "48 bytes, float32 of 4 x 3"
    assert caught.value.got == f"{4 * num_values} bytes"


def test_a_png_of_the_wrong_size_is_refused(tmp_path: Path) -> None:
    path = write_png(tmp_path / "a.png", np.ones((4, 3), dtype=np.uint16))
    with pytest.raises(DatasetError) as caught:
        read_depth(path, SMALL, 0.001)
    assert (caught.value.code, caught.value.field) == ("depth.size", str(path))
    assert caught.value.got == "3 x 4"


@pytest.mark.parametrize(
    "pixels",
    [
        np.ones((3, 4), dtype=np.uint8),
        np.ones((3, 4), dtype=bool),
        np.ones((3, 4, 3), dtype=np.uint8),
        np.ones((3, 4, 4), dtype=np.uint8),
    ],
)
def test_a_png_that_is_a_picture_is_refused(tmp_path: Path, pixels: NDArray[np.generic]) -> None:
    with pytest.raises(DatasetError) as caught:
        read_depth(write_png(tmp_path / "a.png", pixels), SMALL, 0.001)
    assert caught.value.code == "depth.format"
    assert caught.value.expected == "16 bits per pixel, grey"


@pytest.mark.parametrize("keep", [8, 20, 32, 33, 45, 10_000, -100, -14])
def test_a_truncated_png_is_refused(tmp_path: Path, keep: int) -> None:
    units = np.random.default_rng(0).integers(1, 60000, (240, 320)).astype(np.uint16)
    path = write_png(tmp_path / "a.png", units)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(DatasetError) as caught:
        read_depth(path, DEPTH, 0.001)
    assert (caught.value.code, caught.value.field) == ("depth.damaged", str(path))


def test_a_png_with_a_flipped_bit_is_refused(tmp_path: Path) -> None:
    units = np.random.default_rng(0).integers(1000, 1200, (240, 320)).astype(np.uint16)
    path = write_png(tmp_path / "a.png", units)
    content = path.read_bytes()
    for position in range(0, len(content), 1009):
        damaged = bytearray(content)
        damaged[position] ^= 0x10
        path.write_bytes(damaged)
        with pytest.raises(DatasetError):
            read_depth(path, DEPTH, 0.001)


def test_the_pixels_of_a_png_are_limited_by_its_header_before_decoding(tmp_path: Path) -> None:
    def chunk(kind: bytes, content: bytes) -> bytes:
        checksum = zlib.crc32(kind + content)
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", checksum)

    header = struct.pack(">IIBBBBB", 100_000, 100_000, 16, 0, 0, 0, 0)
    path = tmp_path / "bomb.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IEND", b""))
    with pytest.raises(DatasetError) as caught:
        read_depth(path, SMALL, 0.001)
    assert caught.value.code == "depth.size"
    # ... even when the sensor claims that size.
    with pytest.raises(TooLarge):
        read_depth(path, Camera("SIMPLE_PINHOLE", 100_000, 100_000, (1.0, 1.0, 1.0)), 0.001)


def test_a_missing_map_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(DatasetError) as caught:
        read_depth(tmp_path / "absent", SMALL, 0.001)
    assert (caught.value.code, caught.value.field) == ("depth.missing", str(tmp_path / "absent"))


@pytest.mark.parametrize("scale", [0.0, -0.001, math.nan, math.inf])
def test_a_scale_that_cannot_be_is_refused(tmp_path: Path, scale: float) -> None:
    with pytest.raises(InvalidInput) as caught:
        read_depth(write_raw(tmp_path / "a", [1.0] * 12), SMALL, scale)
    assert (caught.value.code, caught.value.field) == ("depth.scale", "--depth-scale")


# Looking up


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.3, 0.2, 1.0), (-0.9, 0.5, 1.2)])
def test_a_plane_is_looked_up_exactly_between_pixels(normal: tuple[float, float, float]) -> None:
    depth = plane_depth(DEPTH, np.array(normal), 2.0)
    rng = np.random.default_rng(1)
    pixels = rng.uniform((0.5, 0.5), (319.5, 239.5), (2000, 2))
    expected = 2.0 / (normalized_rays(DEPTH, pixels) @ normal)
    found = depth_at(depth, pixels)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found, expected, rtol=3e-7)


def test_pixel_centers_give_the_pixels_themselves() -> None:
    depth = (2 + 0.001 * np.arange(12, dtype=np.float32)).reshape(3, 4)
    found = depth_at(depth, pixel_centers(SMALL))
    np.testing.assert_allclose(found, depth.ravel(), rtol=1e-7)


@pytest.mark.parametrize(
    "pixel",
    [
        (0.49, 1.0),
        (1.0, 0.49),
        (3.51, 1.0),
        (1.0, 2.51),
        (-5.0, 1.0),
        (1e12, 1.0),
        (math.nan, 1.0),
        (1.0, math.inf),
    ],
)
def test_positions_without_four_neighbours_are_rejected(pixel: tuple[float, float]) -> None:
    found = depth_at(np.full((3, 4), 2.0, np.float32), np.array([pixel, (1.7, 1.2)]))
    assert np.isnan(found[0])
    assert found[1] == 2.0


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (5, 1)])
def test_a_map_of_one_row_has_no_neighbours(shape: tuple[int, int]) -> None:
    assert np.isnan(depth_at(np.ones(shape, np.float32), np.array([[0.5, 0.5]]))).all()


def test_no_pixels_give_no_depths() -> None:
    found = depth_at(np.ones((3, 4), np.float32), np.empty((0, 2), np.float32))
    assert found.shape == (0,)
    assert found.dtype == np.float32


@pytest.mark.parametrize("hole", [(1, 1), (1, 2), (2, 1), (2, 2)])
def test_a_missing_neighbour_rejects(hole: tuple[int, int]) -> None:
    depth = np.full((4, 4), 2.0, np.float32)
    depth[hole] = np.nan
    assert np.isnan(depth_at(depth, np.array([[2.1, 1.8]])))[0]


@pytest.mark.parametrize(
    ("step", "accepted"),
    [
        (0.0, True),
        (0.023, True),  # two steps of a Kinect's disparity at 4 m
        (0.05, False),
        (0.5, False),
    ],
)
def test_a_silhouette_rejects_and_the_sensors_own_steps_do_not(step: float, accepted: bool) -> None:
    depth = np.full((6, 6), 4.0, np.float32)
    depth[:, 3:] *= 1 + step
    found = depth_at(depth, np.array([[1.2, 3.0], [3.0, 3.0], [4.7, 3.0]]))
    assert np.isfinite(found).tolist() == [True, accepted, True]
    assert found[0] == 4.0
    assert found[2] == pytest.approx(4.0 * (1 + step))


# Registering


@pytest.mark.parametrize(
    "normal", [(0.0, 0.0, 1.0), (0.4, 0.0, 1.0), (-0.3, 0.5, 1.0), (0.0, -1.2, 1.0)]
)
def test_a_plane_is_registered_where_the_photo_sees_it(
    normal: tuple[float, float, float],
) -> None:
    photo_from_depth = small_turn(1.5, (-0.06, 0.01, 0.02))
    depth = plane_depth(DEPTH, np.array(normal), 2.0)
    normal_in_photo = photo_from_depth.rotation @ normal
    distance_in_photo = 2.0 + normal_in_photo @ photo_from_depth.translation
    truth = plane_depth(PHOTO, normal_in_photo, float(distance_in_photo))

    registered, view = register_depth(depth, DEPTH, PHOTO, photo_from_depth)

    assert view == PHOTO
    # A point lies up to half a pixel from the centre of the pixel that holds it.
    slope = float(np.hypot(*normal_in_photo[:2])) / float(distance_in_photo) * truth
    error = np.abs(registered - truth) / truth
    seen = np.isfinite(registered)
    assert (error[seen] <= (0.7072 * slope / PHOTO.focal_length + 1e-6)[seen]).all()
    # Of several points in one pixel the nearest is taken; that is all the bias there is.
    assert -5e-4 < float(np.mean((registered / truth - 1)[seen])) < 1e-5

    # Without holes wherever the depth camera sees the plane.
    points = normalized_rays(PHOTO, pixel_centers(PHOTO)) * truth.reshape(-1, 1)
    pixels = project(DEPTH, photo_from_depth.inverse().apply(points))
    visible = ((pixels >= 1) & (pixels <= (319, 239))).all(axis=1).reshape(truth.shape)
    assert visible.mean() > 0.7
    assert seen[visible].all()


def test_the_nearest_surface_wins_and_hides_what_is_behind() -> None:
    # A board at 1 m before a wall at 3 m; the photo is taken 20 cm to the right.
    depth = np.full((240, 320), 3.0, np.float32)
    depth[80:160, 120:200] = 1.0
    photo_from_depth = Pose(np.eye(3), np.array([-0.2, 0.0, 0.0]))
    registered, view = register_depth(depth, DEPTH, PHOTO, photo_from_depth)

    corners = np.array([[120.0, 80.0], [200.0, 160.0]])
    board = project(view, photo_from_depth.apply(normalized_rays(DEPTH, corners)))
    (left, top), (right, bottom) = np.round(board).astype(int)
    inside = registered[top + 1 : bottom - 1, left + 1 : right - 1]
    np.testing.assert_array_equal(inside, np.float32(1.0))
    around = np.delete(registered[top:bottom], np.s_[left - 1 : right + 1], axis=1)
    assert np.nanmin(around) == 3.0
    # What the board hid from the depth camera is unknown, not guessed: 29 pixels to its right.
    shadow = registered[top + 1 : bottom - 1, right + 1 : right + 30]
    assert np.isnan(shadow).all()


def test_a_finer_photo_is_registered_at_a_size_without_holes() -> None:
    photo = Camera("OPENCV", 1280, 960, (1400.0, 1400.0, 640.0, 480.0, -0.05, 0.01, 0.0, 0.0))
    depth = plane_depth(DEPTH, np.array([0.2, 0.1, 1.0]), 1.5)
    registered, view = register_depth(depth, DEPTH, photo, Pose(np.eye(3), np.array([-0.05, 0, 0])))
    assert view == photo.scaled(view.width, view.height)
    assert registered.shape == (view.height, view.width)
    assert view.width == int(1280 * 0.9 * 290 / 1400)
    assert view.width / view.height == pytest.approx(4 / 3, rel=0.01)
    border = 12
    assert np.isfinite(registered[border:-border, border:-border]).mean() == 1.0


@pytest.mark.parametrize(
    "photo",
    [
        Camera("SIMPLE_RADIAL", 320, 240, (260.0, 160.0, 120.0, -0.3)),
        Camera("OPENCV", 320, 240, (260.0, 260.0, 160.0, 120.0, -0.25, 0.08, 1e-3, -1e-3)),
        Camera("OPENCV_FISHEYE", 320, 240, (240.0, 240.0, 160.0, 120.0, 0.01, -0.01, 0.0, 0.0)),
    ],
)
def test_what_lies_outside_the_lens_is_not_folded_into_the_photo(photo: Camera) -> None:
    wide = Camera("SIMPLE_PINHOLE", 800, 600, (250.0, 400.0, 300.0))
    # A wall at 2 m fills the photo; what is far outside of its field is at 0.5 m.
    u, v = project(photo, normalized_rays(wide, pixel_centers(wide))).T
    rays = normalized_rays(wide, pixel_centers(wide))
    far_out = np.hypot(rays[:, 0], rays[:, 1]) > 1.3
    folded = far_out & (u >= 0) & (u < 320) & (v >= 0) & (v < 240)
    depth = np.where(far_out, 0.5, 2.0).reshape(600, 800).astype(np.float32)

    registered, view = register_depth(depth, wide, photo, Pose.identity())

    assert view.width < 320
    seen = np.isfinite(registered)
    assert seen.mean() > 0.9
    assert (registered[seen] == 2.0).all()
    if photo.model == "SIMPLE_RADIAL":
        assert folded.any()  # so the test tests something


def test_what_is_behind_the_camera_is_not_seen() -> None:
    half_turn = Pose.from_quaternion([0, 0, 1, 0], [0, 0, 0])
    registered, _ = register_depth(np.full((240, 320), 2, np.float32), DEPTH, PHOTO, half_turn)
    assert np.isnan(registered).all()


def test_a_map_without_depth_is_seen_as_one() -> None:
    empty = np.full((240, 320), np.nan, np.float32)
    registered, _ = register_depth(empty, DEPTH, PHOTO, Pose.identity())
    assert np.isnan(registered).all()


def counted_from_zero(camera: Camera) -> Camera:
    f, cx, cy = camera.params
    return Camera(camera.model, camera.width, camera.height, (f, cx + 0.5, cy + 0.5))


def test_recorded_depth_becomes_its_registered_twin(shared_data: Path) -> None:
    raw = read_dataset(shared_data / "import_samples" / "rgbd_png")
    twins = read_dataset(shared_data / "redkitchen" / "mapping")
    twin_of = {record.timestamp: record for record in twins.depth_maps}
    matcher = DepthMatcher(raw, None)
    photo = raw.sensors["kinect_rgb"].camera
    assert photo is not None
    for image in raw.images:
        match = matcher.match(image)
        assert match is not None
        depth = read_depth(raw.path_of(match.record), match.camera, 0.001)
        twin = read_depth(twins.path_of(twin_of[image.timestamp]), photo, 0.001)

        # The twins were made with pixel centres counted from 0. Told so, all pixels agree.
        registered, view = register_depth(
            depth, counted_from_zero(match.camera), counted_from_zero(photo), match.cam_from_depth
        )
        assert (view.width, view.height) == (640, 480)
        np.testing.assert_array_equal(np.isfinite(registered), np.isfinite(twin))
        np.testing.assert_allclose(registered, twin, atol=1e-4)

        # Our reading of the same calibration shifts by half a pixel in each camera, 0.05 px in
        # all (0.5 (1 - 525 / 585)), so that one pixel in thirty takes its neighbour's point.
        registered, _ = register_depth(depth, match.camera, photo, match.cam_from_depth)
        difference = np.abs(registered - twin)[np.isfinite(registered) & np.isfinite(twin)]
        assert (difference <= 0.001).mean() > 0.96
        assert (difference <= 0.005).mean() > 0.97


# Which depth map belongs to which photo

CAM = Sensor.with_camera("cam", PHOTO)
IR = Sensor.with_camera("ir", DEPTH, kind="depth")
REGISTERED = Sensor.with_camera("reg", PHOTO.scaled(160, 120), kind="depth")
OFFSET = Pose(np.eye(3), np.array([0.03, 0.0, 0.0]))
SHIFTED = Pose(np.eye(3), np.array([0.0, 0.0, 5.0]))
PHOTO_5 = FileRecord(5, "cam", "a.jpg")


def dataset_of(
    root: Path,
    depth_sensors: list[Sensor],
    rigs: dict[str, dict[str, Pose | None]],
    trajectories: dict[tuple[int, str], Pose] | None = None,
) -> Dataset:
    depth_maps = tuple(FileRecord(5, s.id, f"{s.id}.depth") for s in depth_sensors)
    for record in depth_maps:
        path = root / "sensors" / "records_data" / record.path
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    sensors = {sensor.id: sensor for sensor in [CAM, *depth_sensors]}
    return Dataset(root, sensors, rigs, trajectories or {}, (PHOTO_5,), depth_maps, ())


def test_the_only_depth_sensor_of_the_rig_is_taken(tmp_path: Path) -> None:
    dataset = dataset_of(tmp_path, [IR], {"rig": {"cam": OFFSET, "ir": SHIFTED}})
    match = DepthMatcher(dataset, None).match(PHOTO_5)
    assert match is not None
    assert (match.record.sensor_id, match.camera) == ("ir", DEPTH)
    assert match.cam_from_depth.translation.tolist() == [0.03, 0, -5]


def test_no_depth_map_of_the_timestamp_is_none(tmp_path: Path) -> None:
    dataset = dataset_of(tmp_path, [IR], {"rig": {"cam": OFFSET, "ir": SHIFTED}})
    assert DepthMatcher(dataset, None).match(FileRecord(6, "cam", "b.jpg")) is None


def test_a_depth_map_whose_file_is_missing_does_not_count(tmp_path: Path) -> None:
    rig: dict[str, Pose | None] = {"cam": OFFSET, "ir": SHIFTED, "reg": OFFSET}
    dataset = dataset_of(tmp_path, [IR, REGISTERED], {"rig": rig})
    dataset.path_of(dataset.depth_maps[1]).unlink()
    match = DepthMatcher(dataset, None).match(PHOTO_5)
    assert match is not None
    assert match.record.sensor_id == "ir"


def test_the_registered_map_is_preferred_unless_another_is_named(tmp_path: Path) -> None:
    rig: dict[str, Pose | None] = {"cam": OFFSET, "ir": SHIFTED, "reg": OFFSET}
    dataset = dataset_of(tmp_path, [IR, REGISTERED], {"rig": rig})
    for named, expected in ((None, "reg"), ("reg", "reg"), ("ir", "ir")):
        match = DepthMatcher(dataset, named).match(PHOTO_5)
        assert match is not None
        assert match.record.sensor_id == expected


def test_a_map_of_another_aspect_is_not_registered(tmp_path: Path) -> None:
    cropped = Sensor.with_camera("crop", replace(PHOTO, height=200), kind="depth")
    rig: dict[str, Pose | None] = {"cam": OFFSET, "crop": OFFSET, "reg": OFFSET}
    match = DepthMatcher(dataset_of(tmp_path, [cropped, REGISTERED], {"r": rig}), None).match(
        PHOTO_5
    )
    assert match is not None
    assert match.record.sensor_id == "reg"


@pytest.mark.parametrize("offset", [OFFSET, SHIFTED])
def test_two_maps_that_fit_equally_well_ask_for_the_option(tmp_path: Path, offset: Pose) -> None:
    twin = replace(REGISTERED, id="reg2")
    rig: dict[str, Pose | None] = {"cam": OFFSET, "reg": offset, "reg2": offset}
    dataset = dataset_of(tmp_path, [REGISTERED, twin], {"rig": rig})
    with pytest.raises(DatasetError) as caught:
        DepthMatcher(dataset, None).match(PHOTO_5)
    assert (caught.value.code, caught.value.field) == ("depth.ambiguous", "a.jpg")
    assert caught.value.expected == "one of reg, reg2"
    assert "--depth-sensor" in str(caught.value)
    assert DepthMatcher(dataset, "reg2").match(PHOTO_5) is not None


def test_sensors_with_poses_of_their_own_are_related_through_the_world(tmp_path: Path) -> None:
    dataset = dataset_of(tmp_path, [IR], {}, {(5, "cam"): SHIFTED, (5, "ir"): OFFSET})
    match = DepthMatcher(dataset, None).match(PHOTO_5)
    assert match is not None
    np.testing.assert_allclose(match.cam_from_depth.translation, [-0.03, 0, 5])


def test_the_rigs_own_sensor_is_preferred_to_one_elsewhere(tmp_path: Path) -> None:
    far = replace(IR, id="far")
    dataset = dataset_of(
        tmp_path,
        [far, IR],
        {"rig": {"cam": OFFSET, "ir": SHIFTED}},
        {(5, "rig"): SHIFTED, (5, "far"): OFFSET},
    )
    match = DepthMatcher(dataset, None).match(PHOTO_5)
    assert match is not None
    assert match.record.sensor_id == "ir"


def test_a_sensor_that_nothing_relates_to_the_camera_is_not_used(tmp_path: Path) -> None:
    dataset = dataset_of(tmp_path, [IR], {"rig": {"cam": OFFSET, "ir": None}})
    assert DepthMatcher(dataset, None).match(PHOTO_5) is None
    with pytest.raises(DatasetError) as caught:
        DepthMatcher(dataset, "ir").match(PHOTO_5)
    assert caught.value.code == "depth.pose"


@pytest.mark.parametrize("name", ["cam", "absent", "unknown"])
def test_naming_what_is_no_depth_sensor_is_refused(tmp_path: Path, name: str) -> None:
    unknown = Sensor("unknown", "", "depth", ("UNKNOWN_CAMERA", "320", "240"), None)
    dataset = dataset_of(tmp_path, [IR, unknown], {})
    with pytest.raises(DatasetError) as caught:
        DepthMatcher(dataset, name)
    assert (caught.value.code, caught.value.field) == ("depth.sensor", "--depth-sensor")
    assert caught.value.expected == "one of ir"


def test_the_depth_of_a_photo_is_registered_only_when_it_must_be(tmp_path: Path) -> None:
    rig: dict[str, Pose | None] = {"cam": OFFSET, "ir": SHIFTED, "reg": OFFSET}
    dataset = dataset_of(tmp_path, [IR, REGISTERED], {"rig": rig})
    for record, camera in zip(dataset.depth_maps, (DEPTH, PHOTO.scaled(160, 120)), strict=True):
        write_raw(dataset.path_of(record), [8.0] * (camera.width * camera.height))

    match = DepthMatcher(dataset, "reg").match(PHOTO_5)
    assert match is not None
    depth, view = photo_depth(dataset, match, PHOTO, 0.001)
    assert view == PHOTO.scaled(160, 120)
    assert (depth == 8.0).all()

    match = DepthMatcher(dataset, "ir").match(PHOTO_5)
    assert match is not None
    depth, view = photo_depth(dataset, match, PHOTO, 0.001)
    assert view == PHOTO
    assert np.nanmax(depth) == np.nanmin(depth) == 3.0  # 5 m nearer


def test_redkitchen_photos_have_registered_maps(shared_data: Path) -> None:
    dataset = read_dataset(shared_data / "redkitchen" / "mapping")
    matcher = DepthMatcher(dataset, None)
    for image in dataset.images[::20]:
        match = matcher.match(image)
        camera = dataset.sensors[image.sensor_id].camera
        assert match is not None
        assert camera is not None
        assert match.record.path == image.path.replace("color.jpg", "depth.reg")
        depth, view = photo_depth(dataset, match, camera, 0.001)
        assert view == camera
        assert 0.5 < np.isfinite(depth).mean() < 1
