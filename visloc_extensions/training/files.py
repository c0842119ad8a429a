"""Files that are either whole or not there, and arrays with words about them in such files."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.numpy import save

_ABOUT = "about"


def write_whole(path: Path, data: bytes) -> None:
    """Write a file so that a crash leaves the old one or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    with partial.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)


def write_tensors(path: Path, arrays: Mapping[str, NDArray[Any]], about: Mapping[str, Any]) -> int:
    """Write a safetensors file, and return its number of bytes; equal content gives equal bytes.

    Args:
        about: what else to say; it becomes one JSON text in the metadata, because the library
            writes several entries in another order each time.
    """
    # The library takes an array's memory as it lies.
    whole = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    data = save(whole, {_ABOUT: json.dumps(about, sort_keys=True)})
    write_whole(path, data)
    return len(data)


def read_about(path: Path) -> Any:
    """Return what ``write_tensors`` was told to say."""
    with safe_open(path, framework="numpy") as file:
        words = file.metadata() or {}
    if _ABOUT not in words:
        raise ValueError(f"its metadata have no {_ABOUT!r}")
    return json.loads(words[_ABOUT])
