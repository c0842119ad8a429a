from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from visloc.errors import DatasetError
from visloc.geometry import Pose
from visloc_extensions.importers.nvm import read
from visloc_extensions.importers.tracks import reprojection_errors

SIZE = (640, 480)
FOCAL = 500.0
AACHEN = ("1045", "4446", "1135")


def blank(path: Path, size: tuple[int, int] = SIZE) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("L", size).save(path)


def poses() -> list[Pose]:
    made = []
    for angle, x in ((0.0, 0.0), (0.1, 0.4), (-0.15, -0.5)):
        rotation = Pose.from_quaternion(
            [math.cos(angle / 2), 0.02, math.sin(angle / 2), -0.01], np.zeros(3)
        ).rotation
        made.append(Pose(rotation, -rotation @ np.array([x, 0.1, -0.2])))
    return made


def measured_radius(ideal: float, k: float) -> float:
    """Solve ideal = r (1 + k r^2) for r: VisualSFM corrects measurements to ideal positions."""
    r = ideal
    for _ in range(100):
        r -= (r * (1 + k * r * r) - ideal) / (1 + 3 * k * r * r)
    return r


def measure(pose: Pose, point: NDArray[np.float64], k: float) -> NDArray[np.float64]:
    """Return where a point is seen, from the centre of the image, in pixels."""
    x, y, z = pose.apply(point)
    ideal = math.hypot(x / z, y / z)
    scale = measured_radius(ideal, k) / ideal
    return np.array([x / z, y / z]) * scale * FOCAL


def scene_points() -> NDArray[np.float64]:
    grid = np.linspace(-1.0, 1.0, 7)
    return np.array([[1.1 * x, 0.8 * y, 4.0 + x * y] for x in grid for y in grid])


def camera_line(name: str, pose: Pose, k: float, *, matrix: bool = False) -> str:
    rotation = pose.rotation.reshape(-1) if matrix else pose.rotation_wxyz
    place = pose.translation if matrix else pose.center
    numbers = [FOCAL, *rotation, *place, k, 0]
    return name + "\t" + " ".join(repr(float(number)) for number in numbers)


def nvm_text(
    *,
    k: float = 0.0,
    origin: tuple[float, float] = (0.0, 0.0),
    names: tuple[str, ...] = ("a.jpg", "b.jpg", "c.jpg"),
    header: str = "NVM_V3",
) -> str:
    matrix = header.startswith("NVM_V3_R9T")
    lines = [header, "", str(len(names))]
    lines += [camera_line(n, p, k, matrix=matrix) for n, p in zip(names, poses(), strict=False)]
    points = scene_points()
    lines += ["", str(len(points))]
    for number, point in enumerate(points):
        seen = [measure(pose, point, k) + origin for pose, _ in zip(poses(), names, strict=False)]
        fields = [f"{i} {number} {x!r} {y!r}" for i, (x, y) in enumerate(map(_floats, seen))]
        place = " ".join(repr(float(value)) for value in point)
        lines.append(f"{place} 10 20 30 {len(fields)} " + " ".join(fields))
    return "\n".join([*lines, "", "0", ""])


def _floats(xy: NDArray[np.float64]) -> tuple[float, float]:
    return float(xy[0]), float(xy[1])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in "abc":
        blank(tmp_path / f"{name}.jpg")
    return tmp_path


def write(folder: Path, text: str) -> Path:
    path = folder / "model.nvm"
    path.write_text(text)
    return path


@pytest.mark.parametrize("k", [0.0, 0.1, -0.15])
def test_points_project_to_the_measurements_of_an_exact_model(folder: Path, k: float) -> None:
    model = read(write(folder, nvm_text(k=k)))

    errors = reprojection_errors(model)
    assert len(errors) == 3 * 49
    # The format's distortion is one of measurements: RADIAL can only be fitted to it.
    assert errors.max() < (1e-3 if k == 0 else 0.5)
    assert errors.mean() < 0.1
    assert model.points == pytest.approx(scene_points())
    assert model.colors[0].tolist() == [10, 20, 30]
    assert any("distorts measurements" in note for note in model.notes) == (k != 0)


def test_the_fit_of_the_distortion_is_stated(folder: Path) -> None:
    model = read(write(folder, nvm_text(k=0.1)))

    camera = model.sensors["camera_0"].camera
    assert camera is not None
    assert camera.model == "RADIAL"
    assert camera.params[3] == pytest.approx(-0.1, rel=0.05)
    assert any("px off within the photos" in note for note in model.notes)


def test_measurements_from_the_top_left_corner_are_recognized(folder: Path) -> None:
    model = read(write(folder, nvm_text(k=0.05, origin=(320.0, 240.0))))

    assert reprojection_errors(model).max() < 0.5
    assert any("count from the top-left corner" in note for note in model.notes)


def test_measurements_that_agree_with_no_origin_are_left_out(folder: Path) -> None:
    model = read(write(folder, nvm_text(origin=(1000.0, 900.0))))

    assert len(model.observations) == 0
    assert all(image.keypoints is None for image in model.images)
    assert len(model.points) == 49
    assert any("were left out" in note for note in model.notes)


def test_the_first_pixel_is_half_a_pixel_from_the_corner(folder: Path) -> None:
    model = read(write(folder, nvm_text()))

    camera = model.sensors["camera_0"].camera
    assert camera is not None
    assert camera.params == (FOCAL, FOCAL, 320.0, 240.0)  # the centre of the photo


def test_matrices_and_translations_are_read_as_well(folder: Path) -> None:
    model = read(write(folder, nvm_text(header="NVM_V3_R9T")))

    assert reprojection_errors(model).max() < 1e-3


def test_a_fixed_calibration_is_that_of_all_cameras(folder: Path) -> None:
    text = nvm_text(header="NVM_V3 FixedK 500 320 500 240")

    model = read(write(folder, text.replace("500.0", "777.0")))

    assert reprojection_errors(model).max() < 1e-3
    camera = model.sensors["camera_2"].camera
    assert camera is not None
    assert camera.params == (500.0, 500.0, 320.0, 240.0)


@pytest.mark.parametrize("written", ['my"photo.jpg', '"my photo.jpg"', "my photo.jpg"])
def test_names_with_blanks_are_read_however_they_are_quoted(folder: Path, written: str) -> None:
    blank(folder / "my photo.jpg")

    model = read(write(folder, nvm_text(names=(written, "b.jpg"))))

    assert [image.name for image in model.images] == ["my photo.jpg", "b.jpg"]


def test_a_photo_that_is_absent_is_left_out_with_its_measurements(folder: Path) -> None:
    (folder / "b.jpg").unlink()

    model = read(write(folder, nvm_text()))

    assert [image.name for image in model.images] == ["a.jpg", "c.jpg"]
    assert len(model.observations) == 2 * 49
    assert reprojection_errors(model).max() < 1e-3
    assert "1 of 3 photos are absent and were left out: b.jpg" in model.notes


def test_without_any_photo_the_folder_is_asked_for(tmp_path: Path) -> None:
    with pytest.raises(DatasetError) as caught:
        read(write(tmp_path, nvm_text()))

    assert caught.value.code == "import.no_photos"
    assert caught.value.expected == str(tmp_path / "a.jpg")


def test_a_distortion_that_folds_the_photo_makes_the_camera_unknown(folder: Path) -> None:
    text = nvm_text().replace(" 0.0 0.0\n", " -2.0 0.0\n", 1)

    model = read(write(folder, text))

    assert model.sensors["camera_0"].camera is None
    assert model.sensors["camera_0"].image_size == SIZE
    assert model.sensors["camera_1"].camera is not None
    assert any("folds the photo" in note for note in model.notes)


@pytest.mark.parametrize(
    ("line", "text", "complaint"),
    [
        (1, "NVM_V2", "not an NVM file"),
        (1, "NVM_V3 FixedK 500 320", "the calibration is unknown"),
        (1, "NVM_V3 FixedK 0 320 500 240", "the focal length is not valid"),
        (3, "three", "the number is not valid"),
        (3, "-3", "the number is not valid"),
        (3, "1_0", "the number is not valid"),
        (3, "9" * 5000, "the number is not valid"),
        (4, "a.jpg 500 1 0 0 0 0 0 0", "does not describe a camera"),
        (4, "a.jpg 0 1 0 0 0 0 0 0 0 0", "the focal length is not valid"),
        (4, "a.jpg 500 0 0 0 0 0 0 0 0 0", "not a rotation"),
        (4, "a.jpg 500 1 0 0 0 nan 0 0 0 0", "the number is not valid"),
        (4, "a.jpg 500 1 0 0 0 1e300 0 0 0 0", "the number is not valid"),
        (4, "b.jpg 500 1 0 0 0 0 0 0 0 0", "two photos have the name"),
        (4, "a\udcff.jpg 500 1 0 0 0 0 0 0 0 0", "not a valid name"),
        (9, "0 0 1 10 20 30", "wrong number of fields"),
        (9, "0 0 1 10 20 30 2 0 0 1 2", "wrong number of fields"),
        (9, "0 0 1 10 20 30 99999999999999999 0 0 1 2", "the number is not valid"),
        (9, "0 0 1 10 20 256 1 0 0 1 2", "the number is not valid"),
        (9, "0 0 1 10 20 30 1 3 0 1 2", "the number is not valid"),
        (9, "0 0 1 10 20 30 1 0 0 inf 2", "the number is not valid"),
    ],
)
def test_what_is_malformed_is_named_by_its_line(
    folder: Path, line: int, text: str, complaint: str
) -> None:
    lines = nvm_text().split("\n")
    lines[line - 1] = text
    path = folder / "model.nvm"
    path.write_bytes("\n".join(lines).encode(errors="surrogateescape"))

    with pytest.raises(DatasetError, match=complaint) as caught:
        read(path)
    # Of two photos of one name, the second is the one that is one too many.
    assert caught.value.field == f"{path}:{5 if text.startswith('b.jpg') else line}"


def test_counts_beyond_the_file_end_with_the_file(folder: Path) -> None:
    text = nvm_text()
    path = write(folder, text.replace("\n49\n", "\n999999999\n").removesuffix("0\n").rstrip())

    with pytest.raises(DatasetError, match="ends too early") as caught:
        read(path)
    assert caught.value.code == "import.truncated"


def test_a_feature_at_two_positions_is_refused(folder: Path) -> None:
    text = nvm_text().replace(" 0 1 ", " 0 0 ", 1)

    with pytest.raises(DatasetError, match="feature 0 of image 0") as caught:
        read(write(folder, text))
    assert caught.value.code == "import.feature_moved"


def test_a_file_without_models_is_refused(folder: Path) -> None:
    with pytest.raises(DatasetError, match="holds no model"):
        read(write(folder, "NVM_V3\n\n0\n"))


def test_a_photo_that_is_none_is_named(folder: Path) -> None:
    (folder / "b.jpg").write_text("no photo")

    with pytest.raises(DatasetError) as caught:
        read(write(folder, nvm_text()))
    assert caught.value.code == "import.photo"
    assert caught.value.field == str(folder / "b.jpg")


def test_a_folder_must_hold_exactly_one_file(folder: Path) -> None:
    write(folder, nvm_text())
    assert len(read(folder).images) == 3

    (folder / "other.nvm").write_text("NVM_V3")
    with pytest.raises(DatasetError, match="name the file"):
        read(folder)


@pytest.fixture
def aachen_photos(tmp_path: Path) -> Path:
    for name in AACHEN:
        blank(tmp_path / "db" / f"{name}.jpg", (1600, 1200))
    return tmp_path


def test_the_sample_of_aachen_is_read(shared_data: Path, aachen_photos: Path) -> None:
    folder = shared_data / "import_samples/aachen_models"

    model = read(folder / "aachen_cvpr2018_db.nvm", aachen_photos)

    assert [image.name for image in model.images] == [f"db/{name}.jpg" for name in AACHEN]
    first = model.images[0].cam_from_world
    assert first is not None
    assert first.center == pytest.approx([738.038, -6.17486, -41.8371])
    assert model.sensors["camera_0"].image_size == (1600, 1200)
    assert model.points[0] == pytest.approx([769.607, 14.6241, 19.7262])
    # Whoever made the sample renumbered the photos: no point is where its measurements are.
    assert len(model.observations) == 0
    assert any("the 27 measurements were left out" in note for note in model.notes)


def test_of_several_models_the_largest_is_taken(shared_data: Path, aachen_photos: Path) -> None:
    folder = shared_data / "import_samples/aachen_models"

    model = read(folder / "aachen_two_parts.nvm", aachen_photos)

    assert [image.name for image in model.images] == ["db/1045.jpg", "db/4446.jpg"]
    assert len(model.points) == 3
    assert "not: model 1 with 1 photos and 2 points" in model.notes[0]
