from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mapping.maps.export import export_map
from visloc.archive import Map
from visloc.errors import Conflict, DatasetError, InvalidInput, TooLarge
from visloc.geometry import Camera, Pose, rotation_angle
from visloc.kapture import Dataset, FileRecord, Sensor, read_dataset, write_dataset
from visloc_extensions.rig_calibration.calibration import (
    MAX_CAMERAS,
    MIN_INSTANTS,
    RigCalibration,
    calibrate_rig,
    write_calibration,
)

CAMERA = Camera("PINHOLE", 64, 48, (50.0, 50.0, 32.0, 24.0))
# Of three cameras the first is the frame.
RIG = {
    "front": Pose.identity(),
    "left": Pose(Rotation.from_euler("y", 60, degrees=True).as_matrix(), np.array([0.3, 0.0, 0.1])),
    "rear": Pose(
        Rotation.from_euler("yx", [175, 4], degrees=True).as_matrix(), np.array([-0.2, 0.1, 1.4])
    ),
}
START = 1_700_000_000_000_000_000  # nanoseconds
# Where coordinates of maps that count from the equator lie.
FAR_OFF = np.array([500_000.0, 5_000_000.0, 200.0])


def noisy(pose: Pose, rng: np.random.Generator, sigma_deg: float, sigma: float) -> Pose:
    turn = Rotation.from_rotvec(rng.normal(0, np.radians(sigma_deg), 3)).as_matrix()
    rotation = turn @ pose.rotation
    return Pose(rotation, -rotation @ (pose.center + rng.normal(0, sigma, 3)))


def make_drive(
    rig: Mapping[str, Pose] = RIG,
    *,
    instants: int = 60,
    sigma_deg: float = 0.0,
    sigma: float = 0.0,
    wrong: float = 0.0,
    seed: int = 0,
    start: NDArray[np.float64] = FAR_OFF,
) -> Dataset:
    """A rig on a winding road, of which only the poses of single photos are known.

    At a share of ``wrong`` instants, all cameras but the first are anywhere.
    """
    rng = np.random.default_rng(seed)
    strays = set(rng.permutation(instants)[: round(wrong * instants)].tolist())
    poses, images = {}, []
    for number in range(instants):
        heading = Rotation.from_euler("yz", [3.0 * number, np.sin(number)], degrees=True)
        center = start + np.array([0.8 * number, 5 * np.sin(number / 8), 0.05 * rng.normal()])
        matrix = heading.as_matrix()
        rig_from_world = Pose(matrix, -matrix @ center)
        for row, (name, cam_from_rig) in enumerate(rig.items()):
            pose = noisy(cam_from_rig @ rig_from_world, rng, sigma_deg, sigma)
            if number in strays and row:
                pose = noisy(pose, rng, 60.0, 5.0)
            poses[START + number, name] = pose
            images.append(FileRecord(START + number, name, f"{name}/{number}.jpg"))
    sensors = {name: Sensor.with_camera(name, CAMERA) for name in rig}
    return Dataset(Path("drive"), sensors, {}, poses, tuple(images), (), ())


def per_camera(
    dataset: Dataset, rng: np.random.Generator, sigma_deg: float, sigma: float, wrong: float
) -> Dataset:
    """The dataset with poses of photos instead of its rig's."""
    stamps = sorted({record.timestamp for record in dataset.images})
    strays = set(rng.permutation(stamps)[: round(wrong * len(stamps))].tolist())
    poses = {}
    for record in (*dataset.images, *dataset.depth_maps):
        pose = dataset.pose(record)
        assert pose is not None
        pose = noisy(pose, rng, sigma_deg, sigma)
        if record.sensor_id == "right" and record.timestamp in strays:
            pose = noisy(pose, rng, 60.0, 5.0)
        poses[record.timestamp, record.sensor_id] = pose
    return replace(dataset, rigs={}, trajectories=poses)


def without(dataset: Dataset, dropped: Callable[[FileRecord], bool]) -> Dataset:
    return replace(
        dataset, images=tuple(record for record in dataset.images if not dropped(record))
    )


def number_of(record: FileRecord) -> int:
    return record.timestamp - START


def errors_of(
    calibration: RigCalibration, truth: Mapping[str, Pose]
) -> Mapping[str, tuple[float, float]]:
    """Degrees and units by camera, but for the reference."""
    rig_from_reference = truth[calibration.reference].inverse()
    errors = {}
    for name, one in calibration.cameras.items():
        if name != calibration.reference:
            true = truth[name] @ rig_from_reference
            turn = rotation_angle(one.cam_from_rig.rotation @ true.rotation.T)
            shift = np.linalg.norm(one.cam_from_rig.center - true.center)
            errors[name] = float(np.degrees(turn)), float(shift)
    return errors


def test_exact_poses_give_the_rig_to_round_off() -> None:
    found = calibrate_rig(make_drive(start=np.zeros(3)))
    assert (found.rig, found.reference, found.notes) == ("rig", "front", ())
    assert list(found.cameras) == ["front", "left", "rear"]
    front = found.cameras["front"]
    assert front.relative is None
    np.testing.assert_array_equal(front.cam_from_rig.rotation, np.eye(3))
    np.testing.assert_array_equal(front.cam_from_rig.translation, np.zeros(3))
    for degrees, units in errors_of(found, RIG).values():
        assert degrees < 1e-12
        assert units < 1e-12
    for name in ("left", "rear"):
        relative = found.cameras[name].relative
        assert relative is not None
        assert (relative.instants, relative.outliers) == (60, 0)
        assert relative.rotation_deg.p90 < 1e-6
        assert relative.position.p90 < 1e-12


def test_round_off_of_large_coordinates_is_no_outlier() -> None:
    found = calibrate_rig(make_drive())
    relative = found.cameras["rear"].relative
    assert relative is not None
    assert relative.outliers == 0
    assert errors_of(found, RIG)["rear"][1] < 1e-8


def test_noise_averages_out_and_is_reported() -> None:
    found = calibrate_rig(make_drive(instants=400, sigma_deg=0.2, sigma=0.05))
    for degrees, units in errors_of(found, RIG).values():
        # Two cameras' noise along three axes, over 20, the root of 400.
        assert degrees < 3 * 0.2 * 6**0.5 / 20
        assert units < 3 * 0.05 * 6**0.5 / 20
    relative = found.cameras["left"].relative
    assert relative is not None
    # The median of the length of a normal vector is 1.54 standard deviations, the 90 % is 2.5.
    assert relative.rotation_deg.median == pytest.approx(1.54 * 0.2 * 2**0.5, rel=0.15)
    assert relative.rotation_deg.p90 == pytest.approx(2.5 * 0.2 * 2**0.5, rel=0.15)
    assert relative.position.median == pytest.approx(1.54 * 0.05 * 2**0.5, rel=0.15)
    assert relative.outliers <= 4


@pytest.mark.parametrize("seed", range(5))
def test_a_fifth_of_wrong_instants_hardly_moves_the_estimate(seed: int) -> None:
    noise = {"instants": 200, "sigma_deg": 0.2, "sigma": 0.05, "seed": seed}
    found = calibrate_rig(make_drive(**noise, wrong=0.2))  # type: ignore[arg-type]
    for degrees, units in errors_of(found, RIG).values():
        assert degrees < 0.1
        assert units < 0.025
    for name in ("left", "rear"):
        relative = found.cameras[name].relative
        assert relative is not None
        assert 40 <= relative.outliers <= 44


def test_a_camera_that_never_meets_the_reference_is_connected_through_another() -> None:
    drive = without(
        make_drive(),
        lambda record: (
            (record.sensor_id == "front" and number_of(record) >= 30)
            or (record.sensor_id == "rear" and number_of(record) < 30)
        ),
    )
    found = calibrate_rig(drive)
    assert found.reference == "left"  # it shares instants with both
    found = calibrate_rig(drive, reference="front", rig="car")
    assert {name: one.relative_to for name, one in found.cameras.items()} == {
        "front": None,
        "left": "front",
        "rear": "left",
    }
    assert max(max(errors) for errors in errors_of(found, RIG).values()) < 1e-7
    # Neither is compared over fewer instants than it can be.
    assert all(
        one.relative is None or one.relative.instants == 30 for one in found.cameras.values()
    )


def test_a_chain_of_many_instants_is_better_than_one_link_of_few() -> None:
    drive = without(
        make_drive(),
        lambda record: record.sensor_id == "rear" and number_of(record) % 2 == 0,
    )
    few = without(drive, lambda record: record.sensor_id == "front" and number_of(record) % 2 == 1)
    assert calibrate_rig(drive, reference="front").cameras["rear"].relative_to == "front"
    kept = {START + number for number in (1, 3, 5, 7)}
    some = replace(
        few,
        images=(
            *few.images,
            *(r for r in drive.images if r.sensor_id == "front" and r.timestamp in kept),
        ),
    )
    assert calibrate_rig(some, reference="front").cameras["rear"].relative_to == "left"


def test_cameras_that_cannot_be_connected_are_named_with_their_instants() -> None:
    drive = without(
        make_drive(),
        lambda record: record.sensor_id == "rear" and number_of(record) >= MIN_INSTANTS - 1,
    )
    with pytest.raises(DatasetError, match=r"rear; leave them out with --cameras.*rear: 2") as e:
        calibrate_rig(drive)
    assert e.value.code == "rig.unconnected"
    assert list(calibrate_rig(drive, cameras=["left", "front"]).cameras) == ["front", "left"]


def test_cameras_of_different_instants_share_none() -> None:
    drive = make_drive()
    shifted = tuple(
        replace(record, timestamp=record.timestamp + 1000 * (record.sensor_id == "left"))
        for record in drive.images
    )
    poses = {
        (stamp + 1000 * (name == "left"), name): p
        for (stamp, name), p in drive.trajectories.items()
    }
    with pytest.raises(DatasetError, match="left: 0") as caught:
        calibrate_rig(replace(drive, images=shifted, trajectories=poses))
    assert caught.value.code == "rig.unconnected"


def test_photos_without_poses_do_not_count() -> None:
    drive = make_drive()
    with pytest.raises(DatasetError, match=r"front, .*expected 3 such instants") as caught:
        calibrate_rig(replace(drive, trajectories={}), reference="left")
    assert caught.value.code == "rig.unconnected"


@pytest.mark.parametrize("moves", ["both", "turns", "lags"])
def test_cameras_that_are_no_rig_are_refused(moves: str) -> None:
    drive, rng = make_drive(start=np.zeros(3)), np.random.default_rng(1)
    poses = dict(drive.trajectories)
    for (stamp, name), pose in drive.trajectories.items():
        if name == "rear":
            if moves == "both":  # on its own
                poses[stamp, name] = noisy(pose, rng, 90.0, 10.0)
            elif moves == "turns":  # at the same place
                poses[stamp, name] = noisy(pose, rng, 10.0, 0.0)
            else:  # from none to four instants behind
                late = max(START, stamp - int(rng.integers(5)))
                poses[stamp, name] = drive.trajectories[late, name]
    with pytest.raises(DatasetError, match="'front' and 'rear' move relative") as caught:
        calibrate_rig(replace(drive, trajectories=poses))
    assert caught.value.code == "rig.not_rigid"
    assert "5 degrees" in str(caught.value)


def test_numbers_too_large_to_compute_with_are_refused() -> None:
    drive = make_drive()
    huge = {
        key: Pose(pose.rotation, pose.translation * 1e200 if key[1] == "left" else pose.translation)
        for key, pose in drive.trajectories.items()
    }
    with pytest.raises(DatasetError) as caught:
        calibrate_rig(replace(drive, trajectories=huge))
    assert caught.value.code == "rig.not_rigid"


@pytest.mark.parametrize(
    ("settings", "code", "named"),
    [
        ({"rig": "left"}, "rig.id", "--rig"),
        ({"rig": ""}, "rig.id", "--rig"),
        ({"cameras": ["left", "roof"]}, "rig.cameras", "front, left, rear, got roof"),
        ({"cameras": ["left", "left"]}, "rig.cameras", "each named once"),
        ({"cameras": ["left"]}, "rig.cameras", "at least two cameras"),
        ({"cameras": []}, "rig.cameras", "got none"),
        ({"reference": "roof"}, "rig.reference", "one of front, left, rear, got roof"),
        (
            {"reference": "rear", "cameras": ["front", "left"]},
            "rig.reference",
            "one of front, left, got rear",
        ),
    ],
)
def test_a_wrong_setting_names_its_option(
    settings: dict[str, object], code: str, named: str
) -> None:
    with pytest.raises(InvalidInput, match=named) as caught:
        calibrate_rig(make_drive(instants=4), **settings)  # type: ignore[arg-type]
    assert caught.value.code == code


def test_a_dataset_where_each_photo_has_its_own_camera_is_refused_at_once() -> None:
    names = [f"cam{number}" for number in range(MAX_CAMERAS + 1)]
    with pytest.raises(TooLarge, match=r"--cameras.*at most 64, got 65"):
        calibrate_rig(make_drive(dict.fromkeys(names, Pose.identity()), instants=1))


def test_only_cameras_are_on_the_rig() -> None:
    drive = make_drive()
    sensors = {**drive.sensors, "lidar": Sensor("lidar", "", "lidar", (), None)}
    assert "lidar" not in calibrate_rig(replace(drive, sensors=sensors)).cameras


def test_a_written_rig_comes_back_and_is_not_overwritten(tmp_path: Path) -> None:
    drive = replace(make_drive(), root=tmp_path)
    write_dataset(drive)
    found = calibrate_rig(read_dataset(tmp_path), rig="car")
    output = tmp_path / "sensors" / "rigs.txt"
    write_calibration(found, output)
    text = output.read_text()
    assert text.startswith("# kapture format: 1.1\n# rig_id, sensor_id, qw, qx, qy, qz, tx, ty, tz")

    again = read_dataset(tmp_path)
    assert list(again.rigs) == ["car"]
    for name, one in found.cameras.items():
        pose = again.rigs["car"][name]
        assert pose is not None
        np.testing.assert_allclose(pose.rotation, one.cam_from_rig.rotation, atol=1e-15)
        np.testing.assert_array_equal(pose.translation, one.cam_from_rig.translation)
    # The photos' own poses are still theirs.
    assert calibrate_rig(again, rig="car").notes == ()

    with pytest.raises(Conflict, match="--output") as caught:
        write_calibration(found, output)
    assert caught.value.code == "rig.exists"
    assert output.read_text() == text


def test_poses_that_come_from_a_known_rig_are_told() -> None:
    drive = make_drive()
    front = {key: pose for key, pose in drive.trajectories.items() if key[1] == "front"}
    carried = {(stamp, "known"): pose for (stamp, _), pose in front.items()}
    found = calibrate_rig(replace(drive, rigs={"known": RIG}, trajectories=carried))
    assert found.notes == (
        "180 of 180 poses are those of a rig that the dataset knows, so they repeat what its "
        "rigs.txt says",
    )
    assert max(max(errors) for errors in errors_of(found, RIG).values()) < 1e-7


# On datasets


def stereo_truth(dataset: Dataset) -> dict[str, Pose]:
    (members,) = dataset.rigs.values()
    poses = {name: members[name] for name in ("left", "right")}
    assert all(poses.values())
    return poses  # type: ignore[return-value]


def test_the_rig_of_the_sample_is_found(sample: Path) -> None:
    dataset = read_dataset(sample / "mapping")
    exact = per_camera(dataset, np.random.default_rng(0), 0.0, 0.0, 0.0)
    found = calibrate_rig(exact)
    assert found.reference == "left"
    degrees, units = errors_of(found, stereo_truth(dataset))["right"]
    assert degrees < 1e-10
    assert units < 1e-10
    assert np.linalg.norm(found.cameras["right"].cam_from_rig.center) == pytest.approx(
        0.2, abs=1e-3
    )


@pytest.mark.parametrize(
    ("sigma_deg", "sigma", "wrong", "max_deg", "max_units"),
    [(0.0, 0.0, 0.0, 1e-9, 1e-9), (0.05, 0.02, 0.0, 0.06, 0.02), (0.05, 0.02, 0.2, 0.07, 0.025)],
)
def test_the_baseline_of_a_car_is_found(
    shared_data: Path,
    sigma_deg: float,
    sigma: float,
    wrong: float,
    max_deg: float,
    max_units: float,
) -> None:
    dataset = read_dataset(shared_data / "kitti_curve" / "mapping")
    rng = np.random.default_rng(3)
    found = calibrate_rig(per_camera(dataset, rng, sigma_deg, sigma, wrong))
    degrees, units = errors_of(found, stereo_truth(dataset))["right"]
    assert degrees < max_deg
    assert units < max_units
    right = found.cameras["right"]
    assert right.cam_from_rig.center[0] == pytest.approx(0.5372, abs=max_units + 1e-4)
    assert right.relative is not None
    assert (right.relative.instants, right.relative.outliers) == (26, round(wrong * 26))


@pytest.mark.parametrize("method", ["rgbd", "sfm"])
def test_a_build_registers_the_rig_that_was_estimated(
    walk_copy: Path,
    tmp_path: Path,
    build_walk: Callable[..., Map],
    rewrite: Callable[..., None],
    method: str,
) -> None:
    known = read_dataset(walk_copy)
    alone = per_camera(known, np.random.default_rng(0), 0.0, 0.0, 0.0)
    rewrite(walk_copy, rigs={}, trajectories=alone.trajectories)
    found = calibrate_rig(read_dataset(walk_copy), rig="car")
    write_calibration(found, walk_copy / "sensors" / "rigs.txt")

    rigs = build_walk(walk_copy, tmp_path / "maps", method=method).rigs

    assert {rig: sorted(members) for rig, members in rigs.items()} == {"car": ["left", "right"]}
    truth = stereo_truth(known)
    expected = truth["right"] @ truth["left"].inverse()
    np.testing.assert_allclose(rigs["car"]["right"].translation, expected.translation, atol=1e-9)
    np.testing.assert_allclose(rigs["car"]["right"].rotation, expected.rotation, atol=1e-9)


def test_a_map_of_a_reconstruction_registers_rigs_too(
    sfm_walk: Map, tmp_path: Path, build_walk: Callable[..., Map]
) -> None:
    export_map(sfm_walk, tmp_path / "dataset", "kapture")
    (tmp_path / "dataset" / "sensors" / "rigs.txt").unlink()
    found = calibrate_rig(read_dataset(tmp_path / "dataset"), rig="car")
    write_calibration(found, tmp_path / "dataset" / "sensors" / "rigs.txt")
    built = build_walk(
        tmp_path / "dataset",
        tmp_path / "maps",
        method="model",
        metric=True,
        local_features="kapture:sift",
    )
    expected = sfm_walk.rigs["rig"]["right"] @ sfm_walk.rigs["rig"]["left"].inverse()
    np.testing.assert_allclose(
        built.rigs["car"]["right"].translation, expected.translation, atol=1e-6
    )
