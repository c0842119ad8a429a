"""Films, opened safely, and those that a phone takes around a photo.

Files are hostile. The demuxer is chosen by the first bytes and reads from an open file, so that no
playlist or reference leads elsewhere; sizes are refused before a frame is decoded.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Set
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import av
from av.container import InputContainer
from av.error import FFmpegError
from av.video.stream import VideoStream

from visloc.errors import VislocError, refuse
from visloc.photos.file_kinds import HEAD_BYTES, file_kind, kind_of
from visloc.photos.formats import SUFFIXES as PHOTO_SUFFIXES
from visloc.photos.reading import ImageLimits

# Demuxers by kind of file (visloc.photos.file_kinds).
_DEMUXERS = {"MP4": "mov", "3GP": "mov", "MOV": "mov", "Matroska or WebM": "matroska"}
_MAX_PIXELS = ImageLimits().max_pixels
_PIXELS_OPTION = str(_MAX_PIXELS)
_MIN_SIDE = 64
# A box of an MP4 has at least its size and kind. Films that are whole have about five.
_BOX_BYTES, _MOST_BOXES = 8, 1000
# Width by height of a pixel: DV, DVD and anamorphic lenses have 0.7 to 2. Less than the least is no
# whole pixel in a row.
_WIDEST_PIXEL, _LEAST_STRETCH = 4.0, 0.0005
# A phone films about three seconds around a photo; edited ones may be longer.
_LONGEST_LIVE_S = 5.0


def is_video(path: Path) -> bool:
    """Tell a video that is read here by its first bytes."""
    kind = kind_of(path)
    return kind is not None and kind.name in _DEMUXERS


def stems_of_photos(names: Iterable[str]) -> frozenset[str]:
    """Return the stems of the photos among names of files, for ``is_live_photo``."""
    paths = (Path(name.lower()) for name in names)
    return frozenset(path.stem for path in paths if path.suffix in PHOTO_SUFFIXES)


def is_live_photo(path: Path, stems: Set[str]) -> bool:
    """Tell the film that a phone takes around a photo, by its length and the photo's name.

    Args:
        stems: of the photos in the same folder, as ``stems_of_photos``.
    """
    stem, name = path.stem.lower(), path.name.lower()
    if not stems & {stem, stem.removesuffix("_hevc"), name} or not is_video(path):
        return False
    try:
        with opened_film(path) as (container, _):
            return bool((container.duration or 0) / av.time_base <= _LONGEST_LIVE_S)
    except VislocError:
        return False


@contextmanager
def opened_film(path: Path) -> Iterator[tuple[InputContainer, VideoStream]]:
    """Open a film, and give the track to read."""
    with path.open("rb") as file:
        kind = file_kind(file.read(HEAD_BYTES))
        file.seek(0)
        demuxer = None if kind is None else _DEMUXERS.get(kind.name)
        if demuxer is None:
            raise refuse("capture.video", field=str(path), got=kind.name if kind else "other bytes")
        try:
            # Opening decodes the first frames to learn of the streams.
            container = av.open(file, "r", format=demuxer, options={"max_pixels": _PIXELS_OPTION})
        except (FFmpegError, ValueError, UnicodeError) as error:
            if demuxer == "mov" and _is_cut(path):
                cut = "a file that ends too early: copy it again"
                raise refuse("capture.video", field=str(path), got=cut) from error
            raise unreadable_film(path, error) from error
        with container:
            if not container.streams.video:
                raise refuse("capture.video", field=str(path), got="no video track")
            stream = _film_track(container)
            _check_size(path, stream)
            stream.thread_type = "AUTO"
            try:
                yield container, stream
            except FFmpegError as error:
                raise unreadable_film(path, error) from error


def _film_track(container: InputContainer) -> VideoStream:
    """Choose the track of the film: others may be its cover picture or a smaller copy.

    Of the tracks with about as many frames as any, it is the one of most pixels. Where the
    container does not count frames, as Matroska, FFmpeg chooses.
    """
    tracks = container.streams.video
    most = max(track.frames for track in tracks)
    best = container.streams.best("video")
    if most == 0 and isinstance(best, VideoStream):
        return best
    full = [track for track in tracks if 2 * track.frames >= most]
    return max(full, key=lambda track: track.codec_context.width * track.codec_context.height)


def _is_cut(path: Path) -> bool:
    """Tell whether the last box of an MP4 is longer than what is left of the file.

    ISO/IEC 14496-12, section 4.2: a box begins with its size in four bytes, or in eight after its
    kind; 0 stands for the rest of the file.
    """
    left = path.stat().st_size
    with path.open("rb") as file:
        for _ in range(_MOST_BOXES):
            head = file.read(16)
            size = int.from_bytes(head[8:16] if head[:4] == b"\0\0\0\1" else head[:4])
            if size > left > 0:
                return True
            if size < _BOX_BYTES:
                return False
            file.seek(size - len(head), os.SEEK_CUR)
            left -= size
    return False


def square_size(path: Path, stream: VideoStream) -> tuple[int, int]:
    """Return width and height after pixels became square: none is lost, the short side grows."""
    width, height = stream.codec_context.width, stream.codec_context.height
    aspect = float(stream.sample_aspect_ratio or 1)
    if not 1 / _WIDEST_PIXEL <= aspect <= _WIDEST_PIXEL:
        got = f"pixels that are {Fraction(aspect).limit_denominator(1000)} as wide as high"
        raise refuse("capture.video", field=str(path), got=got)
    if abs(aspect - 1) < _LEAST_STRETCH:
        return width, height
    return (round(width * aspect), height) if aspect > 1 else (width, round(height / aspect))


def _check_size(path: Path, stream: VideoStream) -> None:
    context = stream.codec_context
    if min(context.width, context.height) < _MIN_SIDE:
        raise refuse("capture.video", field=str(path), got=f"{context.width} x {context.height}")
    width, height = square_size(path, stream)
    if width * height > _MAX_PIXELS:
        raise refuse("capture.video_size", field=str(path), got=f"{width}x{height}")
    # A frame may claim another size than its track; the decoder then refuses it.
    context.options = {"max_pixels": _PIXELS_OPTION}


def unreadable_film(path: Path, error: Exception) -> VislocError:
    """Return the refusal of a film that FFmpeg cannot read."""
    return refuse("capture.video", field=str(path), got=str(error) or type(error).__name__)
