"""The photos of examples/beach may be given away, and their map finds where others were taken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base
from typer.testing import CliRunner

import visloc
from mapping.cli.main import app
from visloc.geodesy import enu_from_geodetic
from visloc.types import Localized

BEACH = Path(__file__).parents[2] / "examples" / "beach"
PHOTOS = sorted(BEACH.glob("*/*.jpg"))
# What places a photo, and no serial number or note beyond.
KEPT = {Base.Make, Base.Model, Base.ExifOffset, Base.GPSInfo}
KEPT_OF_CAMERA = {Base.DateTimeOriginal, Base.FocalLength, Base.FocalLengthIn35mmFilm}


def fix_of(photo: Path) -> NDArray[np.float64]:
    """Where the drone's own receiver says that a photo was taken: degrees north, east, metres."""
    with Image.open(photo) as opened:
        gps = opened.getexif().get_ifd(IFD.GPSInfo)
    north, east = (
        float(degrees + minutes / 60 + seconds / 3600)
        for degrees, minutes, seconds in (gps[GPS.GPSLatitude], gps[GPS.GPSLongitude])
    )
    assert (gps[GPS.GPSLatitudeRef], gps[GPS.GPSLongitudeRef]) == ("N", "W")
    return np.array([north, -east, float(gps[GPS.GPSAltitude])])


def test_the_photos_are_small_and_licensed() -> None:
    assert len(PHOTOS) == 12
    assert sum(photo.stat().st_size for photo in PHOTOS) < 2_000_000
    assert "Copyright (c) 2017, Piero Toffanin" in (BEACH / "LICENSE").read_text()


@pytest.mark.parametrize("photo", PHOTOS, ids=lambda photo: photo.name)
def test_a_photo_tells_where_it_was_taken_and_no_more(photo: Path) -> None:
    with Image.open(photo) as opened:
        exif = opened.getexif()
        of_camera = exif.get_ifd(IFD.Exif)

    assert exif.keys() == KEPT
    assert of_camera.keys() == KEPT_OF_CAMERA
    assert fix_of(photo) == pytest.approx([46.842, -91.994, 198.5], abs=2e-3, rel=2e-3)


@pytest.mark.slow
def test_the_map_finds_photos_where_the_drone_says_it_was(tmp_path: Path) -> None:
    words = ["capture", str(BEACH / "mapping"), "--map", "beach", "--maps-dir", str(tmp_path)]
    done = CliRunner().invoke(app, [*words, "--output", str(tmp_path / "beach.png")])
    assert done.exit_code == 0, done.output
    beach = visloc.open_map("beach", tmp_path)
    geodetic = beach.archive.manifest.world.anchor.geodetic
    assert geodetic is not None
    for photo in sorted((BEACH / "query").glob("*.jpg")):
        answer = beach.localize(photo).answer
        assert isinstance(answer, Localized)
        origin = np.array([geodetic.latitude_deg, geodetic.longitude_deg, geodetic.altitude_m])
        (fix,) = enu_from_geodetic(fix_of(photo)[None], origin)
        # The map's axes are east, north and up. Receivers of drones are good to a metre or two.
        assert np.linalg.norm(answer.cam_from_world.center - fix) < 3.0
