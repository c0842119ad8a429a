"""Text rules of kapture's files: comma-separated fields without quoting."""

from __future__ import annotations

import re
import unicodedata
from pathlib import PurePosixPath

_WINDOWS_DRIVE = re.compile(r"[A-Za-z]:")


def relative_path(text: str) -> str:
    """Normalize the path of a record or image to forward slashes, without ``.`` or doubled ones."""
    path = PurePosixPath(text.replace("\\", "/"))
    if (
        path.is_absolute()
        or not path.parts
        or ".." in path.parts
        or _WINDOWS_DRIVE.match(text)
        or has_control_characters(text)
    ):
        raise ValueError(text)
    return path.as_posix()


def plain_name(text: str) -> str:
    """Return the name of a photo without ``./``; what is no relative path, so no name, stays."""
    try:
        return relative_path(text)
    except ValueError:
        return text


def has_control_characters(text: str) -> bool:
    """Tell whether a text has line breaks, tabs, NUL or lone surrogates."""
    return not text.isprintable() and any(unicodedata.category(c) in ("Cc", "Cs") for c in text)


def is_field(text: str) -> bool:
    """Tell whether a text can be one field, which reading returns unchanged."""
    return text == text.strip() and "," not in text and not has_control_characters(text)


def is_path_field(text: str) -> bool:
    """Tell whether a text can be one field, which reading as the path of a photo returns."""
    try:
        return is_field(text) and relative_path(text) == text
    except ValueError:
        return False


def is_folder_name(text: str) -> bool:
    """Tell whether a text can be the name of a folder, such as a feature type."""
    return is_field(text) and text not in ("", ".", "..") and not set(text) & set("/\\:")
