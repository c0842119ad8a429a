"""A known length gives a finished map its size."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from mapping.cli.main import app
from mapping.maps.editing import content_of, moved
from mapping.own_test.publishing import publish_tested, write_content
from mapping.stages.imported_points import ImportedPoints, read_imported_points
from visloc.archive import Anchor, Geodetic, Map, MapStore, verify_map
from visloc.archive.places import enu_of
from visloc.archive.schema import Doubt, photo_file
from visloc.errors import VislocError
from visloc.geometry import Pose, Similarity

# Metres in a unit of the map before it has a size.
UNIT = 2.5


def published(built: Map, root: Path, **settings: str) -> Map:
    """A map in units of unknown length, with small photos, pairs and imported points."""
    content = moved(content_of(built), Similarity(1 / UNIT, np.eye(3), np.zeros(3)), metric=False)
    anchor = Anchor(kind="none", images=0)
    content = replace(content, anchor=anchor, settings={**content.settings, **settings})
    points = ImportedPoints(
        np.array([[1.0, 2.0, 3.0]]),
        None,
        np.zeros(len(content.images) + 1, np.int64),
        np.zeros((0, 2), np.float32),
        np.zeros((0, 3), np.int64),
    )
    scale = Doubt(kind="scale", message="the size rests on photos that do not come back")
    store = MapStore(root)
    with store.incoming() as incoming:
        for row in range(len(content.images)):
            (incoming / photo_file(row)).parent.mkdir(exist_ok=True)
            (incoming / photo_file(row)).write_bytes(b"a small photo")
        (incoming / "pairs.txt").write_text("a b 1\n")
        points.write(incoming)
        version = write_content(incoming, content, "room", carried=(scale,))
        publish_tested(store, incoming, "room", version, accept=True)
    return store.open("room")


@pytest.fixture(scope="module")
def unsized(built_maps: Path, tmp_path_factory: pytest.TempPathFactory) -> Map:
    return published(MapStore(built_maps).open("room"), tmp_path_factory.mktemp("unsized"))


@pytest.fixture
def maps(unsized: Map, tmp_path: Path) -> Path:
    return Path(shutil.copytree(unsized.path.parent.parent, tmp_path / "maps"))


def centers_of(opened: Map) -> NDArray[np.float64]:
    return np.array([Pose.from_quaternion(row[:4], row[4:]).center for row in opened.image_poses])


def far_photos(opened: Map) -> tuple[str, str, float]:
    """The first photo, the one furthest from it, and the metres between them."""
    away = np.linalg.norm(centers_of(opened) - centers_of(opened)[0], axis=1)
    names = [opened.images[row].name for row in (0, int(away.argmax()))]
    return names[0], names[1], UNIT * float(away.max())


def edit(maps: Path, *options: object) -> Any:
    arguments = ["edit", "room", "--maps-dir", str(maps), *map(str, options)]
    return CliRunner().invoke(app, arguments)


def test_a_map_is_in_metres_once_a_length_is_known(unsized: Map, maps: Path) -> None:
    first, second, metres = far_photos(unsized)

    result = edit(maps, "--scale", first, second, f"{100 * metres:.3f} cm")

    assert result.exit_code == 0, result.output
    sized = MapStore(maps).open("room")  # in use: the doubt about the size before is settled
    assert verify_map(sized.path).ref == sized.ref != unsized.ref
    manifest = sized.manifest
    assert manifest.world.metric
    assert manifest.parts.doubts == ()
    assert manifest.method.settings["scale"] == {
        "by": "length",
        "photos": [first, second],
        "metres": pytest.approx(metres, abs=1e-4),
    }
    assert f"scale: {first} and {second} are" in manifest.notes[-1]
    np.testing.assert_allclose(centers_of(sized), UNIT * centers_of(unsized), atol=1e-4)
    assert manifest.parts.own_test is not None
    assert unsized.manifest.parts.own_test is not None
    assert manifest.parts.own_test.wrong == unsized.manifest.parts.own_test.wrong
    kept = {"photos/000000.jpg", "pairs.txt", "imported_points.npz"}
    assert kept <= manifest.files.keys()
    imported = read_imported_points(sized)
    assert imported is not None
    np.testing.assert_allclose(imported.points, [[2.5, 5.0, 7.5]], rtol=1e-5)
    assert "metric, size from --scale" in " ".join(result.output.split())


@pytest.mark.parametrize(
    ("scale", "code", "got"),
    [
        (("nowhere.jpg", "{b}", "3m"), "capture.photo", "nowhere.jpg: 0 photos"),
        (("{a}", "{a}", "3m"), "edit.scale", "taken at one place"),
        (("{a}", "{b}", "0m"), "capture.length", "0m"),
        (("{a}", "{b}", "-3m"), "capture.length", "-3m"),
        (("{a}", "{b}", "nan"), "capture.length", "nan"),
        (("{a}", "{b}", "3ft"), "capture.length", "3ft"),
    ],
)
def test_a_length_that_cannot_be_used_is_refused_by_name(
    scale: tuple[str, str, str], code: str, got: str, unsized: Map, maps: Path
) -> None:
    first, second, _ = far_photos(unsized)
    asked = [part.format(a=first, b=second) for part in scale]

    result = edit(maps, "--scale", *asked)

    assert isinstance(result.exception, VislocError)
    assert (result.exception.code, result.exception.field) == (code, "--scale")
    assert got in str(result.exception)
    assert MapStore(maps).current_version("room") == unsized.manifest.version


def test_a_map_in_metres_is_measured_anew_only_by_force(unsized: Map, maps: Path) -> None:
    first, second, metres = far_photos(unsized)
    edit(maps, "--scale", first, second, metres)

    refused = edit(maps, "--scale", first, second, 2 * metres)
    forced = edit(maps, "--scale", first, second, 2 * metres, "--force")

    assert refused.exception.code == "edit.metric"
    assert forced.exit_code == 0, forced.output
    again = centers_of(MapStore(maps).open("room"))
    np.testing.assert_allclose(again, 2 * UNIT * centers_of(unsized), atol=1e-4)


def test_photos_that_placed_each_other_must_come_back_to_tell_a_size(
    built_maps: Path, tmp_path: Path
) -> None:
    # Of eight photos of a room, none comes back without those beside it.
    unsized = published(MapStore(built_maps).open("room"), tmp_path, poses="estimate")
    first, second, metres = far_photos(unsized)

    result = edit(tmp_path, "--scale", first, second, metres)

    assert result.exception.code == "map.doubtful"
    assert f"do not come back where they were taken (--scale): {first}" in result.output
    assert MapStore(tmp_path).current_version("room") == unsized.manifest.version


@pytest.mark.parametrize(("told", "fits"), [(1.0, True), (1.05, True), (1.3, False)])
def test_a_length_must_fit_the_place_on_earth(
    told: float, fits: bool, unsized: Map, maps: Path
) -> None:
    place = {"latitude": 48.0, "longitude": 2.0, "altitude": 90, "yaw": 30, "gravity": "0,0,-1"}
    options = [text for name, value in place.items() for text in (f"--{name}", str(value))]
    anchored = ["anchor", "room", "--maps-dir", str(maps), *options, "--scale", str(UNIT)]
    assert CliRunner().invoke(app, anchored).exit_code == 0
    before = MapStore(maps).open("room").geodetic
    first, second, metres = far_photos(unsized)

    result = edit(maps, "--scale", first, second, told * metres)

    if not fits:
        assert result.exception.code == "edit.scale"
        assert "place on Earth" in str(result.exception)
        return
    sized = MapStore(maps).open("room")
    assert isinstance(before, Geodetic)
    assert isinstance(sized.geodetic, Geodetic)
    # Nothing moves on Earth.
    np.testing.assert_allclose(
        enu_of(centers_of(sized), sized.geodetic),
        enu_of(centers_of(unsized), before),
        atol=1e-3,
    )
