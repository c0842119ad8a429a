"""The photos of a dataset that a map can be made of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from mapping.progress import ItemProgress
from mapping.stages.depth import DepthMatch, DepthMatcher
from visloc.archive import sha256_of
from visloc.errors import refuse
from visloc.geometry import Camera, Pose
from visloc.kapture import Dataset, FileRecord
from visloc.localization.query.camera import GUESSED_FOCAL
from visloc.photos.reading import FILE_LIMITS, Photo, read_photo_file, upright, with_mask

# More names than a note needs.
_NAMED = 3


@dataclass(frozen=True, slots=True, eq=False)
class MappingPhoto:
    """A photo with all that is known of it.

    Attributes:
        path: the file; it exists when ``sha256`` is not None.
        sha256: of the file; for a dataset at a URL, the storage's own tag of the content.
        camera_known: whether the intrinsics are the dataset's; else they are a guess.
        mask: the file of its mask, if any.
        feature_size: width and height at which its features are found; None for its own.
    """

    record: FileRecord
    path: Path
    sha256: str | None
    camera: Camera
    camera_known: bool
    cam_from_world: Pose | None
    depth: DepthMatch | None
    depth_sha256: str | None
    mask: Path | None = None
    mask_sha256: str | None = None
    feature_size: tuple[int, int] | None = None

    @property
    def name(self) -> str:
        """The photo's name in the dataset and in the map."""
        return self.record.path

    @property
    def pose(self) -> Pose:
        """``cam_from_world`` of a photo that was collected with poses."""
        assert self.cam_from_world is not None
        return self.cam_from_world

    def read(self) -> Photo:
        """Decode the file in the frame of its camera, as ``read_in_frame``."""
        size = self.camera.width, self.camera.height
        return read_in_frame(self.path, size, self.record.sensor_id, self.mask)


def read_in_frame(
    path: Path, size: tuple[int, int], sensor_id: str, mask: Path | None = None
) -> Photo:
    """Decode a photo of a dataset in the frame of its camera: the pixels as stored.

    If the camera has the size of a photo on its side (width and height swapped, EXIF orientation 5
    to 8), the tool that made the dataset turned the pixels when it read them. Camera, pose and
    depth map then belong to the upright picture, which is returned.

    Args:
        size: width and height of the camera, pixels.
    """
    photo = read_photo_file(path)
    if mask is not None:
        with mask.open("rb") as file:  # one byte more than is read tells that it is too large
            data = file.read(FILE_LIMITS.max_bytes + 1)
        photo = with_mask(photo, data, FILE_LIMITS, str(mask))
    stored = photo.width, photo.height
    if stored == size:
        return photo
    if photo.is_on_its_side and stored[::-1] == size:
        turn = photo.exif_orientation
        turned = replace(photo, rgb=upright(photo.rgb, turn), exif_orientation=1)
        return turned if photo.mask is None else replace(turned, mask=upright(photo.mask, turn))
    message = (
        "photos of so many pixels are reduced while they are decoded; give their camera in "
        f"sensors.txt {photo.width} x {photo.height} pixels, and divide its lengths in pixels by "
        f"{photo.reduced}"
    )
    raise refuse(
        "dataset.photo_size",
        message if size == photo.file_size else None,
        field=str(path),
        expected=f"{size[0]} x {size[1]} as sensors.txt has it for {sensor_id}",
        got=f"{stored[0]} x {stored[1]}",
    )


def collect_photos(
    dataset: Dataset,
    *,
    posed: bool = True,
    with_files: bool = True,
    has_features: Callable[[str], bool] | None = None,
    with_depth: bool = False,
    depth_sensor: str | None = None,
    progress: ItemProgress,
) -> tuple[list[MappingPhoto], list[str]]:
    """Collect the usable photos and their depth maps.

    Args:
        posed: take only photos with intrinsics and a pose. Otherwise photos without them get
            guessed intrinsics (SIMPLE_RADIAL) and no pose.
        with_files: take only photos whose file exists.
        has_features: tells whether a photo, by name, has ready-made features; others are left out.
        depth_sensor: the depth sensor to use if a photo has several depth maps.
        progress: called with how many photos are done, and how many there are.

    Returns:
        The photos in the dataset's order, and notes on those left out.
    """
    wanted = _Wanted(dataset, posed, with_files, has_features)
    photos: list[MappingPhoto] = []
    left_out: dict[str, list[str]] = {}
    matcher = DepthMatcher(dataset, depth_sensor) if with_depth else None
    for done, record in enumerate(dataset.images, 1):
        why = wanted.why_not(record)
        if why is None:
            depth = matcher.match(record) if matcher else None
            if matcher and depth is None:
                left_out.setdefault("have no depth map: retrieval only", []).append(record.path)
            photos.append(_mapping_photo(dataset, record, depth, with_file=with_files))
        else:
            left_out.setdefault(why, []).append(record.path)
        progress(done, len(dataset.images))
    notes = [
        f"{len(names)} of {len(dataset.images)} photos {why}: {some(names)}"
        for why, names in left_out.items()
    ]
    if not photos:
        raise refuse(
            "dataset.no_photos",
            "no photo of the dataset can be used" + "".join(f"; {note}" for note in notes),
            field=str(dataset.root / "sensors" / "records_camera.txt"),
            expected=f"photos with {', '.join(wanted.parts())}",
        )
    return photos, notes


@dataclass(frozen=True, slots=True)
class _Wanted:
    """The parts that a photo must have, as for ``collect_photos``."""

    dataset: Dataset
    posed: bool
    with_files: bool
    has_features: Callable[[str], bool] | None

    def why_not(self, record: FileRecord) -> str | None:
        if self.with_files and not self.dataset.has_file(record):
            return "are listed, but the file is absent"
        if self.has_features is not None and not self.has_features(record.path):
            return "have no ready-made features"
        if self.posed and self.dataset.sensors[record.sensor_id].camera is None:
            return "have a camera of unknown model"
        if self.posed and self.dataset.pose(record) is None:
            return "have no pose"
        return None

    def parts(self) -> list[str]:
        return [
            *(["a file"] if self.with_files else []),
            *(["ready-made features"] if self.has_features is not None else []),
            *(["a camera of a known model", "a pose"] if self.posed else []),
        ]


def masked(
    photos: Sequence[MappingPhoto], folder: Path
) -> tuple[list[MappingPhoto], tuple[str, ...]]:
    """Give photos their masks, in COLMAP's convention: that of ``a/b.jpg`` is ``a/b.jpg.png``.

    Photos without a mask count as a whole.

    Returns:
        The photos, and a note.
    """
    found = []
    for photo in photos:
        path = folder / f"{photo.name}.png"
        if not path.is_file():
            found.append(photo)
            continue
        try:
            found.append(replace(photo, mask=path, mask_sha256=sha256_of(path)))
        except OSError as error:
            raise refuse("dataset.unreadable", field=str(path), got=error.strerror) from error
    without = [photo.name for photo in found if photo.mask is None]
    if len(without) == len(photos):
        raise refuse("masks.none", field="--masks", got=str(folder))
    if not without:
        return found, ()
    note = f"{len(without)} of {len(photos)} photos have no mask and count as a whole"
    return found, (f"{note}: {some(without)}",)


def some(names: Sequence[str]) -> str:
    """Return a few names, for a note."""
    return ", ".join(names[:_NAMED]) + (", ..." if len(names) > _NAMED else "")


def _mapping_photo(
    dataset: Dataset, record: FileRecord, depth: DepthMatch | None, *, with_file: bool
) -> MappingPhoto:
    camera = dataset.sensors[record.sensor_id].camera
    return MappingPhoto(
        record,
        dataset.path_of(record),
        _checksum(dataset, record) if with_file else None,
        camera or _guessed_camera(dataset, record),
        camera is not None,
        dataset.pose(record),
        depth,
        _checksum(dataset, depth.record) if depth else None,
    )


def _guessed_camera(dataset: Dataset, record: FileRecord) -> Camera:
    size = dataset.sensors[record.sensor_id].image_size
    assert size is not None  # every sensor of a photo has one
    width, height = size
    focal = GUESSED_FOCAL * max(width, height)
    return Camera("SIMPLE_RADIAL", width, height, (focal, width / 2, height / 2, 0.0))


def _checksum(dataset: Dataset, record: FileRecord) -> str:
    path = dataset.path_of(record)
    try:
        return sha256_of(path) if dataset.files is None else dataset.files.identity(record.path)
    except OSError as error:
        raise refuse("dataset.unreadable", field=str(path), got=error.strerror) from error
