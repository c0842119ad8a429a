from __future__ import annotations

import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from visloc.errors import DatasetError
from visloc_extensions.importers import nvm
from visloc_extensions.importers.bundler import read
from visloc_extensions.importers.tracks import reprojection_errors

SIZE = (640, 480)
NAMES = ("a.jpg", "b.jpg", "c.jpg")
RADIAL = (500.0, -0.1, 0.03)
AACHEN = ("1045", "4446", "1135")


def blank(path: Path, size: tuple[int, int] = SIZE) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("L", size).save(path)


def cameras() -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return R, t with Bundler's axes: the cameras look along -z, y is up."""
    made = []
    for angle, x in ((0.0, 0.0), (0.1, 0.4), (-0.15, -0.5)):
        c, s = math.cos(angle), math.sin(angle)
        rotation = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        made.append((rotation, -rotation @ np.array([x, 0.1, 0.2])))
    return made


def scene_points() -> NDArray[np.float64]:
    grid = np.linspace(-1.0, 1.0, 7)
    return np.array([[2.2 * x, 1.6 * y, -4.0 + x * y] for x in grid for y in grid])


def measure(camera: int, point: NDArray[np.float64]) -> tuple[float, float]:
    """Project as Bundler's manual does."""
    rotation, translation = cameras()[camera]
    x, y, z = rotation @ point + translation
    px, py = -x / z, -y / z
    r2 = px * px + py * py
    focal, k1, k2 = RADIAL
    scale = focal * (1 + k1 * r2 + k2 * r2 * r2)
    return float(scale * px), float(scale * py)


def bundle_text(*, corner: bool = False) -> str:
    points = scene_points()
    lines = ["# Bundle file v0.3", f"3 {len(points)}"]
    for rotation, translation in cameras():
        lines.append("{} {} {}".format(*RADIAL))
        lines += [" ".join(repr(float(v)) for v in row) for row in (*rotation, translation)]
    for number, point in enumerate(points):
        lines += [" ".join(repr(float(v)) for v in point), "10 20 30"]
        seen = [measure(camera, point) for camera in range(3)]
        if corner:
            seen = [(x + 320, y - 240) for x, y in seen]
        lines.append("3 " + " ".join(f"{i} {number} {x} {y}" for i, (x, y) in enumerate(seen)))
    return "\n".join([*lines, ""])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in NAMES:
        blank(tmp_path / name)
    (tmp_path / "list.txt").write_text("".join(f"{name} 0 512.5\n" for name in NAMES))
    return tmp_path


def write(folder: Path, text: str) -> Path:
    path = folder / "bundle.out"
    path.write_text(text)
    return path


def test_points_project_to_the_measurements_of_an_exact_model(folder: Path) -> None:
    model = read(write(folder, bundle_text()))

    errors = reprojection_errors(model)
    assert len(errors) == 3 * 49
    assert errors.max() < 1e-3
    assert model.points == pytest.approx(scene_points())
    assert model.colors[0].tolist() == [10, 20, 30]
    camera = model.sensors["camera_0"].camera
    assert camera is not None
    assert camera.model == "RADIAL"
    assert camera.params == (500.0, 320.0, 240.0, -0.1, 0.03)
    assert model.notes == ("3 focal lengths in list.txt are not read",)


def test_camera_centres_stay_and_axes_turn(folder: Path) -> None:
    second = read(write(folder, bundle_text())).images[1].cam_from_world

    assert second is not None
    assert second.center == pytest.approx([0.4, 0.1, 0.2])
    assert np.linalg.det(second.rotation) == pytest.approx(1.0)
    assert second.rotation[1] == pytest.approx([0.0, -1.0, 0.0])  # y down


def test_measurements_from_the_top_left_corner_are_recognized(folder: Path) -> None:
    model = read(write(folder, bundle_text(corner=True)))

    assert reprojection_errors(model).max() < 1e-3
    assert any("count from the top-left corner" in note for note in model.notes)


def test_a_camera_of_zeros_was_not_reconstructed(folder: Path) -> None:
    lines = bundle_text().split("\n")
    lines[2:7] = ["0 0 0"] * 5

    model = read(write(folder, "\n".join(lines)))

    assert model.images[0].cam_from_world is None
    assert model.sensors["camera_0"].camera is None
    assert model.sensors["camera_0"].image_size == SIZE
    assert "1 of 3 photos were not reconstructed" in model.notes


def test_the_folder_will_do_when_it_holds_one_model(folder: Path) -> None:
    write(folder, bundle_text())
    assert len(read(folder).images) == 3

    (folder / "older.out").write_text("")
    assert len(read(folder).images) == 3  # bundle.out is the usual name

    (folder / "bundle.out").unlink()
    (folder / "oldest.out").write_text("")
    with pytest.raises(DatasetError, match="name the file"):
        read(folder)


@pytest.mark.parametrize("place", ["bundle.out.list.txt", "bundle.list.txt", "../list.txt"])
def test_the_list_of_photos_is_found_at_its_usual_places(folder: Path, place: str) -> None:
    (folder / "bundle").mkdir()
    path = write(folder / "bundle", bundle_text())
    shutil.move(folder / "list.txt", folder / "bundle" / place)

    assert [image.name for image in read(path, folder).images] == list(NAMES)


def test_names_in_the_list_count_from_its_folder(folder: Path) -> None:
    (folder / "photos").mkdir()
    for name in NAMES:
        shutil.move(folder / name, folder / "photos" / name)
    (folder / "list.txt").write_text("".join(f"./photos/{name}\n" for name in NAMES))

    path = write(folder, bundle_text())

    assert read(path).images[0].name == "photos/a.jpg"
    assert read(path, folder / "photos").images[0].name == "a.jpg"


def test_a_missing_list_is_asked_for(folder: Path) -> None:
    (folder / "list.txt").unlink()

    with pytest.raises(DatasetError, match="list of photos is missing") as caught:
        read(write(folder, bundle_text()))
    assert caught.value.code == "import.missing"


def test_a_list_of_other_photos_is_refused(folder: Path) -> None:
    (folder / "list.txt").write_text("a.jpg\nb.jpg\n")
    path = write(folder, bundle_text())

    with pytest.raises(DatasetError, match="belongs to another file") as caught:
        read(path)
    assert caught.value.field == f"{path}:2"


def test_a_name_that_occurs_twice_is_named_by_its_line(folder: Path) -> None:
    (folder / "list.txt").write_text("a.jpg\nb.jpg\n./a.jpg\n")

    with pytest.raises(DatasetError, match="two photos have the name 'a\\.jpg'") as caught:
        read(write(folder, bundle_text()))
    assert caught.value.field == f"{folder / 'list.txt'}:3"


def test_photos_that_are_absent_are_left_out_or_asked_for(folder: Path) -> None:
    path = write(folder, bundle_text())
    (folder / "a.jpg").unlink()

    model = read(path)
    assert [image.name for image in model.images] == ["b.jpg", "c.jpg"]
    assert reprojection_errors(model).max() < 1e-3
    assert "1 of 3 photos are absent and were left out: a.jpg" in model.notes

    (folder / "b.jpg").unlink()
    (folder / "c.jpg").unlink()
    with pytest.raises(DatasetError) as caught:
        read(path)
    assert caught.value.code == "import.no_photos"


@pytest.mark.parametrize(
    ("line", "text", "complaint"),
    [
        (1, "# Bundle file v0.4", "not a Bundler file"),
        (2, "3", "wrong number of fields"),
        (2, "3 -49", "the number is not valid"),
        (2, f"3 {10**12}", "the number is not valid"),
        (3, "500 0", "wrong number of fields"),
        (3, "-500 0 0", "the focal length is not valid"),
        (3, "nan 0 0", "the number is not valid"),
        (4, "2 0 0", "not a rotation"),
        (7, "0 0 1e300", "the number is not valid"),
        (18, "0 0", "wrong number of fields"),
        (19, "10 20 300", "the number is not valid"),
        (19, "10 20", "wrong number of fields"),
        (20, "2 0 0 1 2", "wrong number of fields"),
        (20, "1 3 0 1 2", "the number is not valid"),
        (20, "1 0 -1 1 2", "the number is not valid"),
        (20, "1 0 0 1 inf", "the number is not valid"),
    ],
)
def test_what_is_malformed_is_named_by_its_line(
    folder: Path, line: int, text: str, complaint: str
) -> None:
    lines = bundle_text().split("\n")
    lines[line - 1] = text
    path = write(folder, "\n".join(lines))

    with pytest.raises(DatasetError, match=complaint) as caught:
        read(path)
    assert caught.value.field == f"{path}:{line}"


def test_counts_beyond_the_file_end_with_the_file(folder: Path) -> None:
    path = write(folder, bundle_text().replace("3 49", "3 999999999", 1))

    with pytest.raises(DatasetError, match="ends too early") as caught:
        read(path)
    assert caught.value.code == "import.truncated"


@pytest.fixture
def aachen(tmp_path: Path, shared_data: Path) -> Path:
    sample = shared_data / "import_samples/aachen_models/aachen_cvpr2018_db.out"
    shutil.copy(sample, tmp_path / "aachen.out")
    for name in AACHEN:
        blank(tmp_path / "db" / f"{name}.jpg", (1600, 1200))
    (tmp_path / "list.txt").write_text("".join(f"db/{name}.jpg\n" for name in AACHEN))
    return tmp_path


def test_the_sample_of_aachen_is_the_model_that_its_nvm_is(aachen: Path, shared_data: Path) -> None:
    model = read(aachen / "aachen.out")
    twin = nvm.read(shared_data / "import_samples/aachen_models/aachen_cvpr2018_db.nvm", aachen)

    # VisualSFM turned the world about x, as it turned the cameras.
    turned = np.diag([1.0, -1.0, -1.0])
    assert model.points @ turned == pytest.approx(twin.points, abs=1e-3)
    assert len(model.images) == 3
    for image, other in zip(model.images, twin.images, strict=True):
        assert image.name == other.name
        assert image.cam_from_world is not None
        assert other.cam_from_world is not None
        assert image.cam_from_world.rotation @ turned == pytest.approx(
            other.cam_from_world.rotation, abs=1e-5
        )
        assert image.cam_from_world.translation == pytest.approx(
            other.cam_from_world.translation, abs=1e-3
        )


def test_visualsfm_s_distortion_in_a_bundler_file_is_pointed_out(aachen: Path) -> None:
    model = read(aachen / "aachen.out")

    assert any("take its NVM file" in note for note in model.notes)
    assert any("the 27 measurements were left out" in note for note in model.notes)
