from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from mapping.cli.main import app
from mapping.frames.georeference import (
    correspondences_from_fixes,
    georeference,
    given_place,
    publish_anchored,
    read_correspondences,
)
from visloc.archive import Geodetic, Map, MapStore, verify_map
from visloc.archive.places import enu_of, origin_of
from visloc.errors import Conflict, DatasetError, InvalidInput, VislocError
from visloc.geodesy import ecef_from_geodetic, geodetic_from_enu
from visloc.geometry import Pose
from visloc.kapture import Dataset, GnssRecord, Sensor, read_dataset, write_dataset

HOME = np.array([45.2, 5.7, 212.5])
# The room stands turned and moved; a unit of it is a metre.
TURNED = Pose.from_quaternion([0.9, 0.02, -0.01, 0.4], [12.0, -7.0, 3.0])


@pytest.fixture
def room(maps_dir: Path) -> Map:
    return MapStore(maps_dir).open("room")


def centers_of(opened: Map) -> NDArray[np.float64]:
    return np.array([Pose.from_quaternion(p[:4], p[4:]).center for p in opened.image_poses])


def positions_of(
    points: NDArray[np.float64], scale: float = 1.0, home: NDArray[np.float64] = HOME
) -> NDArray[np.float64]:
    """Where points of the map's world are on Earth."""
    return geodetic_from_enu(TURNED.apply(scale * points), home)


def not_metric(opened: Map) -> Map:
    world = opened.manifest.world.model_copy(update={"metric": False})
    return replace(opened, manifest=opened.manifest.model_copy(update={"world": world}))


def far_apart(opened: Map) -> Map:
    """The same map with photos far apart, each of another instant."""
    poses = opened.image_poses.copy()
    centers = 100.0 * centers_of(opened)
    for row, center in zip(poses, centers, strict=True):
        row[4:] = -Pose.from_quaternion(row[:4], row[4:]).rotation @ center
    images = tuple(replace(image, timestamp=row) for row, image in enumerate(opened.images))
    return replace(opened, image_poses=poses, images=images)


def dataset_with_fixes(
    opened: Map, positions: NDArray[np.float64], system: str | None = None
) -> Dataset:
    fixes = tuple(
        GnssRecord(image.timestamp, "gps", lon, lat, height, 0.0, 0.0)
        for image, (lat, lon, height) in zip(opened.images, positions, strict=True)
    )
    params = () if system is None else (system,)
    sensors = {"gps": Sensor("gps", "", "gnss", params, None)}
    return Dataset(Path("dataset"), sensors, {}, {}, (), (), fixes)


def misplacement(
    geodetic: Geodetic,
    points: NDArray[np.float64],
    scale: float = 1.0,
    home: NDArray[np.float64] = HOME,
) -> float:
    """How far points are put from where they are, metres at most."""
    put = ecef_from_geodetic(geodetic_from_enu(enu_of(points, geodetic), origin_of(geodetic)))
    return float(np.abs(put - ecef_from_geodetic(positions_of(points, scale, home))).max())


def csv_file(path: Path, header: str, rows: list[str]) -> Path:
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


POINTS = np.array([[0.0, 0, 0], [20, 0, 0], [0, 30, 0], [5, 5, 10], [-8, 12, 3]])


def point_rows(positions: NDArray[np.float64], points: NDArray[np.float64] = POINTS) -> list[str]:
    return [
        ",".join(repr(float(v)) for v in (*point, *position))
        for point, position in zip(points, positions, strict=True)
    ]


POINT_HEADER = "x,y,z,latitude,longitude,altitude"


def test_exact_fixes_put_the_map_where_it_is(room: Map) -> None:
    large = far_apart(room)
    centers = centers_of(large)
    known = correspondences_from_fixes(large, dataset_with_fixes(large, positions_of(centers)))
    found = georeference(large, known)
    assert found.agrees.all()
    assert found.anchor.kind == "gnss"
    assert found.anchor.geodetic is not None
    assert found.anchor.geodetic.scale == 1.0
    assert misplacement(found.anchor.geodetic, POINTS) < 1e-5
    assert np.abs(found.residuals_m).max() < 1e-5


def test_wrong_fixes_are_left_out_and_noise_is_averaged(room: Map) -> None:
    large = far_apart(room)
    centers = centers_of(large)
    rng = np.random.default_rng(0)
    noisy = TURNED.apply(centers) + rng.normal(scale=0.3, size=centers.shape)
    noisy[2] += [300.0, 0.0, 0.0]
    positions = geodetic_from_enu(noisy, HOME)
    known = correspondences_from_fixes(large, dataset_with_fixes(large, positions))
    found = georeference(large, known)
    wrong = known.names.index(room.images[2].name)
    assert not found.agrees[wrong]
    assert found.agrees.sum() == len(known.names) - 1 == found.anchor.images
    assert np.linalg.norm(found.residuals_m[wrong]) == pytest.approx(300, abs=10)
    assert found.anchor.geodetic is not None
    assert misplacement(found.anchor.geodetic, centers) < 1.0
    assert found.anchor.rms is not None
    assert 0.2 < found.anchor.rms < 1.0


def test_a_map_of_unknown_scale_gets_it(room: Map) -> None:
    large = not_metric(far_apart(room))
    positions = positions_of(centers_of(large), scale=4.0)
    known = correspondences_from_fixes(large, dataset_with_fixes(large, positions))
    found = georeference(large, known)
    assert found.anchor.geodetic is not None
    assert found.anchor.geodetic.scale == pytest.approx(4.0, rel=1e-6)
    assert misplacement(found.anchor.geodetic, POINTS, 4.0) < 1e-4


def test_a_metric_map_keeps_its_scale_and_refuses_another(room: Map) -> None:
    large = far_apart(room)
    centers = centers_of(large)
    near = dataset_with_fixes(large, positions_of(centers, scale=1.02))
    found = georeference(large, correspondences_from_fixes(large, near))
    assert found.anchor.geodetic is not None
    assert found.anchor.geodetic.scale == 1.0
    other = dataset_with_fixes(large, positions_of(centers, scale=4.0))
    with pytest.raises(InvalidInput) as caught:
        georeference(large, correspondences_from_fixes(large, other))
    assert caught.value.code == "anchor.scale"
    assert caught.value.got == "a unit of 4 m"


def test_fixes_that_do_not_determine_the_place_are_refused(room: Map) -> None:
    centers = centers_of(room)  # a few metres apart
    noisy = TURNED.apply(centers) + np.random.default_rng(1).normal(scale=3.0, size=centers.shape)
    dataset = dataset_with_fixes(room, geodetic_from_enu(noisy, HOME))
    with pytest.raises(InvalidInput, match="do not determine where the map lies") as caught:
        georeference(room, correspondences_from_fixes(room, dataset))
    assert caught.value.code == "anchor.undetermined"


def test_fixes_in_metres_or_of_other_photos_are_refused(room: Map) -> None:
    positions = positions_of(centers_of(room))
    with pytest.raises(DatasetError, match="degrees"):
        correspondences_from_fixes(room, dataset_with_fixes(room, positions, "EPSG:32631"))
    dataset = dataset_with_fixes(room, positions)
    moved = replace(
        dataset, gnss=tuple(replace(f, timestamp=f.timestamp + 7) for f in dataset.gnss)
    )
    with pytest.raises(InvalidInput) as caught:
        correspondences_from_fixes(room, moved)
    assert caught.value.code == "anchor.fixes"


FLOOR = POINTS * [1, 1, 0]  # z exactly 0


@pytest.mark.parametrize("points", [POINTS, FLOOR, FLOOR[:3]], ids=["space", "floor", "three"])
@pytest.mark.parametrize("home", [HOME, (-16.8, 180.0, 7.0), (89.99999, -3.0, 7.0)])
def test_given_points_put_the_map_where_it_is(
    room: Map,
    tmp_path: Path,
    points: NDArray[np.float64],
    home: tuple[float, float, float],
) -> None:
    rows = point_rows(positions_of(points, home=np.array(home)), points)
    path = csv_file(tmp_path / "points.csv", POINT_HEADER, rows)
    found = georeference(room, read_correspondences(room, path))
    assert found.anchor.kind == "correspondences"
    assert found.anchor.images == len(points)
    assert found.anchor.geodetic is not None
    assert misplacement(found.anchor.geodetic, POINTS, home=np.array(home)) < 1e-6


def test_one_point_of_another_country_is_named_and_hides_no_smaller_mistake(
    room: Map, tmp_path: Path
) -> None:
    points = np.concatenate([FLOOR, FLOOR + np.array([40.0, 0.0, 0.0])])
    positions = positions_of(points)
    positions[0] = 52.52, 13.405, 34.0
    positions[4, 2] += 6.0  # less than 10 m, more than 5 % of the spread
    path = csv_file(tmp_path / "points.csv", POINT_HEADER, point_rows(positions, points))
    found = georeference(room, read_correspondences(room, path))
    assert np.flatnonzero(~found.agrees).tolist() == [0, 4]
    assert found.anchor.geodetic is not None
    assert misplacement(found.anchor.geodetic, POINTS) < 1e-6


def test_photos_may_be_named_instead_of_points(room: Map, tmp_path: Path) -> None:
    large = far_apart(room)
    positions = positions_of(centers_of(large))
    rows = [
        f"{image.name},{','.join(repr(float(v)) for v in position)}"
        for image, position in zip(large.images, positions, strict=True)
    ]
    path = csv_file(tmp_path / "photos.csv", "image,latitude,longitude,altitude", rows)
    found = georeference(large, read_correspondences(large, path))
    assert found.anchor.geodetic is not None
    assert misplacement(found.anchor.geodetic, POINTS) < 1e-4


@pytest.mark.parametrize(
    ("header", "row", "code", "where"),
    [
        ("x,y,z", "1,2,3", "anchor.file", ":1"),
        (POINT_HEADER, "", "anchor.file", ":1"),
        (POINT_HEADER, "1,2,3,45,5", "anchor.file", ":2"),
        (POINT_HEADER, "1,2,3,45,5,high", "anchor.file", ":2"),
        (POINT_HEADER, "1,2,3,45,5,nan", "anchor.file", ":2"),
        (POINT_HEADER, "1,2,3,95,5,10", "anchor.position", ""),
        ("image,latitude,longitude,altitude", "no.jpg,45,5,10", "anchor.image", ":2"),
    ],
)
def test_a_file_that_is_wrong_is_refused_by_its_line(
    room: Map, tmp_path: Path, header: str, row: str, code: str, where: str
) -> None:
    path = csv_file(tmp_path / "points.csv", header, [row])
    with pytest.raises(InvalidInput) as caught:
        read_correspondences(room, path)
    assert caught.value.code == code
    assert caught.value.field == f"{path}{where}"


def test_a_place_that_is_said_is_taken_as_said(room: Map) -> None:
    found = given_place(room, (45.2, 5.7, 212.5), 90.0, gravity=(0.0, 0.0, -9.81))
    geodetic = found.anchor.geodetic
    assert geodetic is not None
    np.testing.assert_allclose(origin_of(geodetic), HOME)
    # x points north, so y points west.
    np.testing.assert_allclose(
        enu_of(np.eye(3), geodetic), [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-12
    )
    # In a world whose y points down, as of a first camera, x is right and z ahead of it.
    found = given_place(room, (45.2, 5.7, 212.5), -90.0, gravity=(0.0, 1.0, 0.0))
    assert found.anchor.geodetic is not None
    np.testing.assert_allclose(
        enu_of(np.eye(3), found.anchor.geodetic), [[0, -1, 0], [0, 0, -1], [1, 0, 0]], atol=1e-12
    )


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"gravity": None}, "anchor.gravity"),
        ({"gravity": (0.0, 0.0, 0.0)}, "anchor.gravity"),
        ({"gravity": (math.inf, 0.0, 0.0)}, "anchor.gravity"),
        ({"gravity": (1.0, 0.0, 0.01)}, "anchor.yaw"),
        ({"yaw": math.nan}, "anchor.yaw"),
        ({"latitude": math.nan}, "anchor.position"),
        ({"scale": 2.0}, "anchor.scale"),
    ],
)
def test_a_place_that_cannot_be_is_refused(
    room: Map, changes: dict[str, object], code: str
) -> None:
    said: dict[str, object] = {"latitude": 45.0, "yaw": 0.0, "scale": None}
    said |= {"gravity": (0.0, 0.0, -1.0), **changes}
    with pytest.raises(VislocError) as caught:
        given_place(
            room,
            (said["latitude"], 5.0, 0.0),  # type: ignore[arg-type]
            said["yaw"],  # type: ignore[arg-type]
            scale=said["scale"],  # type: ignore[arg-type]
            gravity=said["gravity"],  # type: ignore[arg-type]
        )
    assert caught.value.code == code


def test_an_anchored_map_is_a_new_version_of_the_same_files(room: Map, maps_dir: Path) -> None:
    found = given_place(room, (45.2, 5.7, 212.5), 30.0, gravity=(0.0, 0.0, -1.0))
    folder = publish_anchored(room, found, maps_dir, force=False)
    opened = verify_map(folder)
    assert MapStore(maps_dir).current_version("room") == opened.manifest.version
    assert opened.manifest.version != room.manifest.version
    assert opened.manifest.version.endswith(opened.manifest.content_hash[:8])
    assert opened.manifest.format_version == "3.2"
    assert opened.manifest.files == room.manifest.files
    assert opened.geodetic == found.anchor.geodetic
    assert opened.gravity is not None
    np.testing.assert_allclose(opened.gravity, [0, 0, -1], atol=1e-12)
    assert opened.place is not None
    assert opened.place.distance_to(45.2, 5.7) == 0
    for name in room.manifest.files:
        assert (folder / name).samefile(room.path / name)
    # The version before is untouched, and stays when another is published.
    assert verify_map(room.path).geodetic is None
    with pytest.raises(Conflict) as caught:
        publish_anchored(opened, found, maps_dir, force=False)
    assert caught.value.code == "map.anchored"
    # The one before is not current any more: what came since would be lost.
    with pytest.raises(Conflict) as caught:
        publish_anchored(room, found, maps_dir, force=True)
    assert caught.value.code == "map.outdated"
    assert MapStore(maps_dir).current_version("room") == opened.manifest.version
    again = given_place(opened, (45.3, 5.7, 0.0), 0.0)
    publish_anchored(opened, again, maps_dir, force=True)
    assert len(MapStore(maps_dir).versions("room")) == 3


def test_where_there_are_no_hard_links_files_are_copied(
    room: Map, maps_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(Path, "hardlink_to", refuse)
    found = given_place(room, (45.2, 5.7, 212.5), 30.0, gravity=(0.0, 0.0, -1.0))
    folder = publish_anchored(room, found, maps_dir, force=False)
    verify_map(folder)
    assert not (folder / "landmarks.npy").samefile(room.path / "landmarks.npy")


def test_a_contradiction_to_a_known_down_is_refused(room: Map) -> None:
    world = room.manifest.world.model_copy(update={"gravity": (0.0, 1.0, 0.0)})
    knowing = replace(room, manifest=room.manifest.model_copy(update={"world": world}))
    large = far_apart(knowing)
    dataset = dataset_with_fixes(large, positions_of(centers_of(large)))
    with pytest.raises(InvalidInput) as caught:
        georeference(large, correspondences_from_fixes(large, dataset))
    assert caught.value.code == "anchor.gravity"
    with pytest.raises(InvalidInput) as caught:
        given_place(knowing, (45.0, 5.0, 0.0), 0.0, gravity=(0.0, 0.0, -1.0))
    assert caught.value.code == "anchor.gravity"


def run(*arguments: str) -> tuple[int, str, BaseException | None]:
    result = CliRunner().invoke(app, ["anchor", *arguments], env={"COLUMNS": "200"})
    return result.exit_code, result.output, result.exception


def test_the_command_anchors_by_points_and_prints_what_is_left(
    maps_dir: Path, tmp_path: Path
) -> None:
    positions = positions_of(POINTS)
    path = csv_file(tmp_path / "points.csv", POINT_HEADER, point_rows(positions))
    code, output, _ = run("room", "--maps-dir", str(maps_dir), "--correspondences", str(path))
    assert code == 0, output
    assert "5 of 5 agree" in output
    assert "line 2" in output
    assert f"map {MapStore(maps_dir).open('room').ref}" in output
    shown = CliRunner().invoke(
        app, ["inspect", "room", "--maps-dir", str(maps_dir)], env={"COLUMNS": "200"}
    )
    assert "latitude 45.1999" in shown.output
    assert "5 given points" in shown.output


def test_the_command_finds_the_fixes_of_photos_by_their_names_in_the_dataset(
    maps_dir: Path, sample: Path, tmp_path: Path, room: Map
) -> None:
    """Written again with other timestamps, one per photo."""
    given = read_dataset(sample / "mapping")
    rows = {image.name: row for row, image in enumerate(room.images)}
    images = tuple(replace(record, timestamp=rows[record.path] + 1) for record in given.images)
    fixes = tuple(
        GnssRecord(row + 1, "gnss", lon, lat, height, 0.0, 0.0)
        for row, (lat, lon, height) in enumerate(positions_of(centers_of(room)))
    )
    write_dataset(
        replace(
            given,
            root=tmp_path / "dataset",
            rigs={},
            trajectories={},
            images=tuple(sorted(images, key=lambda record: record.timestamp)),
            depth_maps=(),
            gnss=fixes,
        )
    )
    arguments = ("room", "--maps-dir", str(maps_dir), "--dataset", str(tmp_path / "dataset"))
    code, output, error = run(*arguments)
    assert code == 0, (output, error)
    geodetic = MapStore(maps_dir).open("room").geodetic
    assert geodetic is not None
    assert misplacement(geodetic, centers_of(room)) < 1e-4


def test_a_room_is_too_small_for_the_receiver_of_the_sample(maps_dir: Path, sample: Path) -> None:
    dataset = str(sample / "mapping")
    _, _, error = run("room", "--maps-dir", str(maps_dir), "--dataset", dataset)
    assert isinstance(error, InvalidInput)
    assert error.code == "anchor.undetermined"
    assert "too inexact for their extent" in error.message
    assert MapStore(maps_dir).open("room").geodetic is None


def test_the_command_wants_one_way_and_all_of_it(maps_dir: Path, tmp_path: Path) -> None:
    place = ("--latitude", "45", "--longitude", "5", "--altitude", "0")
    for arguments in ((), place, (*place, "--yaw", "0", "--dataset", str(tmp_path)), place[:2]):
        _, _, error = run("room", "--maps-dir", str(maps_dir), *arguments)
        assert isinstance(error, InvalidInput), arguments
        assert error.code == "anchor.source"
    rest = ("--yaw", "0", "--gravity", "0,0,-1")
    code, output, _ = run("room", "--maps-dir", str(maps_dir), *place, *rest)
    assert code == 0, output
    assert "place: latitude 45.000000000" in output
