from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from visloc.errors import Conflict, DatasetError
from visloc.geometry import CAMERA_MODELS, Camera, Pose
from visloc.kapture import (
    Dataset,
    FileRecord,
    GnssRecord,
    Sensor,
    read_dataset,
    write_dataset,
)

CAMERA = Camera("PINHOLE", 640, 480, (500.0, 510.25, 320.0, 240.0))


def small_dataset(root: Path) -> Dataset:
    return Dataset(
        root=root,
        sensors={
            "cam": Sensor.with_camera("cam", CAMERA, name="front"),
            "ir": Sensor.with_camera("ir", CAMERA, kind="depth"),
            "gps": Sensor("gps", "", "gnss", ("EPSG:4326",), None),
        },
        rigs={"rig": {"cam": Pose.identity(), "ir": None}},
        trajectories={(5, "rig"): Pose.from_quaternion([1, 0, 0, 1], [0.1, -2.0, 3.0])},
        images=(FileRecord(5, "cam", "a/b.jpg"),),
        depth_maps=(FileRecord(5, "ir", "a/b.depth"),),
        gnss=(GnssRecord(5, "gps", 13.4, 52.5, 30.0, 0.0, 5.0),),
    )


def test_the_files_look_like_those_of_other_tools(tmp_path: Path) -> None:
    write_dataset(small_dataset(tmp_path))

    folder = tmp_path / "sensors"
    assert (folder / "sensors.txt").read_text() == (
        "# kapture format: 1.1\n"
        "# sensor_id, name, sensor_type, [sensor_params]+\n"
        "cam, front, camera, PINHOLE, 640, 480, 500, 510.25, 320, 240\n"
        "ir, , depth, PINHOLE, 640, 480, 500, 510.25, 320, 240\n"
        "gps, , gnss, EPSG:4326\n"
    )
    assert (folder / "rigs.txt").read_text().splitlines()[1:] == [
        "# rig_id, sensor_id, qw, qx, qy, qz, tx, ty, tz",
        "rig, cam,  1.0,  0.0,  0.0,  0.0,  0.0,  0.0,  0.0",
        "rig, ir" + ",     " * 7,
    ]
    assert (folder / "records_camera.txt").read_text().splitlines()[1:] == [
        "# timestamp, device_id, image_path",
        "       5, cam, a/b.jpg",
    ]
    assert sorted(path.name for path in folder.iterdir()) == [
        "records_camera.txt",
        "records_depth.txt",
        "records_gnss.txt",
        "rigs.txt",
        "sensors.txt",
        "trajectories.txt",
    ]


def test_files_without_content_are_not_written(tmp_path: Path) -> None:
    write_dataset(Dataset(tmp_path, {}, {}, {}, (), (), ()))
    assert [path.name for path in (tmp_path / "sensors").iterdir()] == ["sensors.txt"]
    assert read_dataset(tmp_path).sensors == {}


@pytest.mark.parametrize("name", ["sensors.txt", "trajectories.txt"])
def test_a_dataset_is_not_overwritten(tmp_path: Path, name: str) -> None:
    (tmp_path / "sensors").mkdir()
    (tmp_path / "sensors" / name).write_text("precious")
    with pytest.raises(Conflict) as caught:
        write_dataset(small_dataset(tmp_path))
    assert caught.value.code == "kapture.exists"
    assert [path.read_text() for path in (tmp_path / "sensors").iterdir()] == ["precious"]


@pytest.mark.parametrize("text", ["a,b", " a", "a\n", "a\rb", "\ta", "a\0", "\ud800", "# a", ""])
def test_an_id_that_would_not_come_back_is_refused(tmp_path: Path, text: str) -> None:
    dataset = replace(small_dataset(tmp_path), sensors={text: Sensor(text, "", "wifi", (), None)})
    with pytest.raises(DatasetError) as caught:
        write_dataset(dataset)
    assert caught.value.code == "kapture.field"
    assert not (tmp_path / "sensors").exists()


@pytest.mark.parametrize("path", ["../a.jpg", "/a.jpg", "a,b.jpg", "a//b.jpg", "./a.jpg", "", " a"])
def test_a_path_that_would_not_come_back_is_refused(tmp_path: Path, path: str) -> None:
    dataset = replace(small_dataset(tmp_path), images=(FileRecord(1, "cam", path),))
    with pytest.raises(DatasetError) as caught:
        write_dataset(dataset)
    assert caught.value.code == "kapture.field"


# Round trips

ids = st.text(
    st.characters(exclude_categories=("Cc", "Cs"), exclude_characters=","), min_size=1, max_size=12
).filter(lambda text: text == text.strip() and text[0] != "#")
finite = st.floats(allow_nan=False, allow_infinity=False, width=64)
moderate = st.floats(-1e12, 1e12)
quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 1e-3)
poses = st.builds(Pose.from_quaternion, quaternions, st.tuples(moderate, moderate, moderate))
timestamps = st.integers(-(2**63), 2**63 - 1)


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    model = draw(st.sampled_from(sorted(CAMERA_MODELS)))
    params = [
        draw(st.floats(1e-6, 1e9) if name in ("f", "fx", "fy") else finite)
        for name in CAMERA_MODELS[model]
    ]
    size = st.integers(1, 100_000)
    return Camera(model, draw(size), draw(size), tuple(params))


@st.composite
def datasets(draw: st.DrawFn) -> Dataset:
    names = draw(st.lists(ids, min_size=4, max_size=4, unique=True))
    cam, ir, gps, rig = names
    stamps = draw(st.lists(timestamps, max_size=4, unique=True))
    stamps.sort()
    return Dataset(
        root=Path("unset"),
        sensors={
            cam: Sensor.with_camera(cam, draw(cameras())),
            ir: Sensor.with_camera(ir, draw(cameras()), kind="depth"),
            gps: Sensor(gps, "name", "gnss", (), None),
        },
        rigs={rig: {cam: draw(st.none() | poses), ir: draw(st.none() | poses)}},
        trajectories={(t, draw(st.sampled_from([cam, rig]))): draw(poses) for t in stamps},
        images=tuple(FileRecord(t, cam, f"é/{i}.jpg") for i, t in enumerate(stamps)),
        depth_maps=tuple(FileRecord(t, ir, f"{i}") for i, t in enumerate(stamps)),
        gnss=tuple(GnssRecord(t, gps, *(draw(finite) for _ in range(5))) for t in stamps),
    )


def assert_same_pose(read: Pose | None, written: Pose | None) -> None:
    if written is None or read is None:
        assert read is written
    else:
        assert read.translation.tolist() == written.translation.tolist()
        # The rotation goes through a quaternion: rounding, no more.
        np.testing.assert_allclose(read.rotation, written.rotation, rtol=0, atol=2e-15)


@settings(max_examples=60, deadline=None)
@given(dataset=datasets())
def test_what_is_written_is_read_again(dataset: Dataset) -> None:
    with TemporaryDirectory() as folder:
        dataset = replace(dataset, root=Path(folder))
        write_dataset(dataset)
        read = read_dataset(Path(folder))

    assert read.sensors == dataset.sensors
    assert (read.images, read.depth_maps) == (dataset.images, dataset.depth_maps)
    assert read.gnss == dataset.gnss
    assert list(read.rigs) == list(dataset.rigs)
    for rig_id, members in dataset.rigs.items():
        assert list(read.rigs[rig_id]) == list(members)
        for sensor_id, pose in members.items():
            assert_same_pose(read.rigs[rig_id][sensor_id], pose)
    assert read.trajectories.keys() == dataset.trajectories.keys()
    for key, pose in dataset.trajectories.items():
        assert_same_pose(read.trajectories[key], pose)


@settings(max_examples=60, deadline=None)
@given(
    content=st.lists(
        st.sampled_from(
            ["cam", "rig", "1", "-1", "nan", "", "1e400", "camera", "PINHOLE", "../x", "\0", "é"]
        )
        | st.text(max_size=6),
        max_size=40,
    ),
    name=st.sampled_from(["sensors", "rigs", "trajectories", "records_camera", "records_gnss"]),
    separator=st.sampled_from([", ", "\n"]),
)
def test_hostile_text_is_read_or_refused_and_nothing_else(
    content: list[str], name: str, separator: str
) -> None:
    with TemporaryDirectory() as folder:
        write_dataset(small_dataset(Path(folder)))
        text = "# kapture format: 1.1\n" + separator.join(content)
        path = Path(folder) / "sensors" / f"{name}.txt"
        path.write_bytes(text.encode("utf-8", errors="surrogatepass"))
        try:
            read_dataset(Path(folder))
            field = "sensors/"
        except DatasetError as error:
            field = str(error.field)
    assert field.startswith("sensors/")


WIFI = """# kapture format: 1.1
# timestamp, device_id, BSSID, frequency, RSSI, SSID, scan_time_start, scan_time_end
5, phone, 68:72:51:80:52:df, 5785, -33, M1X_PicoM2, 1555398770280, 1555398770290
5, phone, 68:9c:e2:e1:b0:60, 5765, -49, , 0, 0
6, phone, 00:00:00:00:00:01, 2412, -71.5, Café, the 2nd, 0, 0
"""


def test_records_of_other_sensors_are_written_as_they_were_read(tmp_path: Path) -> None:
    one, other = tmp_path / "one", tmp_path / "other"
    write_dataset(small_dataset(one))
    (one / "sensors/records_wifi.txt").write_text(WIFI, encoding="utf-8")
    pressure = "# kapture format: 1.1\n# timestamp, device_id\n7, phone, 1013.25, 0.5\n"
    (one / "sensors/records_pressure.txt").write_text(pressure)

    read = read_dataset(one)
    write_dataset(replace(read, root=other))

    assert read.other_records.keys() == {"records_wifi.txt", "records_pressure.txt"}
    assert read.other_records["records_pressure.txt"] == (("7", "phone", "1013.25", "0.5"),)
    assert read_dataset(other).other_records == read.other_records
    rows = (other / "sensors/records_wifi.txt").read_text(encoding="utf-8").splitlines()
    assert [", ".join(map(str.strip, row.split(","))) for row in rows] == WIFI.splitlines()
    assert read.without_records().other_records == {}


@pytest.mark.parametrize(
    ("row", "code"), [("5, phone", "kapture.column_count"), ("x, phone, 1", "kapture.timestamp")]
)
def test_a_row_of_another_sensor_without_a_time_or_a_value_is_refused(
    tmp_path: Path, row: str, code: str
) -> None:
    write_dataset(small_dataset(tmp_path))
    (tmp_path / "sensors/records_magnetic.txt").write_text(row + "\n")
    with pytest.raises(DatasetError) as caught:
        read_dataset(tmp_path)
    assert caught.value.code == code
    assert caught.value.field == "sensors/records_magnetic.txt:1"
