"""Writing features in kapture's layout, one image at a time, for other tools.

``reconstruction/keypoints/TYPE/IMAGE.kpt`` and its siblings hold rows of numbers, little-endian
and without a header; one line in ``keypoints.txt`` says of which type and how many per row.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visloc.errors import Conflict, refuse
from visloc.kapture.feature_layout import COLUMNS, DTYPES, FeatureKind, feature_file
from visloc.kapture.text import is_field, is_folder_name
from visloc.kapture.writer import VERSION_LINE, write_atomically


def write_local_features(
    root: Path,
    feature_type: str,
    image_path: str,
    keypoints: NDArray[np.generic],
    descriptors: NDArray[np.generic],
    *,
    name: str,
) -> None:
    """Write the keypoints and descriptors of one image.

    Args:
        root: the dataset; its ``sensors`` need not exist.
        feature_type: folder TYPE of both.
        image_path: as in ``records_camera.txt``.
        keypoints: (N, K >= 2): x, y in pixels (top-left centre at 0.5), then values such as the
            scale. N may be 0.
        descriptors: (N, D), compared by their L2 distance.
        name: name of the method, for ``keypoints.txt``.

    Raises:
        Conflict: ``kapture.feature_type`` if TYPE exists with other names, numbers or sizes.
        InvalidInput: ``kapture.features`` for a wrong shape or dtype.
        DatasetError: ``kapture.path``, ``kapture.field``.
    """
    if keypoints.ndim != 2 or keypoints.shape[1] < 2 or len(keypoints) != len(descriptors):
        raise refuse(
            "kapture.features", field="keypoints", got=f"{keypoints.shape} and {descriptors.shape}"
        )
    write_keypoints(root, feature_type, image_path, keypoints, name=name)
    _write("descriptors", root, feature_type, image_path, descriptors, name, (feature_type, "L2"))


def write_keypoints(
    root: Path, feature_type: str, image_path: str, keypoints: NDArray[np.generic], *, name: str
) -> None:
    """Write the keypoints (N, K >= 2) of one image without descriptors.

    Raises:
        Conflict, InvalidInput, DatasetError: as ``write_local_features``.
    """
    _write("keypoints", root, feature_type, image_path, keypoints, name, ())


def write_global_features(
    root: Path, feature_type: str, image_path: str, vector: NDArray[np.generic], *, name: str
) -> None:
    """Write the global descriptor (D,) of one image, compared by its L2 distance.

    Raises:
        Conflict, InvalidInput, DatasetError: as ``write_local_features``.
    """
    rows = vector[np.newaxis]
    _write("global_features", root, feature_type, image_path, rows, name, ("L2",))


def _write(
    kind: FeatureKind,
    root: Path,
    feature_type: str,
    image_path: str,
    rows: NDArray[np.generic],
    name: str,
    last_fields: tuple[str, ...],
) -> None:
    if not is_folder_name(feature_type) or not (name and is_field(name) and name[0] != "#"):
        raise refuse(
            "kapture.field",
            "this is not a valid name of a feature type",
            field="feature_type",
            expected="a folder name without commas",
            got=f"type {feature_type!r}, name {name!r}",
        )
    file = feature_file(kind, image_path)
    dtype_name = rows.dtype.newbyteorder("=").name
    if rows.ndim != 2 or rows.shape[1] == 0 or dtype_name not in DTYPES:
        raise refuse(
            "kapture.features",
            "kapture cannot store these features",
            field=kind,
            expected=f"(N, D) numbers of {', '.join(DTYPES)}",
            got=f"{rows.shape} {rows.dtype}",
        )
    folder = root / "reconstruction" / kind / feature_type
    fields = (name, dtype_name, str(rows.shape[1]), *last_fields)
    _declare(folder / f"{kind}.txt", COLUMNS[kind], fields)
    path = folder / file
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, np.ascontiguousarray(rows, dtype=DTYPES[dtype_name]).tobytes())


def _declare(path: Path, columns: tuple[str, ...], fields: tuple[str, ...]) -> None:
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        text = f"{VERSION_LINE}\n# {', '.join(columns)}\n{', '.join(fields)}\n"
        write_atomically(path, text.encode("utf-8"))
        return
    lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    data = [line for line in lines if line.strip() and not line.strip().startswith("#")]
    if [tuple(field.strip() for field in line.split(",")) for line in data] != [fields]:
        raise refuse(
            "kapture.feature_type",
            "the folder holds features of another kind",
            field=str(path),
            expected=", ".join(fields),
            got="; ".join(data),
            kind=Conflict,
        )
