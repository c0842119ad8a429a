"""The photos of examples/beach may be given away."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base

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
