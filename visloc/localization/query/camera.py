"""The intrinsics of a query: given, from EXIF, or guessed."""

from __future__ import annotations

from visloc.errors import refuse
from visloc.features.resolution import Resolution
from visloc.geometry import Camera
from visloc.images import Photo
from visloc.types import CameraSource

# Focal length in units of the longer side when nothing is known: a view of 45 degrees, between a
# phone's main camera (0.7 to 0.8) and a long lens. COLMAP guesses the same.
GUESSED_FOCAL = 1.2


def query_resolution(camera: Camera, source: CameraSource) -> Resolution:
    """Return how finely a photo sees, by its width where the focal length is a guess."""
    return Resolution.of(camera, known=source is not CameraSource.GUESS)


def resolve_camera(photo: Photo, given: Camera | None) -> tuple[Camera, CameraSource]:
    """Choose the intrinsics of a photo: given, else EXIF's focal length, else a guess.

    A camera given for another size of the same aspect is scaled to the photo; that of a photo that
    was reduced while it was decoded is reduced with it. For a photo on its
    own, the search for the focal length starts from the guess (``visloc.localization.solving``).

    Raises:
        InvalidInput: ``camera.size_mismatch``.
    """
    width, height = photo.width, photo.height
    if given is None:
        known = photo.focal_length_px is not None
        focal = photo.focal_length_px or GUESSED_FOCAL * max(width, height)
        camera = Camera("SIMPLE_PINHOLE", width, height, (focal, width / 2, height / 2))
        return camera, CameraSource.EXIF if known else CameraSource.GUESS
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
