from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

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


JPEG_XL = b"\0\0\0\x0cJXL \r\n\x87\n"
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
    assert model.notes == (
        "1 of 4 photos do not tell their focal length: those of one camera and size count as not "
        "zoomed",
    )


def test_photos_of_a_phone_in_all_orientations_share_a_camera(tmp_path: Path) -> None:
    for orientation in range(1, 9):
        top = PHONE | {int(ExifTags.Base.Orientation): orientation}
        write_photo(tmp_path / f"{orientation}.jpg", top=top, details=FOCAL)
    model = read(tmp_path)
    assert {image.sensor for image in model.images} == {"camera1"}
    camera = model.sensors["camera1"].camera
    assert camera is not None
    assert (camera.width, camera.height) == (64, 48)  # of the stored pixels
    assert camera.params == pytest.approx((FOCAL_PX, 32, 24, 0))


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


UNKNOWN = IFDRational(0, 0)
LETTER, NUMBERS = "letter of the hemisphere", "not degrees, minutes and seconds"


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"GPSLatitudeRef": "X"}, LETTER),
        ({"GPSLatitudeRef": None}, LETTER),
        ({"GPSLatitudeRef": ""}, LETTER),
        ({"GPSLongitudeRef": "N"}, LETTER),
        ({"GPSLongitudeRef": "O"}, LETTER),  # Ost or Ouest
        ({"GPSLatitude": (95.0, 0.0, 0.0)}, NUMBERS),
        ({"GPSLatitude": (89.0, 60.0, 1.0)}, NUMBERS),
        ({"GPSLatitude": (45.0, 30.0, 3600.0)}, NUMBERS),
        ({"GPSLatitude": (45.5, 30.0, 0.0)}, NUMBERS),  # half a degree once or twice
        ({"GPSLatitude": (45.0, UNKNOWN, 30.0)}, NUMBERS),
        ({"GPSLatitude": (UNKNOWN, UNKNOWN, UNKNOWN)}, NUMBERS),
        ({"GPSLatitude": (1.0, 2.0, 3.0, 4.0)}, NUMBERS),
        ({"GPSLatitude": None}, NUMBERS),
        ({"GPSLongitude": (181.0, 2.0)}, NUMBERS),
        ({"GPSLatitude": (0.0, 0.0, 0.0), "GPSLongitude": (0.0, 0.0, 0.0)}, "they are 0, 0"),
    ],
)
def test_gps_that_is_no_place_is_counted(tmp_path: Path, changes: dict[str, Any], why: str) -> None:
    write_photo(tmp_path / "a.jpg", gps=fix(**changes))
    write_photo(tmp_path / "b.jpg", gps=fix(**changes))
    write_photo(tmp_path / "c.jpg", gps={GPS_TAGS["GPSDateStamp"]: "2026:05:01"})
    model = read(tmp_path)
    assert model.gnss == ()
    (note,) = [note for note in model.notes if "GPS" in note]
    assert note.startswith("2 GPS positions are not used: ")
    assert why in note


@pytest.mark.parametrize(
    ("changes", "place"),
    [
        ({"GPSLatitudeRef": "n", "GPSLongitudeRef": "w"}, (-5.25, 45.51, 300.5)),
        ({"GPSLatitudeRef": "North", "GPSLongitudeRef": "WEST"}, (-5.25, 45.51, 300.5)),
        ({"GPSLatitudeRef": " s ", "GPSLongitudeRef": "e"}, (5.25, -45.51, 300.5)),
        ({"GPSLatitude": (45.0, 30.6, UNKNOWN)}, (5.25, -45.51, 300.5)),
        ({"GPSLatitude": (45.51, UNKNOWN, UNKNOWN)}, (5.25, -45.51, 300.5)),
        ({"GPSLatitude": (45.51, 0.0, 0.0)}, (5.25, -45.51, 300.5)),
        ({"GPSLatitude": (45.0, 30.6), "GPSLongitude": 5.25}, (5.25, -45.51, 300.5)),
        ({"GPSLongitude": (180.0, 0.0, 0.0)}, (180.0, -45.51, 300.5)),
        ({"GPSLatitude": (0.0, 0.0, 0.0)}, (5.25, 0.0, 300.5)),
        ({"GPSAltitudeRef": b"\x01"}, (5.25, -45.51, -300.5)),
        ({"GPSAltitudeRef": b"\x02"}, (5.25, -45.51, 300.5)),
        ({"GPSAltitudeRef": b"\x03"}, (5.25, -45.51, -300.5)),
        ({"GPSAltitudeRef": None}, (5.25, -45.51, 300.5)),
        ({"GPSAltitudeRef": b"\x07"}, (5.25, -45.51, 0.0)),
        ({"GPSAltitude": UNKNOWN}, (5.25, -45.51, 0.0)),
    ],
)
def test_gps_as_cameras_and_programs_write_it_is_read(
    tmp_path: Path, changes: dict[str, Any], place: tuple[float, float, float]
) -> None:
    write_photo(tmp_path / "a.jpg", gps=fix(**changes))
    model = read(tmp_path)
    (found,) = model.gnss
    assert (found.x, found.y, found.z) == pytest.approx(place)
    told = "1 GPS positions have no altitude that can be read: 0 was taken" in model.notes
    assert told == (place[2] == 0)


def test_every_file_is_used_or_left_out_with_its_reason(tmp_path: Path) -> None:
    folder = tmp_path / "in"
    write_photo(folder / "good.jpg")
    content = (folder / "good.jpg").read_bytes()
    others = {
        "cut.jpg": content[: len(content) // 4],
        "text.png": b"not a photo",
        "notes.txt": b"not looked at",
        "sub/a.jxl": JPEG_XL,
        "sub/phone.jpg": JPEG_XL,
        "b.cr2": b"II*\0\x10\0\0\0CR\2\0",
        "cut.heic": b"\0\0\0\x18ftypheic\0\0\0\0mif1heic",
        "walk.mp4": b"\0\0\0\x18ftypmp42\0\0\0\0mp42isom",
        "walk.MOV": b"\0\0\0\x14ftypqt  \0\0\0\0qt  ",
        "anim.gif": b"GIF89a" + bytes(20),
        "good.xmp": b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><a xmlns:xcr="b" xcr:Version="3"/>',
        "no_suffix": content,
        "old.jpg_original": content,
        ".DS_Store": b"x",
        "Thumbs.db": b"x",
        ".hidden.jpg": content,
        "@eaDir/good.jpg": content,
    }
    for name, data in others.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(data)
    model = read(folder)
    assert [image.name for image in model.images] == ["good.jpg"]
    reasons = {name: reason for reason, names in model.left_out.items() for name in names}
    told = others.keys() - {"@eaDir/good.jpg"} | {"@eaDir/"}
    assert reasons.keys() == told
    for name, part in {
        "cut.jpg": "damaged or cut off",
        "text.png": "does not read this image format",
        "notes.txt": "not photos",
        "sub/a.jxl": "JPEG XL photos are not read here; convert them to JPEG, such as with: djxl",
        "sub/phone.jpg": reasons["sub/a.jxl"],
        "b.cr2": "raw photos are not read here; develop them",
        "cut.heic": "damaged or cut off",
        "walk.mp4": "MP4 videos are not read here; make a map of them with: mapping capture VIDEO",
        "walk.MOV": "MOV videos",
        "anim.gif": "GIF pictures",
        "good.xmp": "poses of RealityCapture are not read here; export its cameras as COLMAP",
        "no_suffix": "rename them",
        "old.jpg_original": "rename them",
        ".DS_Store": "of the operating system",
        "@eaDir/": "of the operating system",
    }.items():
        assert part in reasons[name]


def test_names_that_a_dataset_cannot_store_are_left_out_all_at_once(tmp_path: Path) -> None:
    folder = tmp_path / "in"
    write_photo(folder / "good.jpg")
    content = (folder / "good.jpg").read_bytes()
    bad = [
        *(b"IMG_0001, Kopie.jpg", b" lead.jpg", b"tab\there.jpg", b"two\nlines.jpg"),
        *(b"f\xfcr.jpg", b"back\\slash.jpg", b"a,b/inside.jpg"),
    ]
    good = ["trail .jpg", "a b.jpg", "K\u00fcche (1).jpg", "%20.jpg", 'a"b.jpg', "\U0001f600.jpg"]
    (folder / "a,b").mkdir()
    for name in [*bad, *map(os.fsencode, good)]:
        (folder / os.fsdecode(name)).write_bytes(content)
    notes = import_dataset("images", folder, tmp_path / "out").notes
    dataset = read_dataset(tmp_path / "out")
    assert {record.path for record in dataset.images} == {"good.jpg", *good}
    assert all(dataset.has_file(record) for record in dataset.images)
    assert any(f"{len(bad)} left out (a dataset cannot store names" in note for note in notes)
    listed = (tmp_path / "out.left-out.txt").read_text()
    shown = [os.fsdecode(name) for name in bad]
    assert all((name if name.isprintable() else ascii(name)) in listed for name in shown)


def test_numbers_in_names_count_as_numbers(tmp_path: Path) -> None:
    ordered = ["frame_1.jpg", "frame_2.jpg", "frame_10.jpg", "frame_10b.jpg", "frame_100.jpg"]
    for name in reversed(ordered):
        write_photo(tmp_path / name)
    assert [image.name for image in read(tmp_path).images] == ordered
    for name in ordered:  # taken at the same time
        write_photo(tmp_path / name, details=taken("2024:05:06 07:08:10"))
    assert [image.name for image in read(tmp_path).images] == ordered


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("depth.png", np.arange(64 * 48, dtype=np.uint16).reshape(48, 64), "depth maps"),
        ("conf.png", np.arange(64 * 48, dtype=np.uint8).reshape(48, 64) % 3, "masks or maps"),
        ("mask.png", np.full((48, 64), 255, np.uint8), "masks or maps"),
        ("grey.png", np.arange(64 * 48, dtype=np.uint32).reshape(48, 64).astype(np.uint8), None),
        ("colour.png", np.zeros((48, 64, 3), np.uint8), None),
    ],
)
def test_depth_and_confidence_are_no_photos(
    tmp_path: Path, name: str, value: Any, reason: str | None
) -> None:
    Image.fromarray(value).save(tmp_path / name)
    assert [image.name for image in read(tmp_path).images] == [name]  # nothing else is there
    write_photo(tmp_path / "photo.jpg")
    model = read(tmp_path)
    assert len(model.images) == (1 if reason else 2)
    assert all(why.startswith(reason or "?") for why in model.left_out)


def test_what_is_left_out_is_counted_in_notes_and_listed_beside_the_dataset(tmp_path: Path) -> None:
    write_photo(tmp_path / "in" / "a.jpg")
    for number in range(5):
        (tmp_path / "in" / f"{number}.jxl").write_bytes(JPEG_XL)
    (tmp_path / "in" / "line\nbreak.txt").write_text("x")
    notes = import_dataset("images", tmp_path / "in", tmp_path / "out").notes
    (note,) = (note for note in notes if "JPEG XL" in note)
    assert note.startswith("5 left out (JPEG XL photos are not read here; ")
    assert note.endswith("): 0.jxl, 1.jxl, 2.jxl, ...")
    listed = tmp_path / "out.left-out.txt"
    assert any(note.endswith(str(listed)) for note in notes)
    lines = [line.split("\t") for line in listed.read_text().splitlines()]
    assert [name for name, _ in lines] == [*(f"{n}.jxl" for n in range(5)), "'line\\nbreak.txt'"]


def test_without_anything_left_out_there_is_no_list(tmp_path: Path) -> None:
    write_photo(tmp_path / "in" / "a.jpg")
    listed = tmp_path / "out.left-out.txt"
    listed.write_text("of an earlier import")
    notes = import_dataset("images", tmp_path / "in", tmp_path / "out").notes
    assert not listed.exists()
    assert not any("left out" in note for note in notes)


@pytest.mark.parametrize(
    ("name", "data", "part"),
    [
        ("walk.mp4", b"\0\0\0\x18ftypmp42\0\0\0\0mp42isom", "mapping capture VIDEO --map ID"),
        ("a.jpg", b"\xff\xd8\xff\xe0", "a map takes several photos"),
        ("list.txt", b"a.jpg", "name the folder"),
    ],
)
def test_a_file_instead_of_a_folder_says_what_to_do(
    tmp_path: Path, name: str, data: bytes, part: str
) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InvalidInput, match=part) as caught:
        read(tmp_path / name)
    assert (caught.value.code, caught.value.field) == ("import.folder", str(tmp_path / name))


def test_a_folder_of_nothing_but_jpeg_xl_says_what_to_do(tmp_path: Path) -> None:
    for number in range(8):
        (tmp_path / f"{number}.jxl").write_bytes(JPEG_XL)
    with pytest.raises(DatasetError, match=r"8 left out .JPEG XL photos .* djxl") as caught:
        read(tmp_path)
    assert caught.value.code == "import.empty"


def test_progress_is_told_photo_by_photo(tmp_path: Path) -> None:
    for name in "abc":
        write_photo(tmp_path / f"{name}.jpg")
    told: list[tuple[int, int]] = []
    read(tmp_path, progress=lambda done, total: told.append((done, total)))
    assert told == [(0, 3), (1, 3), (2, 3), (3, 3)]


def test_links_out_of_the_folder_are_not_followed(tmp_path: Path) -> None:
    write_photo(tmp_path / "outside" / "secret.jpg")
    write_photo(tmp_path / "in" / "a.jpg")
    (tmp_path / "in" / "b.jpg").symlink_to("a.jpg")
    (tmp_path / "in" / "c.jpg").symlink_to(tmp_path / "outside" / "secret.jpg")
    (tmp_path / "in" / "folder").symlink_to(tmp_path / "outside")
    (tmp_path / "in" / "loop").symlink_to(tmp_path / "in")
    (tmp_path / "in" / "circle.jpg").symlink_to("circle.jpg")
    os.mkfifo(tmp_path / "in" / "pipe.jpg")
    model = read(tmp_path / "in")
    assert [image.name for image in model.images] == ["a.jpg", "b.jpg"]
    left_out = sorted(name for names in model.left_out.values() for name in names)
    assert left_out == ["c.jpg", "circle.jpg", "folder/", "loop/", "pipe.jpg"]


def test_a_folder_without_photos_says_so(tmp_path: Path) -> None:
    (tmp_path / "x.jpg").write_bytes(b"")
    with pytest.raises(DatasetError, match=r"no readable photo.*x\.jpg"):
        read(tmp_path)
    with pytest.raises(NotFound):
        read(tmp_path / "nowhere")


def test_another_folder_of_photos_makes_no_sense(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="--photos"):
        read(tmp_path, tmp_path)
