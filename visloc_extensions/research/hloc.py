"""Features and matches of hloc as files of kapture, which a build and a batch read.

hloc keeps a group for each photo in ``features.h5``: ``keypoints`` (N, 2), counted from the centre
of the first pixel, and ``descriptors`` (D, N); or ``global_descriptor`` (D,). ``matches.h5`` has a
group for each pair, ``a-b.jpg/c-d.jpg`` for a/b.jpg and c/d.jpg, with ``matches0`` (N,): the row of
the second photo's keypoint for each one of the first, or -1; and perhaps ``matching_scores0`` (N,).
Source: ``extract_features.py`` and ``match_features.py`` of cvg/Hierarchical-Localization.
"""

from __future__ import annotations

import importlib.util
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visloc.errors import VislocError, refuse
from visloc.kapture import write_global_features, write_keypoints, write_local_features
from visloc.kapture.matches import write_matches

# More than any photo has: 200 000 descriptors of 256 numbers are 51 millions.
_MAX_VALUES = 2**26
# What is read of a group, by the array that tells what the group is.
_ARRAYS = {
    "keypoints": ("keypoints", "descriptors"),
    "global_descriptor": ("global_descriptor",),
    "matches0": ("matches0", "matching_scores0"),
}


def import_features(
    files: Sequence[Path], output: Path, type_name: str
) -> tuple[dict[str, int], list[str]]:
    """Write features and matches of hloc in kapture's layout, in the order features, matches.

    Args:
        files: HDF5 files, in any order. The names of matched photos are those of the features.
        output: gets ``reconstruction/KIND/TYPE``; keypoints count from the corner of the picture.

    Returns:
        How many photos have local and global features, and how many pairs have matches; and a note
        on what is not read.
    """
    if importlib.util.find_spec("h5py") is None:
        raise refuse("hloc.h5py")
    written: dict[str, set[str]] = {"local": set(), "global": set(), "pairs": set()}
    unread: Counter[str] = Counter()
    sizes: dict[str, int] = {}
    for file in files:
        for name, group in _groups(file):
            known = [key for kind, keys in _ARRAYS.items() if kind in group for key in keys]
            unread.update(key for key in _arrays(group) if key not in known)
            if "keypoints" in group:
                sizes[name] = _local(file, name, group, output, type_name)
                written["local"].add(name)
            if "global_descriptor" in group:
                vector = _numbers(file, name, group, "global_descriptor", 1)
                write_global_features(output, type_name, name, vector, name=type_name)
                written["global"].add(name)
            if "matches0" in group:
                written["pairs"].add(name)
    if not any(written.values()):
        raise refuse("hloc.nothing", field=", ".join(map(str, files)))
    short = _short_names(sizes) if written["pairs"] else {}
    folder = output / "reconstruction" / "matches" / type_name
    for file in files if written["pairs"] else ():
        for name, group in _groups(file):
            if "matches0" in group:
                _matches(file, name, group, short, sizes, folder)
    some = ", ".join(f"{key} ({count})" for key, count in unread.most_common(10))
    notes = [f"arrays that are not read, and how often: {some}"] if unread else []
    return {kind: len(names) for kind, names in written.items() if names}, notes


def _local(file: Path, name: str, group: Any, output: Path, type_name: str) -> int:
    keypoints = _numbers(file, name, group, "keypoints", 2)
    if keypoints.shape[1] != 2:
        raise _wrong(file, name, "keypoints (N, 2)", keypoints.shape)
    keypoints += np.float32(0.5)
    if "descriptors" not in group:  # of matchers without a detector
        write_keypoints(output, type_name, name, keypoints, name=type_name)
        return len(keypoints)
    descriptors = _numbers(file, name, group, "descriptors", 2).T
    if len(descriptors) != len(keypoints):
        raise _wrong(file, name, f"descriptors (D, {len(keypoints)})", descriptors.T.shape)
    write_local_features(output, type_name, name, keypoints, descriptors, name=type_name)
    return len(keypoints)


def _matches(
    file: Path,
    name: str,
    group: Any,
    short: dict[str, str],
    sizes: dict[str, int],
    folder: Path,
) -> None:
    parts = name.split("/")
    if len(parts) != 2 or not all(part in short for part in parts):
        raise refuse("hloc.pair", field=f"{file}:{name}", got=f"features of {len(sizes)} photos")
    first, second = (short[part] for part in parts)
    partner = _array(file, name, group, "matches0", 1)
    if not np.issubdtype(partner.dtype, np.integer) or len(partner) != sizes[first]:
        expected = f"matches0 ({sizes[first]},) of whole numbers"
        raise _wrong(file, name, expected, f"{partner.shape} {partner.dtype}")
    matched = np.flatnonzero(partner != -1)
    rows = np.column_stack([matched, partner[matched]]).astype(np.int64)
    if len(rows) and not 0 <= rows[:, 1].min() <= rows[:, 1].max() < sizes[second]:
        expected = f"rows of the {sizes[second]} keypoints of {second}"
        raise _wrong(file, name, expected, f"{rows[:, 1].min()} to {rows[:, 1].max()}")
    scores = None
    if "matching_scores0" in group:
        all_scores = _array(file, name, group, "matching_scores0", 1)
        if len(all_scores) != len(partner):
            raise _wrong(file, name, f"matching_scores0 ({len(partner)},)", all_scores.shape)
        scores = all_scores[matched].astype(np.float64)
    write_matches(folder, first, second, rows, scores)


def _short_names(names: dict[str, int]) -> dict[str, str]:
    """Return the photos by their names in pairs, in which a slash is a hyphen."""
    short: dict[str, str] = {}
    for name in names:
        key = name.replace("/", "-")
        if key in short:
            raise refuse("hloc.pair", field=key, got=f"{short[key]}, {name}")
        short[key] = name
    return short


def _groups(file: Path) -> Iterator[tuple[str, Any]]:
    """Return the groups that hold arrays, by name. Links to other files are not followed."""
    import h5py

    if not file.is_file():  # HDF5 waits for ever on a pipe
        raise refuse("hloc.unreadable", field=str(file), got="no file")
    with _errors_of(file), h5py.File(file, "r") as opened:
        names: list[str] = []

        def visit(name: str, item: Any) -> None:
            if isinstance(item, h5py.Group) and _arrays(item):
                names.append(name)

        opened.visititems(visit)
        for name in names:
            yield name, opened[name]


def _arrays(group: Any) -> list[str]:
    import h5py

    return [
        key
        for key in group
        if isinstance(group.get(key, getlink=True), h5py.HardLink)
        and group.get(key, getclass=True) is h5py.Dataset
    ]


def _numbers(file: Path, name: str, group: Any, key: str, num_axes: int) -> NDArray[np.float32]:
    with np.errstate(over="ignore"):
        values = _array(file, name, group, key, num_axes).astype(np.float32)
    if not np.isfinite(values).all():
        raise _wrong(file, name, f"{key} of 32-bit numbers", "larger ones")
    return values


def _array(file: Path, name: str, group: Any, key: str, num_axes: int) -> NDArray[Any]:
    import h5py

    with _errors_of(file):
        data = group[key] if isinstance(group.get(key, getlink=True), h5py.HardLink) else None
        expected = f"{key} with {num_axes} axes, in this file"
        # Linked, external and virtual arrays lie in files that whoever made this one could choose.
        if not isinstance(data, h5py.Dataset) or data.external is not None or data.is_virtual:
            raise _wrong(file, name, expected, "something else")
        if data.shape is None or len(data.shape) != num_axes or data.size > _MAX_VALUES:
            raise _wrong(file, name, expected, data.shape)
        values: NDArray[Any] = data[()]
    if values.dtype.kind not in "fiu" or not np.isfinite(values).all():
        raise _wrong(file, name, f"{key} of finite numbers", values.dtype)
    return values


@contextmanager
def _errors_of(file: Path) -> Iterator[None]:
    try:
        yield
    except VislocError:
        raise
    except (OSError, KeyError, RuntimeError, ValueError) as error:  # what h5py raises
        raise refuse("hloc.unreadable", field=str(file), got=str(error)) from error


def _wrong(file: Path, name: str, expected: str, got: object) -> VislocError:
    return refuse("hloc.group", field=f"{file}:{name}", expected=expected, got=str(got))
