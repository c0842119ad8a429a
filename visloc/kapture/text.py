"""The text rules that kapture's files share: comma-separated fields without quoting."""

from __future__ import annotations

import re
import unicodedata
from pathlib import PurePosixPath

_WINDOWS_DRIVE = re.compile(r"[A-Za-z]:")


def relative_path(text: str) -> str:
    """Normalize the path of a record or image to forward slashes, without ``.`` or doubled ones.

    Raises:
        ValueError: if it is empty, absolute, climbs with ``..`` or has control characters.
    """
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


def has_control_characters(text: str) -> bool:
    """Tell whether a text has line breaks, tabs, NUL or lone surrogates, which no name needs."""
    return not text.isprintable() and any(unicodedata.category(c) in ("Cc", "Cs") for c in text)


def is_field(text: str) -> bool:
    """Tell whether a text can be one field: it must come back as written."""
    return text == text.strip() and "," not in text and not has_control_characters(text)


def is_folder_name(text: str) -> bool:
    """Tell whether a text can be one folder, such as a feature type."""
    return is_field(text) and text not in ("", ".", "..") and not set(text) & set("/\\:")
