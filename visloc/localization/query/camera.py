"""The intrinsics of a query: given, of the map's own photos, from EXIF, or guessed."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from visloc.archive import Map
from visloc.errors import refuse
from visloc.features.resolution import Resolution
from visloc.geometry import Camera
from visloc.photos.reading import Photo
from visloc.types import CameraSource

# Focal length in units of the longer side when nothing is known: a view of 45 degrees, between a
# phone's main camera (0.7 to 0.8) and a long lens. COLMAP guesses the same.
GUESSED_FOCAL = 1.2


# EXIF's focal lengths of one lens differ by rounding, and by how far away it is focused.
_SAME_FOCAL = 0.01


@dataclass(frozen=True, slots=True)
class MapCamera:
    """A camera of a map's photos.

    Attributes:
        name: make and model; "" when unknown.
        exif_px: focal length by EXIF, in pixels; None without.
    """

    camera: Camera
    name: str
    exif_px: float | None

    def took(self, photo: Photo, *, alone: bool = True) -> bool:
        """Tell whether the camera seems to have taken a photo: by its size, make, model and lens.

        A photo that tells none of these, of a camera that is not known by any, may be of any camera
        of its size. Only of a photo on its own is it tried: there, a wrong camera does no harm.
        """
        if not alone and not self.name:
            return False
        size = photo.file_size or (photo.width, photo.height)
        if (self.camera.width, self.camera.height) != size or self.name != photo.camera_name:
            return False
        if self.exif_px is None or photo.focal_length_px is None:
            return self.exif_px is photo.focal_length_px
        return abs(photo.focal_length_px * photo.reduced / self.exif_px - 1) <= _SAME_FOCAL


def map_cameras(opened: Map) -> tuple[MapCamera, ...]:
    """Return the cameras of a map's photos, those of most photos first."""
    told = opened.manifest.method.settings.get("cameras")
    origins = told if isinstance(told, dict) else {}
    found = []
    for sensor, _ in Counter(image.camera for image in opened.images).most_common():
        origin = origins.get(sensor)
        told = origin if isinstance(origin, dict) else {}
        if told.get("doubt") is not None:
            continue  # the photos of the map did not determine it
        name, prior = told.get("name"), told.get("prior_px")
        exif_px = None
        if told.get("source") == "exif":
            if not isinstance(prior, int | float) or not 0 < prior < math.inf:
                continue  # no number that a build writes
            exif_px = float(prior)
        known = name if isinstance(name, str) else ""
        found.append(MapCamera(opened.cameras[sensor], known, exif_px))
    return tuple(found)


def guessed_camera(width: int, height: int) -> Camera:
    """Return a camera of which nothing is known."""
    focal = GUESSED_FOCAL * max(width, height)
    return Camera("SIMPLE_PINHOLE", width, height, (focal, width / 2, height / 2))


def query_resolution(camera: Camera, source: CameraSource) -> Resolution:
    """Return how finely a photo sees, by its width where the focal length is a guess."""
    return Resolution.of(camera, known=source is not CameraSource.GUESS)


def resolve_camera(
    photo: Photo,
    given: Camera | None,
    mapped: Sequence[MapCamera] = (),
    *,
    alone: bool = True,
) -> tuple[Camera, CameraSource]:
    """Choose the intrinsics of a photo.

    Those given, else those of the map's camera that took it, else EXIF's focal length, else a
    guess.

    A camera given for another size of the same aspect is scaled to the photo; that of a photo that
    was reduced while it was decoded is reduced with it. For a photo on its
    own, the search for the focal length starts from the guess (``visloc.localization.solving``).
    """
    width, height = photo.width, photo.height
    if given is None:
        of_map = next((one.camera for one in mapped if one.took(photo, alone=alone)), None)
        if of_map is not None:
            return of_map.reduced(photo.reduced), CameraSource.MAP
        if photo.focal_length_px is None:
            return guessed_camera(width, height), CameraSource.GUESS
        params = photo.focal_length_px, width / 2, height / 2
        return Camera("SIMPLE_PINHOLE", width, height, params), CameraSource.EXIF
    if (given.width, given.height) == (width, height):
        return given, CameraSource.GIVEN
    if (given.width, given.height) == photo.file_size:
        return given.reduced(photo.reduced), CameraSource.GIVEN_SCALED
    if given.has_aspect_of(width, height):
        return given.scaled(width, height), CameraSource.GIVEN_SCALED
    turned = photo.is_on_its_side and given.has_aspect_of(height, width)
    message = (
        "the camera does not fit the photo, which is stored rotated (EXIF "
        f"orientation {photo.exif_orientation}); send the camera of the stored "
        "pixels, or rotate the pixels and remove the EXIF orientation"
    )
    raise refuse(
        "camera.size_mismatch",
        message if turned else None,
        field="camera",
        expected=f"{width} x {height} or another size of the same aspect",
        got=f"{given.width} x {given.height}",
    )
