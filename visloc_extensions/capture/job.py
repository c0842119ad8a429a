"""From videos, photos and exports to a published map: existing stages, one after another."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from mapping.cluster.stage_timings import Costs
from mapping.cluster.storage import storage_failed
from mapping.cluster.workers import Workers
from mapping.frames.known_length import KnownLength, photo_named
from mapping.importers import ImportedModel, write_imported
from mapping.methods.sfm_settings import SfmSettings
from mapping.pairing import PairSettings
from mapping.pipeline.build import build_map, refuse_existing_map
from mapping.pipeline.pieces import refuse_long_id
from mapping.pipeline.settings import BuildSettings
from mapping.progress import Progress, not_told
from mapping.stages.networks import Networks
from mapping.stages.photos import collect_photos
from mapping.stages.work_folder import WorkFolder, exclusive
from visloc.archive import Map, MapStore
from visloc.archive.schema import Doubt
from visloc.errors import VislocError, refuse
from visloc.features.local.readymade import is_ready_made
from visloc.kapture import read_dataset
from visloc.options import Inference
from visloc_extensions.capture.frames import FilmedVideo, photo_name
from visloc_extensions.capture.markers import find_markers, grey_photos
from visloc_extensions.capture.placing import Yardstick, place
from visloc_extensions.capture.settings import CaptureSettings
from visloc_extensions.capture.sources import Sources, find_sources, read_capture, study_videos
from visloc_extensions.capture.trying import doubts_of_capture, lost_size

# Rough: 14 photos of 1600 x 900 took five seconds of one core each, smaller ones less; incremental
# mapping grows faster than their number. Bytes are of the work folder, and of memory.
_S_PER_PHOTO, _S_PER_PHOTO_SQUARED = 5.0, 0.004
_DISK_PER_PHOTO, _MEMORY, _MEMORY_PER_PHOTO = 5 * 2**20, 2**30, 4 * 2**20
# Frames are chosen so that each overlaps its nearest six on either side.
_TOP_K = 12
# A frame is shown for less than that.
_PAST_END_S = 1.0
# Refusals of photos that do not join, and what would.
_NOT_JOINED = ("sfm.no_matches", "sfm.no_model", "sfm.no_points")
_NO_MAP = "the photos do not show enough of the same to become a map"
_OVERLAP = (
    "a film, or a dozen photos or more, in which each view overlaps the next, taken while walking, "
    "not turning"
)
# Says which versions there were when a capture began.
_BEGUN = "begun.json"


@dataclass(frozen=True, slots=True)
class Outlook:
    """The estimated cost of a capture, shown before the long work.

    Attributes:
        minutes: an estimate.
        memory_bytes: an estimate of the peak.
        disk_bytes: an estimate of the work folder, which is removed at the end.
        free_bytes: of the disk.
    """

    photos: int
    minutes: float
    memory_bytes: int
    disk_bytes: int
    free_bytes: int


@dataclass(frozen=True, slots=True, eq=False)
class Captured:
    """A capture that became a map.

    Attributes:
        videos: by the name that their photos have in the map.
        photos: names of all photos that were tried.
        notes: on what was left out of the sources or assumed.
        work: folder of what a killed run finds again; ``forget`` removes it.
    """

    folder: Path
    videos: Mapping[str, FilmedVideo]
    photos: Sequence[str]
    notes: Sequence[str]
    work: Path

    def forget(self) -> None:
        """Remove what a killed run would find again, once all is told."""
        shutil.rmtree(self.work, ignore_errors=True)


def capture_map(
    settings: CaptureSettings,
    progress: Progress,
    announce: Callable[[Outlook], None],
    costs: Costs | None = None,
) -> Captured:
    """Make a map of videos, photos and exports, and publish it.

    If it is killed, the same call finds its finished work again. A call whose map is published, and
    which ``Captured.forget`` did not end, returns that map.
    """
    length, marker_m = settings.known_length, settings.marker_m
    if length is not None and marker_m is not None:
        raise refuse("capture.two_scales", field="--marker-size")
    store = MapStore(settings.maps_dir)
    sources = find_sources(settings.sources)
    _open_networks(settings)
    # Ids begin with a letter or digit: no work folder of a build has this name.
    root = settings.maps_dir / ".work" / f".capture-{settings.map_id}"
    with _told_of_the_disk(root), exclusive(root.with_name(f"{root.name}.lock")):
        finished = _published_before(settings, root, store)
        if finished is None:
            refuse_existing_map(settings.map_id, store, force=settings.force)
            if sources.videos or sources.folders:  # their photos have no poses
                refuse_long_id(settings.map_id)
            _begin(settings, root, store)
        wanted = _wanted_seconds(length, sources)
        work = WorkFolder(root)
        sources, studied = study_videos(sources, work, settings.photos, wanted, progress)
        model = read_capture(sources, studied, root, progress)
        names = tuple(image.name for image in model.images)
        yardstick = Yardstick(_resolved(length, sources, studied, names), marker_m=marker_m)
        if finished is not None:
            return Captured(finished, studied, names, model.notes, root)
        announce(_outlook(len(names), settings.workers, root))
        dataset = root / "dataset"
        shutil.rmtree(dataset, ignore_errors=True)  # of a capture that was killed
        notes = write_imported(model, dataset)
        if marker_m is not None:
            yardstick = _with_markers(dataset, marker_m, progress)

        def examine(opened: Map) -> tuple[Doubt, ...]:
            of_capture = doubts_of_capture(opened, studied, _measured(yardstick))
            return (*of_capture, *lost_size(opened, store))

        with _told_of_a_capture(notes):
            folder = build_map(
                _build_settings(settings, model, dataset),
                progress,
                costs,
                partial(place, yardstick),
                examine,
            )
    return Captured(folder, studied, names, notes, root)


def _open_networks(settings: CaptureSettings) -> None:
    """Open what the build will need, as it looks for weights only after minutes of video."""
    networks = Networks(settings.weights_dir, Inference.AUTO)
    for name in settings.global_features:
        if not is_ready_made(name):
            networks.descriptor(name)
    with Workers(settings.workers) as workers:
        workers.run_here(networks.properties, [settings.local_features], not_told)


@contextmanager
def _told_of_the_disk(root: Path) -> Iterator[None]:
    """Refuse with the file when one cannot be read or written."""
    try:
        yield
    except OSError as error:
        raise storage_failed(error, root) from error


@contextmanager
def _told_of_a_capture(notes: Sequence[str]) -> Iterator[None]:
    """Let a refusal tell what was left out, and what to film instead of options of other commands.

    The notes become those of the exception.
    """
    try:
        yield
    except VislocError as error:
        told = _in_words_of_a_capture(error)
        for note in notes:
            told.add_note(note)
        raise told from error.__cause__


def _in_words_of_a_capture(error: VislocError) -> VislocError:
    if error.code not in _NOT_JOINED:
        return error
    return refuse(error.code, _NO_MAP, field="SOURCE", expected=_OVERLAP, got=error.got)


def _published_before(settings: CaptureSettings, root: Path, store: MapStore) -> Path | None:
    """The version that this capture published before it was killed."""
    try:
        begun = json.loads((root / _BEGUN).read_text())
        if begun["settings"] != _told(settings):
            return None
        new = [one for one in store.versions(settings.map_id) if one not in begun["versions"]]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return store.folder(f"{settings.map_id}@{new[-1]}") if new else None


def _begin(settings: CaptureSettings, root: Path, store: MapStore) -> None:
    """Note which versions there are before this capture."""
    root.mkdir(parents=True, exist_ok=True)
    begun = {"settings": _told(settings), "versions": store.versions(settings.map_id)}
    (root / _BEGUN).write_text(json.dumps(begun))


def _told(settings: CaptureSettings) -> str:
    """What was asked for: the same again goes on, another begins anew.

    A video that was filmed again under the same name is another.
    """
    files = []
    for source in settings.sources:
        path = source.resolve()
        for each in sorted(path.rglob("*")) if path.is_dir() else [path]:
            state = each.lstat()
            files.append((str(each), state.st_size, state.st_mtime_ns))
    return repr((files, replace(settings, sources=[], workers=1)))


def _measured(yardstick: Yardstick) -> tuple[str, ...]:
    return () if yardstick.length is None else yardstick.length[:2]


def _build_settings(
    settings: CaptureSettings, model: ImportedModel, dataset: Path
) -> BuildSettings:
    method, sfm, metric = "sfm", SfmSettings(), model.metric
    if all(image.cam_from_world is not None for image in model.images):
        method = "rgbd" if any(image.depth is not None for image in model.images) else "sfm"
    else:
        # Neighbours in a film overlap; retrieval closes loops and joins several films.
        pairs = ("sequence", "retrieval") if _has_sequence(model) else ("retrieval",)
        # A focal length from EXIF or a container is a start, not a calibration.
        sfm = SfmSettings(
            pairs=pairs,
            pairing=PairSettings(top_k=_TOP_K),
            poses="estimate",
            refine=("intrinsics",),
        )
    return BuildSettings(
        dataset=dataset,
        map_id=settings.map_id,
        maps_dir=settings.maps_dir,
        method=method,
        local_features=settings.local_features,
        global_features=settings.global_features,
        weights_dir=settings.weights_dir,
        max_keypoints=settings.max_keypoints,
        metric=metric,
        sfm=sfm,
        workers=settings.workers,
        accept=settings.accept,
        force=settings.force,
    )


def _has_sequence(model: ImportedModel) -> bool:
    """Whether some camera took two photos."""
    sensors = [image.sensor for image in model.images]
    return len(set(sensors)) < len(sensors)


def _wanted_seconds(length: KnownLength | None, sources: Sources) -> dict[str, list[float]]:
    """Seconds of videos whose frames ``--scale`` names, by the video's name."""
    wanted: dict[str, list[float]] = {}
    for text in () if length is None else length.photos:
        if (found := _moment(text, sources)) is not None:
            wanted.setdefault(found[0], []).append(found[1])
    return wanted


def _moment(text: str, sources: Sources) -> tuple[str, float] | None:
    """The video's name and the seconds of ``VIDEO@SECONDS``; None for another text."""
    video, at, seconds = text.rpartition("@")
    names = [n for n, path in sources.videos.items() if video in (n, path.name, str(path))]
    try:
        second = float(seconds)
    except ValueError:
        return None
    is_one = at and len(names) == 1 and 0.0 <= second < math.inf  # False for NaN
    return (names[0], second) if is_one else None


def _resolved(
    length: KnownLength | None,
    sources: Sources,
    videos: Mapping[str, FilmedVideo],
    names: Sequence[str],
) -> tuple[str, str, float] | None:
    """The photos that ``--scale`` names."""
    if length is None:
        return None
    found = []
    for text in length.photos:
        if (moment := _moment(text, sources)) is not None:
            name, second = moment
            motion = videos[name].motion
            if second > (end := float(motion.seconds[-1])) + _PAST_END_S:
                raise refuse("capture.photo", field="--scale", got=f"{text}: it ends at {end:.1f}")
            times = motion.seconds[videos[name].chosen.rows]
            found.append(f"{name}/{photo_name(float(times[abs(times - second).argmin()]))}")
            continue
        found.append(photo_named(text, names))
    if found[0] == found[1]:
        raise refuse("capture.photo", field="--scale", got=f"{found[0]} for both")
    return found[0], found[1], length.metres


def _with_markers(dataset: Path, marker_m: float, progress: Progress) -> Yardstick:
    """Look for markers before the long work."""
    photos, _ = collect_photos(
        read_dataset(dataset), posed=False, progress=partial(progress, "photos")
    )
    sightings = find_markers(grey_photos(photos), len(photos), partial(progress, "markers"))
    if not sightings:
        raise refuse("capture.no_markers", field="--marker-size")
    return Yardstick(sightings=sightings, marker_m=marker_m)


def _outlook(photos: int, workers: int, folder: Path) -> Outlook:
    seconds = photos * _S_PER_PHOTO / workers + photos**2 * _S_PER_PHOTO_SQUARED
    return Outlook(
        photos=photos,
        minutes=seconds / 60.0,
        memory_bytes=_MEMORY + photos * _MEMORY_PER_PHOTO,
        disk_bytes=photos * _DISK_PER_PHOTO,
        free_bytes=shutil.disk_usage(folder).free,
    )
