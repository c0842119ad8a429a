"""Videos, folders of photos and exports of scanning apps as one dataset."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from mapping.importers import ImportedImage, ImportedModel, read_model
from mapping.importers.films import is_live_photo, is_video, stems_of_photos
from mapping.importers.left_out import LeftOut, notes_on
from mapping.importers.reading.photo_names import natural_order, photo_size
from mapping.importers.recognized import importer_of
from mapping.methods.sparse.intrinsics import FROM_EXIF
from mapping.progress import Progress
from mapping.stages.work_folder import WorkFolder
from visloc.errors import DatasetError, VislocError, refuse
from visloc.geometry import Camera
from visloc.kapture import GnssRecord, Sensor
from visloc.kapture.dataset import UNKNOWN_CAMERA
from visloc.photos.file_kinds import kind_of
from visloc_extensions.capture.frames import FilmedVideo, study_video, write_photos
from visloc_extensions.films.video import SUFFIXES

_EXPORT, _NERFSTUDIO = "transforms.json", "nerfstudio"
_GNSS = "gnss"
# A video whose frames end so long before the end that it states may have been cut.
_CUT_S = 1.0
# Why a video that was found in a folder is left out, and one that was named is refused.
_UNUSABLE = ("capture.still", "capture.video", "capture.video_size", "capture.video_length")


@dataclass(frozen=True, slots=True)
class Sources:
    """What was named, by kind; each by the name that its photos have in the map.

    Attributes:
        exports: scans of apps, and folders or files of nerfstudio's format, with their importers.
        found: names of the videos that were found in folders.
        left_out: videos of folders that cannot be used, by reason.
    """

    videos: Mapping[str, Path]
    folders: Mapping[str, Path]
    exports: Mapping[str, tuple[str, Path]]
    found: Set[str] = frozenset()
    left_out: LeftOut = field(default_factory=dict)


def find_sources(paths: Sequence[Path]) -> Sources:
    """Tell videos, folders of photos, and exports apart; videos in folders count too.

    What is named twice counts once, such as a video and the folder that it lies in. Films of Live
    Photos do not count: the photos beside them do.
    """
    videos: dict[str, Path] = {}
    folders: dict[str, Path] = {}
    exports: dict[str, tuple[str, Path]] = {}
    found: set[str] = set()
    taken: set[str] = set()
    counted: set[str] = set()
    for path in paths:
        if not path.exists():
            raise refuse("capture.source", field=str(path))
        app = importer_of(path)
        is_export = path.is_dir() and (path / _EXPORT).is_file()
        # Unlike Path.resolve, this does not raise for a link that leads to itself.
        place = os.path.realpath(path / _EXPORT if is_export else path)
        if place in counted:
            continue
        counted.add(place)
        if app is not None:
            exports[_new_name(path.resolve().name, taken)] = app, path
        elif is_export:
            exports[_new_name(path.resolve().name, taken)] = _NERFSTUDIO, path
        elif path.is_dir():
            folders[_new_name(path.resolve().name, taken)] = path
            files = sorted(path.iterdir(), key=lambda file: natural_order(file.name))
            stems = stems_of_photos(file.name for file in files)
            for file in files:
                is_one = file.suffix.lower() in SUFFIXES and _is_plain(file) and is_video(file)
                if not is_one or is_live_photo(file, stems):
                    continue
                if (place := os.path.realpath(file)) not in counted:
                    counted.add(place)
                    name = _new_name(file.stem, taken)
                    videos[name] = file
                    found.add(name)
        elif path.suffix.lower() == ".json" and path.is_file():  # a pipe would never end
            exports[_new_name(path.resolve().parent.name, taken)] = _NERFSTUDIO, path
        elif path.is_file() and is_video(path):
            videos[_new_name(path.stem, taken)] = path
        else:
            kind = kind_of(path) if path.is_file() else None  # a pipe would never end
            got = "another kind of file" if kind is None else kind.name
            expected = f"a video; {kind.refusal}" if kind is not None and kind.advice else None
            raise refuse("capture.video", field=str(path), got=got, expected=expected)
    return Sources(videos, folders, exports, found)


def study_videos(
    sources: Sources,
    work: WorkFolder,
    most: int,
    wanted: Mapping[str, Sequence[float]],
    progress: Progress,
) -> tuple[Sources, dict[str, FilmedVideo]]:
    """Look through all videos, and choose frames.

    Args:
        most: frames of each video.
        wanted: seconds by name of the video whose frames are taken in any case.

    Returns:
        The sources without the videos of folders that cannot be used, and the others by name.
    """
    studied: dict[str, FilmedVideo] = {}
    left_out: dict[str, list[str]] = {}
    for name, path in sources.videos.items():
        told = partial(progress, f"look through {name}")
        try:
            studied[name] = study_video(path, work, most, wanted.get(name, ()), told)
        except VislocError as error:
            if name not in sources.found or error.code not in _UNUSABLE:
                raise
            reason = error.message + (f": {error.got}" if error.code != "capture.still" else "")
            left_out.setdefault(reason, []).append(f"{path.parent.resolve().name}/{path.name}")
    videos = {name: sources.videos[name] for name in studied}
    return replace(sources, videos=videos, left_out=left_out), studied


def read_capture(
    sources: Sources, videos: Mapping[str, FilmedVideo], work: Path, progress: Progress
) -> ImportedModel:
    """Write the frames of videos, and join all sources into one model with one folder of photos."""
    photos = work / "photos"
    shutil.rmtree(photos, ignore_errors=True)  # links only
    photos.mkdir(parents=True)
    parts: dict[str, ImportedModel] = {}
    for name, video in videos.items():
        folder = work / "frames" / video.sha256[:32]
        write_photos(video, folder, partial(progress, f"frames of {name}"))
        parts[name] = _video_model(video, folder)
    for name, path in sources.folders.items():
        if (model := _read_folder(path, progress, sources)) is not None:
            parts[name] = model
    for name, (importer, path) in sources.exports.items():
        written = work / "scans" / name  # the photos and depth maps of a scan
        written.mkdir(parents=True, exist_ok=True)
        into = None if importer == _NERFSTUDIO else written
        parts[name] = read_model(importer, path, into, progress)
    if not parts:
        raise refuse(
            "import.empty",
            "; ".join(["there are neither photos nor videos to use", *notes_on(sources.left_out)]),
            field=", ".join(map(str, sources.folders.values())),
            expected="photos, or videos filmed while walking",
        )
    for name, model in parts.items():
        assert model.photos is not None
        (photos / name).symlink_to(model.photos.resolve())
    return _joined(parts, photos, sources.left_out)


def _read_folder(path: Path, progress: Progress, sources: Sources) -> ImportedModel | None:
    try:
        model = read_model("images", path, None, progress)
    except DatasetError as error:
        if error.code == "import.empty" and (sources.videos or sources.left_out):
            return None  # a folder of videos
        raise
    # What became of its videos is told elsewhere.
    folder = path.resolve()
    looked_at = {str(video.resolve()) for video in sources.videos.values()}
    looked_at |= {str(folder.parent / one) for names in sources.left_out.values() for one in names}
    left_out = {
        reason: others
        for reason, names in model.left_out.items()
        if (others := [name for name in names if str(folder / name) not in looked_at])
    }
    return replace(model, left_out=left_out)


def _video_model(video: FilmedVideo, folder: Path) -> ImportedModel:
    size = photo_size(folder / video.names[0])  # upright, unlike the video's
    assert size is not None  # it was written here
    width, height = size
    focal = video.facts.focal_length_px
    if focal is None:
        params = (UNKNOWN_CAMERA, str(width), str(height))
        sensor = Sensor("camera", video.facts.device, "camera", params, None)
    else:
        camera = Camera("SIMPLE_RADIAL", width, height, (focal, width / 2, height / 2, 0.0))
        name = f"{video.facts.device} {FROM_EXIF}".lstrip()
        sensor = Sensor.with_camera("camera", camera, name=name)
    images = tuple(ImportedImage(name, "camera", i, None) for i, name in enumerate(video.names))
    return ImportedModel({"camera": sensor}, images, folder, notes=_notes_on(video))


def _notes_on(video: FilmedVideo) -> tuple[str, ...]:
    facts, name, end = video.facts, video.path.name, float(video.motion.seconds[-1])
    notes = []
    if facts.seconds > end + _CUT_S:
        notes.append(
            f"{name} ends after {end:.1f} s and says that it lasts {facts.seconds:.1f} s: it may "
            "have been cut while it was copied"
        )
    if facts.position is not None:
        latitude, longitude, _ = facts.position
        notes.append(
            f"{name} says where it began ({latitude:.5f}, {longitude:.5f}); one position "
            "does not tell how the map lies on Earth"
        )
    return tuple(notes)


def _joined(
    parts: Mapping[str, ImportedModel], photos: Path, videos_left_out: LeftOut
) -> ImportedModel:
    """Join models: names below the part's, sensors with its name, timestamps one after another."""
    sensors: dict[str, Sensor] = {}
    images: list[ImportedImage] = []
    gnss: list[GnssRecord] = []
    left_out = {reason: list(names) for reason, names in videos_left_out.items()}
    notes: list[str] = []
    start, posed = 0, ""
    for name, model in parts.items():
        for sensor in model.sensors.values():
            new_id = _GNSS if sensor.kind == "gnss" else f"{name}-{sensor.id}"
            sensors[new_id] = replace(sensor, id=new_id)
        has_poses = any(image.cam_from_world is not None for image in model.images)
        if has_poses and posed:
            notes.append(f"the poses of {name} are in another frame than those of {posed}: unused")
        keeps = has_poses and not posed
        posed = name if keeps else posed
        images += [
            replace(
                image,
                name=f"{name}/{image.name}",
                sensor=f"{name}-{image.sensor}",
                timestamp=image.timestamp + start,
                cam_from_world=image.cam_from_world if keeps else None,
                depth=None if image.depth is None else f"{name}/{image.depth}",
            )
            for image in model.images
        ]
        gnss += [
            replace(fix, timestamp=fix.timestamp + start, sensor_id=_GNSS) for fix in model.gnss
        ]
        left_out |= {
            reason: [*left_out.get(reason, ()), *(f"{name}/{one}" for one in names)]
            for reason, names in model.left_out.items()
        }
        notes += model.notes
        start += max(image.timestamp for image in model.images) + 1
    metric = bool(posed) and parts[posed].metric
    return ImportedModel(
        sensors,
        tuple(images),
        photos,
        gnss=tuple(gnss),
        metric=metric,
        notes=tuple(notes),
        left_out=left_out,
    )


def _is_plain(path: Path) -> bool:
    return path.is_file() and not path.is_symlink() and not path.name.startswith(".")


def _new_name(name: str, taken: set[str]) -> str:
    """A name that is not taken, of letters that names of photos and sensors may have."""
    clean = "".join(c if c.isalnum() or c in "-_." else "_" for c in name).strip(".") or "source"
    new, number = clean, 2
    while new.lower() in taken:
        new, number = f"{clean}-{number}", number + 1
    taken.add(new.lower())
    return new
