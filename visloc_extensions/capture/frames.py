"""The chosen frames of a video as photo files, found again after an interruption."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapping.progress import ItemProgress
from mapping.stages.work_folder import WorkFolder, key_of
from visloc.archive import sha256_of
from visloc.errors import refuse
from visloc_extensions.capture.choosing import ChosenFrames, choose_frames
from visloc_extensions.capture.motion import Motion, measure_motion
from visloc_extensions.films.video import Frame, VideoFacts, frames_of, video_facts, write_jpeg

_REVISION = 1


@dataclass(frozen=True, slots=True, eq=False)
class FilmedVideo:
    """A video and the frames of it that become photos.

    Attributes:
        sha256: of the file.
        motion: of all frames.
        chosen: the frames that become photos.
    """

    path: Path
    sha256: str
    facts: VideoFacts
    motion: Motion
    chosen: ChosenFrames

    @property
    def names(self) -> list[str]:
        """Names of the photos: when each was taken, which sorts as they were."""
        return [photo_name(second) for second in self.motion.seconds[self.chosen.rows].tolist()]


def photo_name(seconds: float) -> str:
    """Return the name of the photo of a frame, such as ``00012.345s.jpg``."""
    milliseconds = round(seconds * 1000)
    return f"{milliseconds // 1000:05d}.{milliseconds % 1000:03d}s.jpg"


def study_video(
    path: Path, work: WorkFolder, most: int, wanted_s: Sequence[float], progress: ItemProgress
) -> FilmedVideo:
    """Look through a video once and choose its frames."""
    facts = video_facts(path)
    whole = max(1, round(facts.seconds))
    progress(0, whole)  # reading a long video once takes a while, too
    sha256 = sha256_of(path)

    def measured() -> dict[str, NDArray[np.float64]]:
        motion = measure_motion(_told(path, whole, progress))
        return {"seconds": motion.seconds, "sharpness": motion.sharpness, "path": motion.path}

    motion = Motion(**work.get(key_of("motion", _REVISION, video=sha256), measured))
    progress(whole, whole)
    if len(motion.seconds) == 0:
        raise refuse("capture.video", field=str(path), got="no frame that can be decoded")
    chosen = choose_frames(motion, most, wanted_s)
    if len(chosen.rows) < 2:
        raise refuse("capture.still", field=str(path), got=f"{len(motion.seconds)} frames")
    return FilmedVideo(path, sha256, facts, motion, chosen)


def write_photos(video: FilmedVideo, folder: Path, progress: ItemProgress) -> None:
    """Write the chosen frames upright into a folder; those that are there already stay."""
    folder.mkdir(parents=True, exist_ok=True)
    names = dict(zip(video.motion.seconds[video.chosen.rows].tolist(), video.names, strict=True))
    missing = {time: name for time, name in names.items() if not (folder / name).is_file()}
    done = len(names) - len(missing)
    progress(done, len(names))
    if not missing:
        return
    for frame in frames_of(video.path):
        if (name := missing.pop(frame.seconds, None)) is not None:
            write_jpeg(folder / name, frame.upright_rgb())
            done += 1
            progress(done, len(names))
        if not missing:
            return


def _told(path: Path, whole: int, progress: ItemProgress) -> Iterator[Frame]:
    """The frames of a video; progress is in seconds of it."""
    for frame in frames_of(path):
        progress(min(int(frame.seconds), whole - 1), whole)
        yield frame
