"""Names of photos that are special in text: each file that we write gives them back, or refuses."""

from __future__ import annotations

import json
from collections.abc import Callable, Set
from pathlib import Path

import numpy as np
import PIL.Image
import pycolmap
import pytest

from clients.evaluation.queries import read_queries
from clients.evaluation.results import read_results
from mapping.importers import import_dataset
from mapping.importers.colmap import read as read_colmap
from mapping.importers.dataset import write_imported
from mapping.importers.model import ImportedImage, ImportedModel
from visloc.errors import VislocError
from visloc.geometry import Camera, Pose
from visloc.kapture import (
    Dataset,
    FileRecord,
    Reconstruction,
    Sensor,
    open_features,
    read_dataset,
    read_reconstruction,
    write_dataset,
    write_keypoints,
    write_reconstruction,
)
from visloc.kapture.matches import open_matches, write_matches
from visloc.kapture.pairs import read_pair_rows, write_pair_rows

NAMES = [
    *("a.jpg", "#a.jpg", "# a.jpg", "##", "a#b.jpg", "d/#a.jpg", "#d/a.jpg", "a.jpg#", "-x.jpg"),
    *("a b.jpg", "a  b.jpg", " lead.jpg", "trail.jpg ", "d/ a.jpg", "a\tb.jpg", "a\nb.jpg"),
    *("a\rb.jpg", "a,b.jpg", "a;b.jpg", "a|b.jpg", "a=b.jpg", "a:b.jpg", "a'b.jpg", '"a".jpg'),
    *('a"b.jpg', "a%20b.jpg", "a%b.jpg", "%23a.jpg", "a?b*.jpg", "[a](b).jpg", "~a.jpg", "$a`.jpg"),
    *("\ufeffa.jpg", "a\u00a0b.jpg", "a\u2028b.jpg", "a\x85b.jpg", "a\u200bb.jpg", "\u00e9.jpg"),
    *(
        "e\u0301.jpg",
        "\u5199\u771f.jpg",
        "\U0001f4f7.jpg",
        "A.JPG",
        "a.jpg.jpg",
        "1",
        "nan",
        "1 2 3",
    ),
    *("a\\b.jpg", "./a.jpg", "C:a.jpg", "x.overlapping/y.jpg", "PINHOLE.jpg", "a PINHOLE 1.jpg"),
    *("a.jpg 1 0 0 0 0 0 0", "x" * 200 + ".jpg"),
]
Through = Callable[[Path, str], list[str]]
POSE = Pose(np.eye(3), np.array([1.0, 2.0, 3.0]))
CAMERA = Camera("PINHOLE", 64, 48, (50.0, 50.0, 32.0, 24.0))
OTHER = "other.jpg"


def dataset(folder: Path, name: str) -> list[str]:
    records = (FileRecord(0, "cam", name), FileRecord(1, "cam", OTHER))
    sensors = {"cam": Sensor.with_camera("cam", CAMERA)}
    write_dataset(Dataset(folder, sensors, {}, {(0, "cam"): POSE}, records, (), ()))
    return [record.path for record in read_dataset(folder).images]


def observations(folder: Path, name: str) -> list[str]:
    rows = np.array([[0, 0, 5], [0, 1, 6]])
    points = np.zeros((1, 3))
    write_reconstruction(folder, Reconstruction(points, None, "sift", (name, OTHER), rows))
    read = read_reconstruction(folder)
    assert read is not None
    return list(read.images)


def features(folder: Path, name: str) -> list[str]:
    for each in (name, OTHER):
        write_keypoints(folder, "own", each, np.ones((3, 2), np.float32), name="own")
    found = open_features(folder, "keypoints", "own", None)
    return [each for each in (name, OTHER) if found.has(each)]


def matches(folder: Path, name: str) -> list[str]:
    write_matches(folder, name, OTHER, np.zeros((1, 2), np.int64))
    return list(next(iter(open_matches(folder).pairs())))


def pairs(folder: Path, name: str) -> list[str]:
    write_pair_rows(folder / "pairs.txt", [(name, OTHER, 0.5), (OTHER, name, 0.25)])
    (first, back) = read_pair_rows(folder / "pairs.txt")
    assert (back.first, back.second) == (first.second, first.first)
    return [first.first, first.second]


def results(folder: Path, name: str) -> list[str]:
    lines = [{"name": each, "status": "not_localized", "retrieved": []} for each in (name, OTHER)]
    path = folder / "results.jsonl"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return [result.name for result in read_results(path)]


def bare_list(folder: Path, name: str) -> list[str]:
    return listed(folder, name, "")


def list_with_cameras(folder: Path, name: str) -> list[str]:
    return listed(folder, name, " PINHOLE 64 48 50 50 32 24")


def listed(folder: Path, name: str, camera: str) -> list[str]:
    """People write lists; photos with blanks around their names are found as ``./ a.jpg``."""
    for each in (name, OTHER):
        (folder / each).parent.mkdir(parents=True, exist_ok=True)
        (folder / each).touch()
    written = name if name == name.strip() else f"./{name}"
    (folder / "list.txt").write_text(f"# name\n{written}{camera}\n{OTHER}{camera}\n", "utf-8")
    found = read_queries(folder / "list.txt").photos
    assert [query.camera for query in found] == [CAMERA if camera else None] * 2
    return [query.name for query in found]


def colmap_model(folder: Path, name: str) -> list[str]:
    """COLMAP's binary model, as ``mapping export`` writes it."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="PINHOLE", width=64, height=48, params=[50, 50, 32, 24])
    camera.camera_id = 1
    model.add_camera_with_trivial_rig(camera)
    for key, each in enumerate((name, OTHER), 1):
        image = pycolmap.Image(name=each, camera_id=1, image_id=key)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    model.write_binary(folder)
    return [image.name for image in read_colmap(folder).images]


def colmap_text(folder: Path, name: str) -> list[str]:
    (folder / "cameras.txt").write_text("1 PINHOLE 64 48 50 50 32 24\n")
    lines = "".join(f"{i} 1 0 0 0 0 0 0 1 {n}\n\n" for i, n in enumerate((name, OTHER), 1))
    (folder / "images.txt").write_text(lines, "utf-8", newline="")
    (folder / "points3D.txt").touch()
    return [image.name for image in read_colmap(folder).images]


def transforms(folder: Path, name: str) -> list[str]:
    matrix = np.eye(4).tolist()
    frames = [{"file_path": each, "transform_matrix": matrix} for each in (name, OTHER)]
    top = {"w": 64, "h": 48, "fl_x": 50.0, "frames": frames}
    source = folder / "in"
    (source / name).parent.mkdir(parents=True)
    for each in (name, OTHER):
        PIL.Image.new("RGB", (64, 48)).save(source / each, "JPEG")
    (source / "transforms.json").write_text(json.dumps(top))
    import_dataset("nerfstudio", source, folder / "out")
    return [record.path for record in read_dataset(folder / "out").images]


def imported(folder: Path, name: str) -> list[str]:
    sensors = {"cam": Sensor.with_camera("cam", CAMERA)}
    images = tuple(
        ImportedImage(each, "cam", rank, POSE, np.ones((1, 2), np.float32), np.ones((1, 8), "u1"))
        for rank, each in enumerate((name, OTHER))
    )
    write_imported(ImportedModel(sensors, images, None), folder / "out")
    return [record.path for record in read_dataset(folder / "out").images]


FILES: list[Through] = [
    *(dataset, observations, features, matches, pairs, results, bare_list, list_with_cameras),
    *(colmap_model, colmap_text, transforms, imported),
]
# What people or other programs write, with the characters that end a name there.
BREAKS = frozenset("\n\r\t")
BY_HAND = (bare_list, list_with_cameras, colmap_text)
FINE = ["#a.jpg", "a b.jpg", "a;b.jpg", '"a".jpg', "a%20b.jpg", "%23a.jpg", "-x.jpg", "\u00e9.jpg"]


def check_names(through: Through, tmp_path: Path, breaks: Set[str] = frozenset()) -> None:
    """Give a file all names but those that nobody can write by hand, with these characters."""
    refused = []
    wrong = {}
    for number, name in enumerate(NAMES):
        if breaks and (name != name.strip() or not breaks.isdisjoint(name)):
            continue
        folder = tmp_path / str(number)
        folder.mkdir(parents=True)
        try:
            back = through(folder, name)
        except VislocError as error:
            said = str(error)
            if not any(text in said for text in (name, repr(name)[1:-1], ascii(name)[1:-1])):
                wrong[name] = said
            refused.append(name)
        else:
            # One spelling of a path stands for the other.
            plain = name.replace("\\", "/").removeprefix("./")
            if OTHER not in back or not set(back) - {OTHER} <= {name, plain} or len(back) != 2:
                wrong[name] = str(back)
    assert wrong == {}
    # What every file must be able to hold; the others have a comma, a break, or blanks around.
    assert not {name for name in refused if name.isprintable() and "," not in name} & set(FINE)


@pytest.mark.parametrize("through", FILES, ids=lambda through: through.__name__)
def test_names_come_back_or_are_refused_by_name(tmp_path: Path, through: Through) -> None:
    check_names(through, tmp_path, BREAKS if through in BY_HAND else frozenset())


def test_names_that_differ_in_one_sign_only_are_kept_apart(tmp_path: Path) -> None:
    names = ["a b.jpg", "a%20b.jpg", "#a.jpg", "a.jpg", "\u00e9.jpg", "e\u0301.jpg", "A.jpg"]
    for through in (dataset, pairs, observations):
        for number, name in enumerate(names):
            folder = tmp_path / f"{through.__name__} {number}"
            folder.mkdir()
            assert through(folder, name) == [name, OTHER]
