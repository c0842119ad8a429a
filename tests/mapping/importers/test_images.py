from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
from PIL import ExifTags, Image

from mapping.importers import import_dataset
from mapping.importers.images import read
from visloc.errors import DatasetError, InvalidInput, NotFound
from visloc.kapture import read_dataset

GPS_TAGS = {tag.name: int(tag) for tag in ExifTags.GPS}


def write_photo(
    path: Path,
    size: tuple[int, int] = (64, 48),
    top: dict[int, Any] | None = None,
    details: dict[int, Any] | None = None,
    gps: dict[int, Any] | None = None,
) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    exif.update(top or {})
    if details:
        exif.get_ifd(ExifTags.IFD.Exif).update(details)
    if gps:
        exif.get_ifd(ExifTags.IFD.GPSInfo).update(gps)
    Image.new("RGB", size, "gray").save(path, exif=exif)


PHONE = {int(ExifTags.Base.Make): "Maker, Inc.", int(ExifTags.Base.Model): "One"}
FOCAL = {int(ExifTags.Base.FocalLengthIn35mmFilm): 27}
FOCAL_PX = 27 / 43.266615 * 80  # diagonals of 36 x 24 mm and 64 x 48 px


def taken(text: str, fraction: str = "") -> dict[int, Any]:
    tags = {int(ExifTags.Base.DateTimeOriginal): text}
    return tags | ({int(ExifTags.Base.SubsecTimeOriginal): fraction} if fraction else {})


def fix(**changes: Any) -> dict[int, Any]:
    tags: dict[str, Any] = {
        "GPSLatitudeRef": "S",
        "GPSLatitude": (45.0, 30.0, 36.0),
        "GPSLongitudeRef": "E",
        "GPSLongitude": (5.0, 15.0, 0.0),
        "GPSAltitudeRef": b"\x00",
        "GPSAltitude": 300.5,
    }
    return {GPS_TAGS[name]: value for name, value in (tags | changes).items() if value is not None}


def test_photos_of_one_camera_share_a_sensor_with_the_focal_length_of_exif(tmp_path: Path) -> None:
    write_photo(tmp_path / "b.jpg", top=PHONE, details=FOCAL)
    write_photo(tmp_path / "sub" / "a.jpg", top=PHONE, details=FOCAL)
    write_photo(tmp_path / "turned.jpg", (48, 64), top=PHONE, details=FOCAL)
    write_photo(tmp_path / "c.png")
    model = read(tmp_path)
    assert [(image.name, image.sensor) for image in model.images] == [
        ("b.jpg", "camera1"),
        ("c.png", "camera2"),
        ("sub/a.jpg", "camera1"),
        ("turned.jpg", "camera3"),
    ]
    assert all(image.cam_from_world is None for image in model.images)
    first = model.sensors["camera1"]
    assert first.name == "Maker Inc. One (EXIF)"
    assert first.camera is not None
    assert first.camera.model == "SIMPLE_RADIAL"
    assert first.camera.params == pytest.approx((FOCAL_PX, 32, 24, 0))
    unknown = model.sensors["camera2"]
    assert unknown.camera is None
    assert unknown.image_size == (64, 48)
    assert model.notes == ("1 of 4 photos do not tell their focal length",)


def test_timestamps_are_ranks_by_the_time_of_exif(tmp_path: Path) -> None:
    write_photo(tmp_path / "a.jpg", details=taken("2024:05:06 07:08:10"))
    write_photo(tmp_path / "b.jpg", details=taken("2024:05:06 07:08:09", "75"))
    write_photo(tmp_path / "c.jpg", details=taken("2024:05:06 07:08:09", "25"))
    write_photo(tmp_path / "d.jpg", details=taken("2024:05:06 07:08:10"))
    order = [(image.name, image.timestamp) for image in read(tmp_path).images]
    assert order == [("c.jpg", 0), ("b.jpg", 1), ("a.jpg", 2), ("d.jpg", 3)]
    write_photo(tmp_path / "e.jpg")
    model = read(tmp_path)
    assert [image.name[0] for image in model.images] == list("abcde")
    assert any("1 photos have no EXIF time" in note for note in model.notes)


def test_gps_becomes_gnss_fixes(tmp_path: Path) -> None:
    write_photo(tmp_path / "a.jpg", gps=fix())
    write_photo(tmp_path / "b.jpg")
    write_photo(tmp_path / "c.jpg", gps=fix(GPSAltitude=None, GPSDOP=2.5, GPSLongitudeRef="W"))
    import_dataset("images", tmp_path, tmp_path / "out")
    dataset = read_dataset(tmp_path / "out")
    assert dataset.notes == ()
    first, second = dataset.gnss
    assert (first.timestamp, first.x, first.z) == (0, 5.25, 300.5)
    assert first.y == pytest.approx(-45.51)
    assert (second.timestamp, second.x, second.z, second.dop) == (2, -5.25, 0.0, 2.5)
    assert dataset.sensors["gnss"].params == ("EPSG:4326",)
    assert any("1 GPS positions have no altitude" in note for note in read(tmp_path).notes)


@pytest.mark.parametrize(
    "changes",
    [
        {"GPSLatitudeRef": "X"},
        {"GPSLatitude": (95.0, 0.0, 0.0)},
        {"GPSLatitude": (0.0, 0.0, 0.0), "GPSLongitude": (0.0, 0.0, 0.0)},
        {"GPSLatitude": None},
        {"GPSLongitude": (1.0, 2.0)},
    ],
)
def test_gps_that_is_no_place_is_left_out(tmp_path: Path, changes: dict[str, Any]) -> None:
    write_photo(tmp_path / "a.jpg", gps=fix(**changes))
    assert read(tmp_path).gnss == ()


def test_what_cannot_be_read_is_left_out_with_a_note(tmp_path: Path) -> None:
    write_photo(tmp_path / "good.jpg")
    content = (tmp_path / "good.jpg").read_bytes()
    (tmp_path / "cut.jpg").write_bytes(content[: len(content) // 4])
    (tmp_path / "text.png").write_text("not a photo")
    (tmp_path / "notes.txt").write_text("not looked at")
    model = read(tmp_path)
    assert [image.name for image in model.images] == ["good.jpg"]
    (note,) = (note for note in model.notes if "cannot be read" in note)
    assert note.startswith("2 files")
    assert "cut.jpg" in note
    assert "text.png" in note


def test_links_out_of_the_folder_are_not_followed(tmp_path: Path) -> None:
    write_photo(tmp_path / "outside" / "secret.jpg")
    write_photo(tmp_path / "in" / "a.jpg")
    (tmp_path / "in" / "b.jpg").symlink_to("a.jpg")
    (tmp_path / "in" / "c.jpg").symlink_to(tmp_path / "outside" / "secret.jpg")
    (tmp_path / "in" / "folder").symlink_to(tmp_path / "outside")
    (tmp_path / "in" / "loop").symlink_to(tmp_path / "in")
    (tmp_path / "in" / "circle.jpg").symlink_to("circle.jpg")
    os.mkfifo(tmp_path / "in" / "pipe.jpg")
    assert [image.name for image in read(tmp_path / "in").images] == ["a.jpg", "b.jpg"]


def test_a_folder_without_photos_says_so(tmp_path: Path) -> None:
    (tmp_path / "x.jpg").write_bytes(b"")
    with pytest.raises(DatasetError, match=r"no readable photo.*x\.jpg"):
        read(tmp_path)
    with pytest.raises(NotFound):
        read(tmp_path / "nowhere")


def test_another_folder_of_photos_makes_no_sense(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="--photos"):
        read(tmp_path, tmp_path)
