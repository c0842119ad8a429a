from __future__ import annotations

import io
import json
import math
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from visloc.errors import DatasetError
from visloc.geodesy import geodetic_from_enu
from visloc.pose.reprojection import project
from visloc_extensions.importers.opensfm import read
from visloc_extensions.importers.tracks import reprojection_errors

POINTS = np.array([[0.1, -0.2, 3.0], [0.5, 0.3, 4.0], [-0.6, 0.2, 2.5], [0.9, 0.7, 3.5]])
PERSPECTIVE = {
    "projection_type": "perspective",
    "width": 640,
    "height": 480,
    "focal": 0.8,
    "k1": -0.1,
    "k2": 0.02,
}
PAIRED = {"focal_x": 0.8, "focal_y": 0.79, "c_x": 0.01, "c_y": -0.02}
TRACKS = "OPENSFM_TRACKS_VERSION_v1\n"


def reconstruction() -> dict[str, Any]:
    return {
        "cameras": {"v2 phone": dict(PERSPECTIVE)},
        "shots": {
            "a.jpg": {"rotation": [0, 0, 0], "translation": [0, 0, 0], "camera": "v2 phone"},
            "b.jpg": {"rotation": [0, 0.1, 0], "translation": [0.4, 0, 0], "camera": "v2 phone"},
        },
        "points": {"17": {"color": [300.0, 20.4, -1.0], "coordinates": [0.1, 0.2, 4.0]}},
    }


def write(folder: Path, *parts: dict[str, Any], tracks: str = TRACKS) -> Path:
    (folder / "reconstruction.json").write_text(json.dumps(parts or [reconstruction()]))
    (folder / "tracks.csv").write_text(tracks)
    return folder


@pytest.fixture
def berlin(tmp_path: Path, shared_data: Path) -> Path:
    """A copy of the sample without its features, to be changed."""
    sample = shared_data / "import_samples/opensfm_berlin"
    for name in ("reconstruction.json", "tracks.csv", "reference_lla.json"):
        shutil.copyfile(sample / name, tmp_path / name)
    return tmp_path


def test_the_sample_s_points_project_to_its_features(shared_data: Path) -> None:
    folder = shared_data / "import_samples/opensfm_berlin"

    model = read(folder)

    errors = reprojection_errors(model)
    assert len(errors) == 3771
    assert errors.mean() < 1.78  # in photos of 3264 x 2448; OpenSfM's own residuals: 1.7714 px
    assert np.median(errors) < 1.24
    assert [image.name for image in model.images] == ["01.jpg", "02.jpg", "03.jpg"]
    assert model.photos == folder / "images"
    assert model.points.shape == (1702, 3)
    assert model.colors[0].tolist() == [174, 162, 146]


def test_the_sample_s_features_are_in_pixels(shared_data: Path) -> None:
    model = read(shared_data / "import_samples/opensfm_berlin")

    keypoints, descriptors = model.images[0].keypoints, model.images[0].descriptors
    assert keypoints is not None
    assert descriptors is not None
    assert keypoints.shape == (4670, 4)
    assert descriptors.shape == (4670, 128)
    assert descriptors.dtype == np.uint8
    expected = [0.01750088 * 3264 + 1632, 0.23043317 * 3264 + 1224, 0.0015625 * 3264]
    assert keypoints[0, :3] == pytest.approx(expected, rel=1e-5)
    assert keypoints[0, 3] == pytest.approx(math.radians(-0.09376709))


def test_the_sample_s_positions_become_fixes(shared_data: Path) -> None:
    folder = shared_data / "import_samples/opensfm_berlin"

    model = read(folder)

    assert len(model.gnss) == 3
    for fix, image in zip(model.gnss, model.images, strict=True):
        gps = json.loads((folder / "exif" / f"{image.name}.exif").read_text())["gps"]
        assert fix.timestamp == image.timestamp
        assert fix.sensor_id in model.sensors
        assert fix.x == pytest.approx(gps["longitude"], abs=1e-9)
        assert fix.y == pytest.approx(gps["latitude"], abs=1e-9)
        assert fix.dop == 5.0
    assert any("placeholder" in note for note in model.notes)


def test_three_fixes_as_inexact_as_the_sample_s_do_not_make_it_metric(shared_data: Path) -> None:
    model = read(shared_data / "import_samples/opensfm_berlin")

    assert not model.metric
    assert any(
        "does not count as metric: 3 positions, 2.6 m from the reconstruction (rms)" in note
        for note in model.notes
    )


def test_observations_are_the_keypoints_where_features_are_absent(berlin: Path) -> None:
    model = read(berlin)

    assert model.photos is None
    assert reprojection_errors(model).mean() < 1.78
    assert any("observations are the keypoints" in note for note in model.notes)
    assert all(image.descriptors is None for image in model.images)


@pytest.mark.parametrize(
    ("version", "columns"),
    [("", [0, 1, 2, 3, 4, 6, 7, 8]), ("OPENSFM_TRACKS_VERSION_v2\n", [*range(9), 8, 8])],
)
def test_every_version_of_the_tracks_is_read(
    berlin: Path, version: str, columns: list[int]
) -> None:
    rows = [row.split("\t") for row in (berlin / "tracks.csv").read_text().splitlines()[1:]]
    text = "\n".join("\t".join(row[column] for column in columns) for row in rows)
    (berlin / "tracks.csv").write_text(version + text)

    assert reprojection_errors(read(berlin)).mean() < 1.78


def test_matches_are_never_opened(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise AssertionError

    monkeypatch.setattr("pickle.load", refuse)
    monkeypatch.setattr("pickle.loads", refuse)
    monkeypatch.setattr("gzip.open", refuse)

    assert len(read(shared_data / "import_samples/opensfm_berlin").images) == 3


def normalized(x: float, y: float, *k: float) -> tuple[float, float]:
    r2 = x * x + y * y
    factor = 1 + sum(value * r2 ** (i + 1) for i, value in enumerate(k))
    return x * factor, y * factor


def brown(x: float, y: float) -> tuple[float, float]:
    p1, p2, r2 = 0.003, -0.002, x * x + y * y
    dx, dy = normalized(x, y, -0.1, 0.02, 0.01)
    dx += 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    dy += 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
    return dx, dy


def fisheye(x: float, y: float, *k: float) -> tuple[float, float]:
    r = math.hypot(x, y)
    theta = math.atan(r)
    scale = theta * (1 + sum(v * theta ** (2 * i + 2) for i, v in enumerate(k))) / r
    return x * scale, y * scale


@pytest.mark.parametrize(
    ("kind", "fields", "formula"),
    [
        ("perspective", {}, lambda x, y: normalized(x, y, -0.1, 0.02)),
        ("fisheye", {}, lambda x, y: fisheye(x, y, -0.1, 0.02)),
        ("simple_radial", PAIRED, lambda x, y: normalized(x, y, -0.1)),
        ("radial", PAIRED, lambda x, y: normalized(x, y, -0.1, 0.02)),
        ("brown", PAIRED | {"k3": 0.01, "p1": 0.003, "p2": -0.002}, brown),
        (
            "fisheye_opencv",
            PAIRED | {"k3": 0.01, "k4": -0.003},
            lambda x, y: fisheye(x, y, -0.1, 0.02, 0.01, -0.003),
        ),
    ],
)
def test_every_camera_projects_as_opensfm_defines_it(
    tmp_path: Path,
    kind: str,
    fields: dict[str, float],
    formula: Callable[[float, float], tuple[float, float]],
) -> None:
    part = reconstruction()
    part["cameras"]["v2 phone"].update(fields, projection_type=kind)

    sensor = read(write(tmp_path, part)).sensors["camera_0"]

    assert sensor.name == "v2 phone"
    assert sensor.camera is not None
    fx, fy, cx, cy = PAIRED.values() if fields else (0.8, 0.8, 0.0, 0.0)
    for point in POINTS:
        x, y = formula(point[0] / point[2], point[1] / point[2])
        expected = [640 * (fx * x + cx) + 320, 640 * (fy * y + cy) + 240]
        assert project(sensor.camera, point[None])[0] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("kind", ["spherical", "equirectangular", "dual", "fisheye62"])
def test_photos_of_other_cameras_are_left_out_and_counted(tmp_path: Path, kind: str) -> None:
    part = reconstruction()
    part["cameras"]["ball"] = {"projection_type": kind, "width": 100, "height": 50}
    part["shots"]["c.jpg"] = part["shots"]["b.jpg"] | {"camera": "ball"}

    model = read(write(tmp_path, part))

    assert [image.name for image in model.images] == ["a.jpg", "b.jpg"]
    assert f"1 photos of a camera of the kind {kind!r} were left out" in model.notes

    part["shots"] = {"c.jpg": part["shots"]["c.jpg"]}
    with pytest.raises(DatasetError, match="no photo of the reconstruction can be used"):
        read(write(tmp_path, part))


def test_the_largest_reconstruction_is_taken(tmp_path: Path) -> None:
    small = reconstruction()
    small["shots"] = {"c.jpg": small["shots"]["a.jpg"]}

    model = read(write(tmp_path, small, reconstruction()))

    assert [image.name for image in model.images] == ["a.jpg", "b.jpg"]
    assert any("not: reconstruction 0 with 1 photos" in note for note in model.notes)


def test_angle_axis_and_translation_are_those_of_the_camera(tmp_path: Path) -> None:
    pose = read(write(tmp_path)).images[1].cam_from_world

    assert pose is not None
    assert pose.translation == pytest.approx([0.4, 0.0, 0.0])
    assert pose.rotation[0, 2] == pytest.approx(math.sin(0.1))


def test_colors_beyond_a_byte_are_clipped(tmp_path: Path) -> None:
    assert read(write(tmp_path)).colors.tolist() == [[255, 20, 0]]


def test_tracks_of_other_photos_and_points_are_skipped(tmp_path: Path) -> None:
    row = "\t".join(["{}", "{}", "3", "0.1", "0.2", "0.01", "1", "2", "3"]) + "\n"
    tracks = row.format("a.jpg", 17) + row.format("z.jpg", 17) + row.format("a.jpg", 99)

    model = read(write(tmp_path, tracks=TRACKS + tracks))

    assert model.observations.tolist() == [[0, 0, 0]]
    assert model.images[0].keypoints is not None
    assert model.images[0].keypoints[0] == pytest.approx([384, 368])


def georeferenced(**gps: list[float]) -> dict[str, Any]:
    part = reconstruction()
    part["reference_lla"] = {"latitude": 45.0, "longitude": 5.0, "altitude": 200.0}
    for name, position in gps.items():
        part["shots"][f"{name}.jpg"]["gps_position"] = position
    return part


def walked(*scales: float) -> dict[str, Any]:
    """Photos along a line, each at a GPS position of so many times where it was reconstructed."""
    part = georeferenced()
    for number, scale in enumerate(scales):
        at = 10.0 * number
        part["shots"][f"{number}.jpg"] = part["shots"]["a.jpg"] | {
            "translation": [-at, 0, 0],
            "gps_position": [scale * at, 0, 0],
        }
    return part


def test_the_scale_is_known_only_where_positions_tell_it(tmp_path: Path) -> None:
    assert read(write(tmp_path, walked(1, 1, 1))).metric
    assert read(write(tmp_path, walked(1, 1.05, 0.99, 1.01, 1))).metric
    assert not read(write(tmp_path, walked(1, 1.6, 0.7, 1.2, 1))).metric
    assert not read(write(tmp_path, walked(1.2, 1.2, 1.2, 1.2))).metric
    assert not read(write(tmp_path, walked(1, 1))).metric
    assert not read(write(tmp_path, walked(0, 0, 0))).metric
    assert not read(write(tmp_path, georeferenced(a=[1, 0, 0]))).metric
    assert not read(write(tmp_path, georeferenced())).metric
    assert not read(write(tmp_path, reconstruction())).metric


def test_a_reference_off_the_globe_is_refused(tmp_path: Path) -> None:
    part = georeferenced(a=[0, 0, 0])
    part["reference_lla"]["latitude"] = 91

    with pytest.raises(DatasetError) as caught:
        read(write(tmp_path, part))
    assert caught.value.field is not None
    assert caught.value.field.endswith("[0].reference_lla.latitude")


@pytest.mark.parametrize("latitude", [0.0, 52.5, -89.999])
def test_local_metres_become_latitude_and_longitude(latitude: float) -> None:
    origin = np.array([latitude, 13.4, 30.0])

    assert geodetic_from_enu(np.zeros((1, 3)), origin)[0] == pytest.approx(
        [latitude, 13.4, 30.0], abs=1e-8
    )
    raised = geodetic_from_enu(np.array([[0.0, 0.0, 500.0]]), origin)[0]
    assert raised == pytest.approx([latitude, 13.4, 530.0], abs=1e-6)
    # A metre north, by the ellipsoid's radius of curvature in the meridian.
    a, e2 = 6378137.0, 6.69437999014e-3
    radius = a * (1 - e2) / (1 - e2 * math.sin(math.radians(latitude)) ** 2) ** 1.5
    north = geodetic_from_enu(np.array([[0.0, 1.0, 0.0]]), origin)[0]
    assert math.radians(north[0] - latitude) * (radius + 30) == pytest.approx(1.0, rel=1e-6)


@pytest.mark.parametrize(
    ("change", "place"),
    [
        (lambda p: p.pop("shots"), "[0]"),
        (lambda p: p.update(shots=[]), "[0].shots"),
        (lambda p: p["shots"]["a.jpg"].update(camera="other"), "[0].shots.a.jpg.camera"),
        (lambda p: p["shots"]["a.jpg"].update(rotation=[0, 0]), "[0].shots.a.jpg.rotation"),
        (lambda p: p["shots"]["a.jpg"].update(gps_position="x"), "[0].shots.a.jpg.gps_position"),
        (
            lambda p: p["shots"]["a.jpg"].update(translation=[0, 0, 1e300]),
            "[0].shots.a.jpg.translation[2]",
        ),
        (lambda p: p["cameras"]["v2 phone"].update(width=0), "[0].cameras.v2 phone"),
        (lambda p: p["cameras"]["v2 phone"].update(focal=0), "[0].cameras.v2 phone"),
        (lambda p: p["cameras"]["v2 phone"].pop("k1"), "[0].cameras.v2 phone"),
        (
            lambda p: p["points"]["17"].update(coordinates=[0, True, 0]),
            "[0].points.17.coordinates[1]",
        ),
        (lambda p: p["shots"].update({"a,b.jpg": p["shots"]["a.jpg"]}), "[0].shots.a,b.jpg"),
        (lambda p: p["shots"].update({"/x/a.jpg": p["shots"]["a.jpg"]}), "[0].shots./x/a.jpg"),
    ],
)
def test_what_is_malformed_is_named_by_its_place(
    tmp_path: Path, change: Callable[[dict[str, Any]], Any], place: str
) -> None:
    part = reconstruction()
    change(part)

    with pytest.raises(DatasetError) as caught:
        read(write(tmp_path, part))
    assert caught.value.field == f"{tmp_path / 'reconstruction.json'}: {place}"


def test_a_photo_that_occurs_twice_is_refused(tmp_path: Path) -> None:
    write(tmp_path)
    path = tmp_path / "reconstruction.json"
    path.write_text(path.read_text().replace("b.jpg", "a.jpg"))

    with pytest.raises(DatasetError, match=r"'a\.jpg' occurs twice"):
        read(tmp_path)


@pytest.mark.parametrize(
    "row",
    [
        "a.jpg\t17\t3\t0.1\t0.2",
        "a.jpg 17 3 0.1 0.2 0.01 1 2 3",
        "a.jpg\t17\t-3\t0.1\t0.2\t0.01\t1\t2\t3",
        "a.jpg\t17\t3\tnan\t0.2\t0.01\t1\t2\t3",
    ],
)
def test_a_malformed_track_is_named_by_its_line(tmp_path: Path, row: str) -> None:
    write(tmp_path, tracks=TRACKS + row)

    with pytest.raises(DatasetError) as caught:
        read(tmp_path)
    assert caught.value.field == f"{tmp_path / 'tracks.csv'}:2"


def test_an_unknown_version_of_tracks_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="version is unknown"):
        read(write(tmp_path, tracks="OPENSFM_TRACKS_VERSION_v9\n"))


def test_without_tracks_the_missing_file_is_named(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "tracks.csv").unlink()

    with pytest.raises(DatasetError) as caught:
        read(tmp_path)
    assert caught.value.code == "import.missing"


def test_no_reconstruction_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "reconstruction.json").write_text("[]")

    with pytest.raises(DatasetError, match="holds no reconstruction"):
        read(tmp_path)


def npz(path: Path, **arrays: NDArray[Any] | bytes) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in arrays.items():
            if not isinstance(array, bytes):
                file = io.BytesIO()
                np.save(file, array)
                array = file.getvalue()
            archive.writestr(f"{name}.npy", array)


def huge_header() -> bytes:
    file = io.BytesIO()
    header = {"descr": "<f4", "fortran_order": False, "shape": (10**15, 4)}
    np.lib.format.write_array_header_1_0(file, header)
    return file.getvalue()


POINT = np.array([[0.1, 0.2, 0.01, 90.0]], np.float32)
BYTES = np.zeros((1, 128), np.uint8)


@pytest.fixture
def featured(tmp_path: Path) -> Path:
    (tmp_path / "features").mkdir()
    for name in "ab":
        npz(tmp_path / f"features/{name}.jpg.features.npz", points=POINT, descriptors=BYTES)
    return write(tmp_path)


@pytest.mark.parametrize(
    ("arrays", "complaint"),
    [
        ({"points": POINT}, "is missing"),
        ({"points": POINT, "descriptors": BYTES[:0]}, "numbers of descriptors and points differ"),
        ({"points": POINT, "descriptors": BYTES[:, :64]}, "differ in kind"),
        ({"points": POINT[:, :3], "descriptors": BYTES}, "points are not valid"),
        ({"points": POINT * np.nan, "descriptors": BYTES}, "points are not valid"),
        ({"points": POINT.astype("<f8") * 1e300, "descriptors": BYTES}, "points are not valid"),
        ({"points": POINT[0], "descriptors": BYTES}, "'points' is not valid"),
        ({"points": huge_header(), "descriptors": BYTES}, "'points' is not valid"),
        ({"points": b"\x93NUMPY", "descriptors": BYTES}, "not an array"),
        (
            {"points": np.array([[{}]], dtype=object), "descriptors": BYTES},
            "'points' is not valid",
        ),
    ],
)
def test_features_that_are_not_usable_are_refused(
    featured: Path, arrays: dict[str, Any], complaint: str
) -> None:
    path = featured / "features/b.jpg.features.npz"
    npz(path, **arrays)

    with pytest.raises(DatasetError, match=complaint) as caught:
        read(featured)
    assert caught.value.code == "import.features"
    assert caught.value.field == str(path)


@pytest.mark.parametrize("cut", [0, 10, 200, -5])
def test_cut_off_features_are_refused(featured: Path, cut: int) -> None:
    path = featured / "features/a.jpg.features.npz"
    path.write_bytes(path.read_bytes()[:cut])

    with pytest.raises(DatasetError) as caught:
        read(featured)
    assert caught.value.field == str(path)


@pytest.mark.parametrize(("feature", "x"), [(1, 0.1), (0, 0.11)])
def test_tracks_of_other_features_are_refused(featured: Path, feature: int, x: float) -> None:
    row = f"a.jpg\t17\t{feature}\t{x}\t0.2\t0.01\t1\t2\t3"

    with pytest.raises(DatasetError, match=r"the tracks in .* were made from other features"):
        read(write(featured, tracks=TRACKS + row))
