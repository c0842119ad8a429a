from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from mapping.maps.cameras import camera_lines, cameras_of, origins_record
from visloc.archive import ImageRecord, Map, MapStore
from visloc.geometry import Camera


@pytest.fixture
def opened(built_maps: Path) -> Map:
    return MapStore(built_maps).open("room")


def with_cameras(opened: Map, settings: dict[str, object], *focal: float) -> Map:
    """The map with other cameras, called 0, 1, ..., of a photo each."""
    method = opened.manifest.method.model_copy(update={"settings": settings})
    return replace(
        opened,
        manifest=opened.manifest.model_copy(update={"method": method}),
        cameras={
            f"{number}": Camera("SIMPLE_RADIAL", 640, 480, (value, 320, 240, 0))
            for number, value in enumerate(focal)
        },
        images=tuple(ImageRecord(f"{number}.jpg", f"{number}", 0) for number in range(len(focal))),
    )


def origin(source: str, prior: float | None, doubt: str | None = None) -> dict[str, object]:
    return {"source": source, "prior_px": prior, "doubt": doubt, "refined_px": None}


def test_cameras_that_nothing_refined_are_those_of_the_dataset(opened: Map) -> None:
    for camera in cameras_of(opened).values():
        assert (camera.source, camera.moved_percent, camera.photos) == ("given", None, 4)


def test_each_of_a_few_cameras_has_a_line(opened: Map) -> None:
    settings = {
        "cameras": {
            "0": origin("exif", 500.0),
            "1": origin("exif", 600.0, "undetermined"),
            "2": origin("estimated", None, "undetermined"),
        }
    }
    lines = camera_lines(with_cameras(opened, settings, 520.0, 600.0, 700.0, 800.0))
    assert lines == [
        "0: SIMPLE_RADIAL 640x480, focal length 520.0 px (EXIF, refined by +4.0 %), 1 photo",
        "1: SIMPLE_RADIAL 640x480, focal length 600.0 px (EXIF, not refined: the photos do not "
        "determine it), 1 photo",
        "2: SIMPLE_RADIAL 640x480, focal length 700.0 px (estimated from the photos: the photos do "
        "not determine it), 1 photo",
        "3: SIMPLE_RADIAL 640x480, focal length 800.0 px (its origin is not recorded), 1 photo",
    ]


def test_many_cameras_are_summed_up_with_those_that_moved_most(opened: Map) -> None:
    cameras = {f"{n}": origin("exif", 500.0, "moved" if n == 0 else None) for n in range(6)}
    cameras["6"] = origin("given", 700.0)
    lines = camera_lines(
        with_cameras(opened, {"cameras": cameras}, 500, 501, 502, 540, 470, 505, 700)
    )
    assert lines[0] == (
        "7, focal lengths 470.0 to 700.0 px, median 502.0 px: 6 EXIF, 1 given by the dataset"
    )
    assert lines[1:3] == ["of 1, refinement moved it too far", "moved most:"]
    assert [line.split(":")[0] for line in lines[3:]] == ["3", "4", "5"]


def test_a_map_of_an_older_program_says_that_it_does_not_know(opened: Map) -> None:
    for settings in ({"poses": "estimate"}, {"refine": ["intrinsics"], "poses": "given"}):
        (camera,) = cameras_of(with_cameras(opened, dict(settings), 500.0)).values()
        assert camera.source == "unknown"


def test_a_joined_map_keeps_where_the_focal_lengths_of_both_come_from(opened: Map) -> None:
    from_depth = with_cameras(opened, {"voxel_size": 0.01}, 500.0)
    from_photos = with_cameras(
        opened, {"cameras": {"0": origin("exif", 600.0, "undetermined")}}, 600.0
    )
    of_both = (*from_depth.images, replace(from_photos.images[0], camera="0-2"))

    joined = replace(
        with_cameras(opened, dict(origins_record(from_depth, from_photos, of_both)), 500.0),
        cameras={"0": from_depth.cameras["0"], "0-2": from_photos.cameras["0"]},
        images=of_both,
    )

    cameras = cameras_of(joined)
    assert (cameras["0"].source, cameras["0"].doubt) == ("given", None)
    assert (cameras["0-2"].source, cameras["0-2"].doubt) == ("exif", "undetermined")
    assert origins_record(from_depth, from_depth, (*from_depth.images, *from_depth.images)) == {}
