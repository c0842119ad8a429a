from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import mapping.sample
from mapping.sample import (
    ANCHOR_ALTITUDE_M,
    ANCHOR_LATITUDE_DEG,
    ANCHOR_LONGITUDE_DEG,
    write_sample,
)
from samples.render import render_depth, render_photo
from samples.scene import Scene, make_room
from visloc.errors import Conflict, InvalidInput
from visloc.geometry import rotation_angle
from visloc.kapture import FileRecord, read_dataset

SIZE = (96, 72)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_room(4)


@pytest.fixture
def write(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """``write_sample`` in a room that is painted once for all tests."""
    monkeypatch.setattr(mapping.sample, "make_room", lambda _seed: scene)
    return write_sample


def files(root: Path) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in root.rglob("*") if p.is_file()}


def test_sample_is_a_kapture_dataset_with_all_its_parts(
    tmp_path: Path, write: Callable[..., None]
) -> None:
    steps: list[tuple[int, int]] = []
    write(tmp_path / "s", images=12, seed=4, size=SIZE, progress=lambda *step: steps.append(step))
    assert steps == [(n, 16) for n in range(1, 17)]
    mapped, query = read_dataset(tmp_path / "s" / "mapping"), read_dataset(tmp_path / "s" / "query")
    assert not mapped.notes
    assert not query.notes
    assert (len(mapped.images), len(mapped.depth_maps), len(mapped.gnss)) == (12, 12, 6)
    assert (len(query.images), len(query.depth_maps), len(query.gnss)) == (4, 0, 2)
    assert [s.kind for s in mapped.sensors.values()].count("depth") == 2
    assert set(query.rigs["rig"]) == {"left", "right", "gnss"}
    names = [record.path for record in (*mapped.images, *query.images)]
    assert len(set(names)) == 16
    assert names[0] == "mapping/left/0001.jpg"
    assert {name.split("/")[0] for name in names} == {"mapping", "query"}
    for dataset in (mapped, query):
        assert all(device == "rig" for _, device in dataset.trajectories)
        assert all(dataset.path_of(r).is_file() for r in (*dataset.images, *dataset.depth_maps))
    assert "12 photos" in (tmp_path / "s" / "README.txt").read_text(encoding="utf-8")


def test_photos_and_depth_are_what_the_written_poses_and_cameras_see(
    tmp_path: Path, scene: Scene, write: Callable[..., None]
) -> None:
    write(tmp_path / "s", images=6, seed=4, size=SIZE)
    for run in ("mapping", "query"):
        dataset = read_dataset(tmp_path / "s" / run)
        for record in dataset.images:
            camera = dataset.sensors[record.sensor_id].camera
            pose = dataset.pose(record)
            assert camera is not None
            assert pose is not None
            photo = Image.open(dataset.path_of(record)).convert("L")
            expected = Image.fromarray(render_photo(scene, camera, pose)).convert("L")
            difference = np.asarray(photo, dtype=int) - np.asarray(expected, dtype=int)
            assert np.abs(difference).mean() < 3  # JPEG and noise
            if run == "mapping":
                depth_id = f"{record.sensor_id}_depth"
                name = record.path.replace(".jpg", ".depth")
                depth_record = FileRecord(record.timestamp, depth_id, name)
                assert depth_record in dataset.depth_maps
                assert dataset.sensors[depth_id].camera == camera
                depth_pose = dataset.pose(depth_record)
                assert depth_pose is not None
                assert rotation_angle(depth_pose.rotation @ pose.rotation.T) < 1e-12
                depth = np.fromfile(dataset.path_of(depth_record), "<f4").reshape(SIZE[::-1])
                np.testing.assert_allclose(depth, render_depth(scene, camera, pose), atol=1e-6)


def test_gnss_fixes_scatter_about_the_rig_in_the_east_north_up_frame(
    tmp_path: Path, write: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    # The photos do not matter here.
    monkeypatch.setattr(mapping.sample, "render_photo", lambda *_: np.zeros((4, 4, 3), np.uint8))
    monkeypatch.setattr(mapping.sample, "render_depth", lambda *_: np.zeros((4, 4)))
    write(tmp_path / "s", images=300, seed=4, size=(64, 48))
    dataset = read_dataset(tmp_path / "s" / "mapping")
    # The same alignment, the long way: geodetic to earth-centred to east, north, up.
    origin = earth_centred(ANCHOR_LATITUDE_DEG, ANCHOR_LONGITUDE_DEG, ANCHOR_ALTITUDE_M)
    lat, lon = np.radians([ANCHOR_LATITUDE_DEG, ANCHOR_LONGITUDE_DEG])
    enu_from_earth = np.array(
        [
            [-np.sin(lon), np.cos(lon), 0],
            [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
            [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
        ]
    )
    errors = []
    for fix in dataset.gnss:
        measured = enu_from_earth @ (earth_centred(fix.y, fix.x, fix.z) - origin)
        errors.append(measured - dataset.trajectories[fix.timestamp, "rig"].center)
        assert fix.utc == fix.timestamp / 1000
    assert np.abs(np.mean(errors, axis=0)).max() < 0.4
    np.testing.assert_allclose(np.std(errors, axis=0), [0.8, 0.8, 1.5], rtol=0.25)


def earth_centred(
    latitude_deg: float, longitude_deg: float, altitude_m: float
) -> NDArray[np.float64]:
    lat, lon = np.radians([latitude_deg, longitude_deg])
    e2 = 6.69437999014e-3
    n = 6378137.0 / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    return np.array(
        [
            (n + altitude_m) * np.cos(lat) * np.cos(lon),
            (n + altitude_m) * np.cos(lat) * np.sin(lon),
            (n * (1 - e2) + altitude_m) * np.sin(lat),
        ]
    )


def test_equal_arguments_give_equal_bytes_and_another_seed_other_noise(
    tmp_path: Path, write: Callable[..., None]
) -> None:
    for name, seed in (("a", 4), ("b", 4), ("c", 5)):
        write(tmp_path / name, images=2, seed=seed, size=SIZE)
    a, b, c = (files(tmp_path / name) for name in "abc")
    assert a == b
    assert a.keys() == c.keys()
    changed = {name for name in a if a[name] != c[name]}
    assert {n for n in changed if n.endswith(".jpg")} == {n for n in a if n.endswith(".jpg")}
    assert "mapping/sensors/records_gnss.txt" in changed


def test_an_odd_number_of_photos_lacks_the_last_right_one(
    tmp_path: Path, write: Callable[..., None]
) -> None:
    write(tmp_path / "s", images=3, seed=4, size=SIZE)
    dataset = read_dataset(tmp_path / "s" / "mapping")
    assert [r.path for r in dataset.images] == [
        "mapping/left/0001.jpg",
        "mapping/right/0001.jpg",
        "mapping/left/0002.jpg",
    ]
    assert len(dataset.depth_maps) == 3
    assert len(read_dataset(tmp_path / "s" / "query").images) == 1


def test_an_empty_folder_is_used_and_a_link_to_one_is_followed(
    tmp_path: Path, write: Callable[..., None]
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "empty")
    write(tmp_path / "link", images=2, seed=4, size=SIZE)
    assert (tmp_path / "empty" / "mapping" / "sensors" / "sensors.txt").is_file()
    assert {p.name for p in tmp_path.iterdir()} == {"empty", "link"}


@pytest.mark.parametrize("as_file", [True, False])
def test_what_is_there_already_is_left_alone(tmp_path: Path, as_file: bool) -> None:
    target = tmp_path / "s"
    precious = target if as_file else target / "precious"
    precious.parent.mkdir(exist_ok=True)
    precious.write_text("keep me")
    with pytest.raises(Conflict) as raised:
        write_sample(target, images=2, size=SIZE)
    assert raised.value.code == "sample.exists"
    assert raised.value.field == str(target)
    assert precious.read_text() == "keep me"


def test_a_failure_leaves_nothing_behind(tmp_path: Path, write: Callable[..., None]) -> None:
    def fail(done: int, _total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "s", images=4, seed=4, size=SIZE, progress=fail)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("wrong", "code", "field"),
    [
        ({"images": 1}, "sample.images", "--images"),
        ({"images": -6}, "sample.images", "--images"),
        ({"images": 1_000_000}, "sample.images", "--images"),
        ({"seed": -1}, "sample.seed", "--seed"),
        ({"seed": 2**31}, "sample.seed", "--seed"),
        ({"size": (63, 48)}, "sample.size", "--size"),
        ({"size": (64, 47)}, "sample.size", "--size"),
        ({"size": (4097, 480)}, "sample.size", "--size"),
        ({"size": (640, 5000)}, "sample.size", "--size"),
    ],
)
def test_unusable_options_are_refused_before_anything_is_written(
    tmp_path: Path, wrong: dict[str, object], code: str, field: str
) -> None:
    with pytest.raises(InvalidInput) as raised:
        write_sample(tmp_path / "s", **wrong)  # type: ignore[arg-type]
    assert (raised.value.code, raised.value.field) == (code, field)
    assert raised.value.expected
    assert not list(tmp_path.iterdir())
