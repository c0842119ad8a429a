from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from visloc.errors import DatasetError
from visloc.geometry import CAMERA_MODELS, Camera, Pose
from visloc.kapture import Dataset, FileRecord, read_dataset

HEADER = "# kapture format: 1.1\n"
SENSORS = """\
# sensor_id, name, sensor_type, [sensor_params]+
cam, front, camera, PINHOLE, 640, 480, 500, 510, 320, 240
ir, , depth, SIMPLE_PINHOLE, 320, 240, 250, 160, 120
gps, , gnss, EPSG:4326
"""
IDENTITY = "1, 0, 0, 0, 0, 0, 0"


def write(root: Path, files: Mapping[str, str], header: str = HEADER) -> Path:
    (root / "sensors").mkdir(parents=True, exist_ok=True)
    for name, text in {"sensors": SENSORS, **files}.items():
        (root / "sensors" / f"{name}.txt").write_text(header + text, encoding="utf-8")
    return root


def refusal(root: Path) -> DatasetError:
    with pytest.raises(DatasetError) as caught:
        read_dataset(root)
    return caught.value


def note(dataset: Dataset) -> str:
    (only,) = dataset.notes
    return only


def test_sensors_alone_make_a_dataset(tmp_path: Path) -> None:
    dataset = read_dataset(write(tmp_path, {}))

    assert list(dataset.sensors) == ["cam", "ir", "gps"]
    assert dataset.sensors["cam"].name == "front"
    assert dataset.sensors["cam"].camera == Camera("PINHOLE", 640, 480, (500, 510, 320, 240))
    assert dataset.sensors["ir"].kind == "depth"
    assert dataset.sensors["ir"].image_size == (320, 240)
    assert dataset.sensors["gps"].camera is None
    assert dataset.sensors["gps"].image_size is None
    assert dataset.sensors["gps"].params == ("EPSG:4326",)
    assert (dataset.rigs, dataset.trajectories) == ({}, {})
    assert (dataset.images, dataset.depth_maps, dataset.gnss) == ((), (), ())
    assert dataset.notes == ()


@pytest.mark.parametrize("model", CAMERA_MODELS)
def test_every_camera_model_needs_its_number_of_parameters(tmp_path: Path, model: str) -> None:
    params = ["640", "480", *("1" for _ in CAMERA_MODELS[model])]
    dataset = read_dataset(
        write(tmp_path, {"sensors": f"c, , camera, {model}, {','.join(params)}"})
    )
    assert dataset.sensors["c"].camera is not None

    write(tmp_path, {"sensors": f"# comment\nc, , camera, {model}, {','.join(params[:-1])}"})
    error = refusal(tmp_path)
    assert (error.code, error.field) == ("camera.param_count", "sensors/sensors.txt:3")


def test_an_unknown_camera_has_a_size_but_no_intrinsics(tmp_path: Path) -> None:
    sensor = read_dataset(
        write(tmp_path, {"sensors": "c, , camera, UNKNOWN_CAMERA, 640.0, 480"})
    ).sensors["c"]
    assert sensor.camera is None
    assert sensor.image_size == (640, 480)


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("c, , camera, PINHOLE, 0, 480, 1, 1, 1, 1", "camera.size"),
        ("c, , camera, PINHOLE, 640.5, 480, 1, 1, 1, 1", "camera.size"),
        ("c, , camera, PINHOLE, 640, 1e300, 1, 1, 1, 1", "camera.size"),
        ("c, , camera, UNKNOWN_CAMERA, -640, 480", "camera.size"),
        ("c, , camera, UNKNOWN_CAMERA, 640, 480, 1", "camera.param_count"),
        ("c, , camera, PINHOLE, 640, 480, -1, 1, 1, 1", "camera.param_value"),
        ("c, , depth, PINHOLE, 640, 480, 0, 1, 1, 1", "camera.param_value"),
        ("c, , camera, PINHOLE, 640, 480, nan, 1, 1, 1", "kapture.number"),
        ("c, , camera, PINHOLE, 640, 480, 1_0, 1, 1, 1", "kapture.number"),
        ("c, , camera, PINHOLE, 640, 480, __import__('os').abort(), 1, 1, 1", "kapture.number"),
        ("c, , camera, pinhole, 640, 480, 1, 1, 1, 1", "camera.model"),
        ("c, , camera", "camera.model"),
        ("c, name", "kapture.column_count"),
        (", name, camera, UNKNOWN_CAMERA, 640, 480", "kapture.field"),
        ("c, , lidar\nc, , wifi", "kapture.duplicate"),
    ],
)
def test_a_sensor_that_cannot_be_is_refused_with_its_line(
    tmp_path: Path, line: str, code: str
) -> None:
    error = refusal(write(tmp_path, {"sensors": line}))
    assert error.code == code
    assert error.field == f"sensors/sensors.txt:{2 + line.count(chr(10))}"


def test_other_kinds_of_sensors_are_kept_as_they_are(tmp_path: Path) -> None:
    text = "a, , lidar\nb, , pressure, 7, , x\nc, , gnss\nd d.4/x, , gnss,"
    sensors = read_dataset(write(tmp_path, {"sensors": text})).sensors
    assert [(s.id, s.kind, s.params) for s in sensors.values()] == [
        ("a", "lidar", ()),
        ("b", "pressure", ("7", "", "x")),
        ("c", "gnss", ()),
        ("d d.4/x", "gnss", ("",)),
    ]


@pytest.mark.parametrize("root", ["empty", "absent", "file"])
def test_a_folder_without_sensors_file_is_refused(tmp_path: Path, root: str) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").touch()
    error = refusal(tmp_path / root)
    assert (error.code, error.field) == ("kapture.no_dataset", "sensors/sensors.txt")
    assert root in str(error)


@pytest.mark.parametrize(
    ("header", "got"),
    [
        ("", None),
        ("# sensor_id, name\n", None),
        ("kapture format: 1.1\n", None),
        ("# kapture format: 1.2\n", "1.2"),
        ("# kapture format: 2.0\n", "2.0"),
        ("# kapture format: 0.9\n", "0.9"),
    ],
)
def test_a_version_that_is_missing_or_unknown_is_refused(
    tmp_path: Path, header: str, got: str | None
) -> None:
    error = refusal(write(tmp_path, {}, header))
    assert (error.code, error.field, error.got) == ("kapture.version", "sensors/sensors.txt:1", got)


def test_an_empty_sensors_file_is_refused(tmp_path: Path) -> None:
    write(tmp_path, {})
    (tmp_path / "sensors" / "sensors.txt").write_bytes(b"")
    assert refusal(tmp_path).code == "kapture.version"


def test_version_1_0_is_read_with_a_note_about_its_features(tmp_path: Path) -> None:
    dataset = read_dataset(write(tmp_path, {}, "#kapture format:1.0\n"))
    assert "cam" in dataset.sensors
    assert "reconstruction" in note(dataset)


def test_padding_blank_lines_comments_crlf_and_byte_order_mark_are_tolerated(
    tmp_path: Path,
) -> None:
    write(tmp_path, {})
    (tmp_path / "sensors" / "records_data").mkdir()
    (tmp_path / "sensors" / "records_data" / "a.jpg").touch()
    (tmp_path / "sensors" / "sensors.txt").write_bytes(
        "\ufeff# kapture format: 1.1\r\n\r\n  # indented comment\r\n"
        "  c  ,\t, camera,UNKNOWN_CAMERA ,640,  480\r\n".encode()
    )
    (tmp_path / "sensors" / "records_camera.txt").write_bytes(b"\xef\xbb\xbf   7,  c,a.jpg  \r\n")
    dataset = read_dataset(tmp_path)
    assert dataset.images == (FileRecord(7, "c", "a.jpg"),)
    assert dataset.notes == ()


@pytest.mark.parametrize("name", ["sensors", "records_camera"])
def test_a_file_that_is_not_utf_8_is_refused(tmp_path: Path, name: str) -> None:
    write(tmp_path, {name: ""})
    (tmp_path / "sensors" / f"{name}.txt").write_bytes(b"# kapture format: 1.1\n1, cam, \xff\n")
    error = refusal(tmp_path)
    assert (error.code, error.field) == ("kapture.encoding", f"sensors/{name}.txt")


def test_a_folder_in_the_place_of_a_file_is_refused(tmp_path: Path) -> None:
    (write(tmp_path, {}) / "sensors" / "rigs.txt").mkdir()
    error = refusal(tmp_path)
    assert (error.code, error.field) == ("kapture.unreadable", "sensors/rigs.txt")


def test_a_folder_that_cannot_be_looked_into_is_refused(tmp_path: Path) -> None:
    error = refusal(tmp_path / ("x" * 300))
    assert (error.code, error.field) == ("kapture.unreadable", "sensors/sensors.txt")


# Records


@pytest.mark.parametrize("name", ["records_camera", "records_depth"])
@pytest.mark.parametrize(
    "path",
    [
        "../a.jpg",
        "a/../../b.jpg",
        "a/..",
        "/etc/passwd",
        "\\\\server\\share",
        "..\\a.jpg",
        "C:\\a.jpg",
        "c:a.jpg",
        "",
        ".",
        "a\0b.jpg",
        "a\tb.jpg",
    ],
)
def test_a_path_that_leads_out_is_refused(tmp_path: Path, name: str, path: str) -> None:
    error = refusal(write(tmp_path, {name: f"1, cam, {path}"}))
    assert (error.code, error.field) == ("kapture.path", f"sensors/{name}.txt:2")


@pytest.mark.parametrize(
    ("text", "path"),
    [
        ("./a//b/./c.jpg", "a/b/c.jpg"),
        ("a\\b.jpg", "a/b.jpg"),
        ("a..b/...jpg", "a..b/...jpg"),
        ("été 1/ö.jpg", "été 1/ö.jpg"),
    ],
)
def test_paths_come_in_one_spelling(tmp_path: Path, text: str, path: str) -> None:
    dataset = read_dataset(write(tmp_path, {"records_camera": f"1, cam, {text}"}))
    (image,) = dataset.images
    assert image.path == path
    assert dataset.path_of(image) == tmp_path / "sensors" / "records_data" / path


def test_two_spellings_of_one_path_are_one_path(tmp_path: Path) -> None:
    error = refusal(write(tmp_path, {"records_camera": "1, cam, a/b.jpg\n2, cam, a/./b.jpg"}))
    assert (error.code, error.field) == ("kapture.duplicate", "sensors/records_camera.txt:3")


def test_records_data_may_be_a_link(tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "a.jpg").touch()
    root = write(tmp_path / "dataset", {"records_camera": "1, cam, a.jpg"})
    (root / "sensors" / "records_data").symlink_to(elsewhere)
    assert read_dataset(root).notes == ()


def test_records_come_sorted(tmp_path: Path) -> None:
    dataset = read_dataset(
        write(
            tmp_path,
            {
                "sensors": "b, , camera, UNKNOWN_CAMERA, 1, 1\na, , camera, UNKNOWN_CAMERA, 1, 1",
                "records_camera": "10, b, 1.jpg\n9, b, 3.jpg\n10, a, 2.jpg\n-1, a, 4.jpg",
            },
        )
    )
    assert [image.path for image in dataset.images] == ["4.jpg", "3.jpg", "2.jpg", "1.jpg"]


@pytest.mark.parametrize("timestamp", [0, -(2**63), 2**63 - 1, 1555398770307123456])
def test_timestamps_are_64_bit_integers(tmp_path: Path, timestamp: int) -> None:
    dataset = read_dataset(write(tmp_path, {"records_camera": f"{timestamp}, cam, a.jpg"}))
    assert dataset.images[0].timestamp == timestamp


@pytest.mark.parametrize(
    "text", ["", "1.5", "1e3", "nan", "1_0", "x", str(2**63), "9" * 5000, "\u0661"]
)
def test_other_timestamps_are_refused(tmp_path: Path, text: str) -> None:
    error = refusal(write(tmp_path, {"records_camera": f"{text}, cam, a.jpg"}))
    assert (error.code, error.field) == ("kapture.timestamp", "sensors/records_camera.txt:2")


@pytest.mark.parametrize(
    ("name", "rows"),
    [
        ("records_camera", "1, cam, a.jpg\n1, cam, b.jpg"),
        ("records_camera", "1, other, a.jpg\n1, other, b.jpg"),
        ("records_depth", "1, ir, a\n01, ir, b"),
        ("records_gnss", "1, gps, 1, 2, 3, 0, 0\n1, gps, 1, 2, 3, 0, 0"),
        ("trajectories", f"1, cam, {IDENTITY}\n1, cam, {IDENTITY}"),
        ("trajectories", f"1, cam, {IDENTITY}\n1, cam, , , , , , , "),
        ("rigs", f"rig, cam, {IDENTITY}\nrig, cam, {IDENTITY}"),
        ("rigs", f"rig, unknown, {IDENTITY}\nrig, unknown, {IDENTITY}"),
    ],
)
def test_duplicate_keys_are_refused_at_the_second_line(
    tmp_path: Path, name: str, rows: str
) -> None:
    error = refusal(write(tmp_path, {name: rows}))
    assert (error.code, error.field) == ("kapture.duplicate", f"sensors/{name}.txt:3")


@pytest.mark.parametrize(
    ("name", "row"),
    [
        ("records_camera", "1, cam"),
        ("records_camera", "1, cam, a,b.jpg"),
        ("records_depth", "1, ir, a, "),
        ("records_gnss", "1, gps, 1, 2, 3"),
        ("trajectories", "1, cam, 1, 0, 0, 0, 0, 0"),
        ("rigs", "rig, cam"),
    ],
)
def test_a_wrong_number_of_columns_is_refused(tmp_path: Path, name: str, row: str) -> None:
    error = refusal(write(tmp_path, {name: f"\n\n{row}"}))
    assert (error.code, error.field) == ("kapture.column_count", f"sensors/{name}.txt:4")


def test_records_of_unknown_or_other_sensors_are_left_out_with_notes(tmp_path: Path) -> None:
    dataset = read_dataset(
        write(
            tmp_path,
            {"records_depth": "1, cam, a\n2, cam, b\n3, nobody, c\n4, gps, d"},
        )
    )
    assert dataset.depth_maps == ()
    assert dataset.notes == (
        "sensors/records_depth.txt: 3 records of sensors that are not of type depth were left out"
        " (first in line 2: cam is of type 'camera')",
        "sensors/records_depth.txt: 1 records of unknown sensors were left out"
        " (first in line 4: nobody)",
    )


def test_files_that_do_not_exist_are_counted(tmp_path: Path) -> None:
    root = write(tmp_path, {"records_camera": f"1, cam, a.jpg\n2, cam, b.jpg\n3, cam, {'x' * 999}"})
    (root / "sensors" / "records_data").mkdir()
    (root / "sensors" / "records_data" / "a.jpg").touch()
    dataset = read_dataset(root)
    assert len(dataset.images) == 3
    assert note(dataset) == (
        "sensors/records_camera.txt: 2 files do not exist (first in line 3: b.jpg)"
    )


def test_gnss_is_read(tmp_path: Path) -> None:
    rows = "2, gps, 5.8, 45.2, 280, 514850400.5, 10\n1, gps, -5.8, -45.2, -2e2, 0, 0"
    (first, second) = read_dataset(write(tmp_path, {"records_gnss": rows})).gnss
    assert (first.timestamp, first.x, first.y, first.z) == (1, -5.8, -45.2, -200.0)
    assert (second.sensor_id, second.utc, second.dop) == ("gps", 514850400.5, 10.0)


@pytest.mark.parametrize("text", ["nan", "inf", "", "1e999", "north"])
def test_a_gnss_fix_that_is_no_number_is_refused(tmp_path: Path, text: str) -> None:
    error = refusal(write(tmp_path, {"records_gnss": f"1, gps, 5.8, {text}, 280, 0, 0"}))
    assert (error.code, error.field) == ("kapture.number", "sensors/records_gnss.txt:2")


# Poses


def test_a_pose_maps_the_world_to_the_device(tmp_path: Path) -> None:
    # A quarter turn about z: world x becomes device y.
    dataset = read_dataset(
        write(
            tmp_path,
            {"trajectories": "3, cam, 2, 0, 0, 2, 10, 20, 30", "records_camera": "3, cam, a.jpg"},
        )
    )
    cam_from_world = dataset.pose(dataset.images[0])
    assert cam_from_world is not None
    np.testing.assert_allclose(cam_from_world.apply(np.array([1.0, 0, 0])), [10, 21, 30])


def test_a_rig_pose_is_chained_and_the_own_pose_preferred(tmp_path: Path) -> None:
    dataset = read_dataset(
        write(
            tmp_path,
            {
                "rigs": "rig, cam, 1, 0, 0, 0, 1, 0, 0",
                "trajectories": "1, rig, 1, 0, 0, 0, 0, 5, 0\n2, rig, 1, 0, 0, 0, 0, 5, 0\n"
                "2, cam, 1, 0, 0, 0, 0, 0, 7",
                "records_camera": "1, cam, a.jpg\n2, cam, b.jpg\n3, cam, c.jpg",
            },
        )
    )
    poses = [dataset.pose(image) for image in dataset.images]
    assert [None if pose is None else pose.translation.tolist() for pose in poses] == [
        [1, 5, 0],
        [0, 0, 7],
        None,
    ]


@pytest.mark.parametrize(
    ("name", "ids"),
    [("trajectories", "1, cam"), ("rigs", "rig, cam")],
    ids=lambda value: str(value),
)
@pytest.mark.parametrize(
    ("fields", "code"),
    [
        ("0, 0, 0, 0, 0, 0, 0", "pose.rotation"),
        ("1e-7, 0, 0, 0, 0, 0, 0", "pose.rotation"),
        ("nan, 0, 0, 1, 0, 0, 0", "kapture.number"),
        ("1, 0, 0, 0, 0, inf, 0", "kapture.number"),
        ("nan, , , , 0, 0, 0", "kapture.number"),
        ("1, 0, 0, 0, 0, 0, eval", "kapture.number"),
    ],
)
def test_a_pose_that_cannot_be_is_refused(
    tmp_path: Path, name: str, ids: str, fields: str, code: str
) -> None:
    error = refusal(write(tmp_path, {name: f"{ids}, {fields}"}))
    assert (error.code, error.field) == (code, f"sensors/{name}.txt:2")


@pytest.mark.parametrize("fields", [", , , , , , ", ", , , , 1, 2, 3", "1, 0, 0, 0, 1, , 3"])
def test_an_incomplete_pose_is_unknown_and_told(tmp_path: Path, fields: str) -> None:
    dataset = read_dataset(
        write(
            tmp_path,
            {
                "trajectories": f"1, rig, {IDENTITY}\n1, cam, {fields}",
                "rigs": f"rig, cam, {fields}",
                "records_camera": "1, cam, a.jpg",
            },
        )
    )
    assert dataset.rigs == {"rig": {"cam": None}}
    assert list(dataset.trajectories) == [(1, "rig")]
    assert dataset.pose(dataset.images[0]) is None
    told = [text.split(":")[0] for text in dataset.notes]
    assert told == ["sensors/rigs.txt", "sensors/trajectories.txt", "sensors/records_camera.txt"]


def test_poses_of_unknown_devices_are_left_out_with_a_note(tmp_path: Path) -> None:
    dataset = read_dataset(
        write(tmp_path, {"trajectories": f"1, ghost, {IDENTITY}\n2, ghost, {IDENTITY}"})
    )
    assert dataset.trajectories == {}
    assert note(dataset) == (
        "sensors/trajectories.txt: 2 poses of unknown devices were left out"
        " (first in line 2: ghost)"
    )


# Rigs


def translations(rig: Mapping[str, Pose | None]) -> dict[str, list[float] | None]:
    return {key: None if p is None else p.translation.tolist() for key, p in rig.items()}


def test_nested_rigs_are_unrolled_in_any_order(tmp_path: Path) -> None:
    # outer -> inner turns a quarter about z; then inner -> cam shifts along x.
    rows = (
        "outer, inner, 1, 0, 0, 1, 0, 0, 2\nouter, ir, , , , , , , \n"
        "inner, cam, 1, 0, 0, 0, 1, 0, 0\ninner, ir2, , , , , , , "
    )
    sensors = SENSORS + "ir2, , depth, UNKNOWN_CAMERA, 1, 1\n"
    dataset = read_dataset(write(tmp_path, {"sensors": sensors, "rigs": rows}))

    assert list(dataset.rigs) == ["outer", "inner"]
    assert translations(dataset.rigs["inner"]) == {"cam": [1, 0, 0], "ir2": None}
    assert translations(dataset.rigs["outer"]) == {"cam": [1, 0, 2], "ir2": None, "ir": None}
    cam_from_outer = dataset.rigs["outer"]["cam"]
    assert cam_from_outer is not None
    np.testing.assert_allclose(cam_from_outer.apply(np.array([1.0, 0, 0])), [1, 1, 2], atol=1e-15)


def test_members_that_are_no_sensors_are_left_out_with_a_note(tmp_path: Path) -> None:
    dataset = read_dataset(
        write(tmp_path, {"rigs": f"rig, cam, {IDENTITY}\nrig, lost, {IDENTITY}\n"})
    )
    assert list(dataset.rigs["rig"]) == ["cam"]
    assert "1 members that sensors.txt does not have were left out (first in line 3: lost)" in note(
        dataset
    )


def test_a_rig_with_the_id_of_a_sensor_is_refused(tmp_path: Path) -> None:
    error = refusal(write(tmp_path, {"rigs": f"cam, ir, {IDENTITY}"}))
    assert (error.code, error.field) == ("kapture.rig_is_sensor", "sensors/rigs.txt:2")


@pytest.mark.parametrize(
    "pairs",
    [["a a"], ["a b", "b a"], ["a cam", "a b", "b c", "c d", "d b"]],
)
def test_a_rig_that_contains_itself_is_refused(tmp_path: Path, pairs: list[str]) -> None:
    rows = "\n".join(f"{pair.replace(' ', ', ')}, {IDENTITY}" for pair in pairs)
    error = refusal(write(tmp_path, {"rigs": rows}))
    assert (error.code, error.field) == ("kapture.rig_cycle", "sensors/rigs.txt")


@pytest.mark.parametrize("levels", [10, 11, 5000])
def test_rigs_nest_ten_levels_deep(tmp_path: Path, levels: int) -> None:
    rows = [f"r{i}, r{i + 1}, {IDENTITY}" for i in range(1, levels)]
    write(tmp_path, {"rigs": "\n".join([*rows, f"r{levels}, cam, {IDENTITY}"])})
    if levels <= 10:
        assert list(read_dataset(tmp_path).rigs["r1"]) == ["cam"]
    else:
        assert refusal(tmp_path).code == "kapture.rig_depth"


def test_a_sensor_that_comes_twice_into_a_rig_is_refused(tmp_path: Path) -> None:
    rows = [f"{pair}, {IDENTITY}" for pair in ("a, cam", "a, b", "b, cam")]
    error = refusal(write(tmp_path, {"rigs": "\n".join(rows)}))
    assert (error.code, error.got) == ("kapture.duplicate", "'cam' in 'a'")


def test_ten_thousand_posed_images_are_read(tmp_path: Path) -> None:
    count = 10_000
    write(
        tmp_path,
        {
            "rigs": f"rig, cam, {IDENTITY}",
            "trajectories": "\n".join(f"{i}, rig, {IDENTITY}" for i in range(count)),
            "records_camera": "\n".join(f"{i}, cam, seq/{i:06d}.jpg" for i in range(count)),
        },
    )
    dataset = read_dataset(tmp_path)
    assert all(dataset.pose(image) is not None for image in dataset.images)
    assert len(dataset.images) == count


@pytest.mark.parametrize("name", ["sensors", "rigs", "trajectories", "records_camera"])
@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_what_is_no_plain_file_is_refused_and_not_waited_for(
    tmp_path: Path, name: str, kind: str
) -> None:
    root = write(tmp_path, {"rigs": "", "trajectories": "", "records_camera": ""})
    path = root / "sensors" / f"{name}.txt"
    path.unlink()
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")  # one line without an end
    else:
        path.mkdir()
    error = refusal(root)
    assert (error.code, error.field) == ("kapture.unreadable", f"sensors/{name}.txt")


@pytest.mark.parametrize(
    ("own", "far"),
    [
        ("", None),
        ("1, cam, 1, 0, 0, 0, 1, 2, 3", None),
        ("1, cam, 1, 0, 0, 0, 1.00001, 2, 3", None),  # as it is written with few digits
        ("1, cam, 1, 0, 0, 0, 101, 2, 3", "100 units"),
        ("1, cam, 0.999, 0.04, 0, 0, 1, 2, 3", "0.289 units"),
    ],
)
def test_poses_of_photos_that_contradict_their_rig_are_named(
    tmp_path: Path, own: str, far: str | None
) -> None:
    sensors = "cam, , camera, PINHOLE, 64, 48, 50, 50, 32, 24"
    files = {
        "sensors": sensors,
        "rigs": "rig, cam, 1, 0, 0, 0, 1, 0, 0",
        "records_camera": "1, cam, a.jpg\n2, cam, b.jpg",
        "trajectories": f"1, rig, 1, 0, 0, 0, 0, 2, 3\n2, rig, 1, 0, 0, 0, 4, 0, 0\n"
        f"2, cam, 1, 0, 0, 0, 5, 0, 0\n{own}\n",
    }
    notes = [note for note in read_dataset(write(tmp_path, files)).notes if "rig" in note]
    assert len(notes) == (far is not None)
    assert all("a.jpg is" in note and str(far) in note for note in notes)
