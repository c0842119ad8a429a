"""Names of photos in foreign files: absolute, climbing, with backslashes; and photos' sizes."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath
from typing import TypeVar

from PIL import Image

from visloc.errors import InvalidInput, refuse
from visloc.kapture.text import has_control_characters, is_field
from visloc.photos.formats import PhotoHeader, open_header
from visloc.photos.reading import size_as_read

T = TypeVar("T")

_DIGITS = re.compile(r"([0-9]+)")
_SWAPPING = (5, 6, 7, 8)  # EXIF orientations
_WINDOWS_DRIVE = re.compile(r"[A-Za-z]:/")


def photo_names(
    raw: Sequence[tuple[str, str]], base: Path, photos: Path
) -> tuple[list[str], tuple[str, ...]]:
    """Make the names of photos relative to their folder.

    A relative name stays when there is such a photo. Else, what it means from ``base`` counts: if
    that lies in ``photos``, the part below it is the name. An absolute name or one that climbs out
    with ``..`` is shortened where that is not so: to its longest end that is such a photo, or else
    to its last part. Any other stays.

    Args:
        raw: each photo's name and where it stands.
        base: the folder that relative names of the format count from.

    Returns:
        The names, with forward slashes, and notes.
    """
    folder = _absolute(photos)
    names: list[str] = []
    places: dict[str, str] = {}
    shortened: list[str] = []
    for text, where in raw:
        name, is_shortened = _relative(text, base, photos, folder)
        if is_shortened:
            shortened.append(text)
        if name in ("", ".", "..") or not is_field(name) or has_control_characters(text):
            raise refuse("import.photo_name", field=where, got=repr(text))
        if name in places:
            raise refuse(
                "import.photo_name",
                f"two photos have the name {name!r}; the other one is at {places[name]}",
                field=where,
                expected="different names below the folder of photos",
                got=text,
            )
        places[name] = where
        names.append(name)
    if not shortened:
        return names, ()
    return names, (
        f"{len(shortened)} photo names lead out of the folder of photos; their end was "
        f"taken: {', '.join(shortened[:3])}" + (", ..." if len(shortened) > 3 else ""),
    )


def _relative(text: str, base: Path, photos: Path, folder: str) -> tuple[str, bool]:
    """Return a name relative to ``photos`` (absolute: ``folder``), and whether it was shortened."""
    slashed = text.replace("\\", "/")
    is_absolute = slashed.startswith("/") or _WINDOWS_DRIVE.match(slashed) is not None
    plain = os.path.normpath(slashed) if slashed else ""
    leads_out = is_absolute or plain.split("/", 1)[0] == ".."
    full = PurePosixPath(plain if is_absolute else _absolute(base, plain))
    is_inside = full.is_relative_to(folder) and full != PurePosixPath(folder)
    if is_inside and (leads_out or (not _is_file(photos / plain) and _is_file(Path(full)))):
        return full.relative_to(folder).as_posix(), False
    if not leads_out:
        return plain, False
    ends = ("/".join(full.parts[start:]) for start in range(1, len(full.parts)))
    return next((end for end in ends if _is_file(photos / end)), full.name), True


def natural_order(name: str) -> tuple[tuple[int, str], ...]:
    """Return the key that sorts ``frame_2.jpg`` before ``frame_10.jpg``."""
    key = []
    for at, part in enumerate(_DIGITS.split(name)):
        number = part.lstrip("0")  # the longer is the greater; int() refuses very long ones
        key.append((len(number), number) if at % 2 else (0, part))
    return (*key, (0, name))


def photo_size(path: Path) -> tuple[int, int] | None:
    """Return (width, height) from a photo's header, None if there is no such file."""
    return _header(path).size if _is_file(path) else None


def photo_size_as_read(path: Path) -> tuple[int, int] | None:
    """Return the size in which a build reads a photo, None if there is no such file.

    It is smaller than ``photo_size`` for a photo of very many pixels.
    """
    return _told(path, lambda: size_as_read(path)) if _is_file(path) else None


def is_stored_turned(path: Path) -> bool:
    """Tell whether EXIF says that width and height swap when the photo is turned upright."""
    return _header(path).exif_orientation in _SWAPPING


def _header(path: Path) -> PhotoHeader:
    return _told(path, lambda: open_header(path.read_bytes(), str(path)))


def _told(path: Path, look: Callable[[], T]) -> T:
    try:
        return look()
    except InvalidInput as error:
        raise refuse("import.photo", error.message, field=str(path), got=error.got) from error
    except (OSError, Image.DecompressionBombError) as error:
        raise refuse("import.photo", field=str(path), got=str(error)) from error


def _is_file(path: Path) -> bool:
    return os.path.isfile(path)  # noqa: PTH113 - Path.is_file raises for names that cannot be


def _absolute(folder: Path, name: str = "") -> str:
    # Without following links, on which relative names in these files do not depend.
    return os.path.abspath(folder / name)  # noqa: PTH100
