"""Finds weights files and checks that they fit a network.

Published weights are neither shipped nor downloaded. They come with a package, or the operator
downloads them and names the folder. Some, such as R2D2's, are for non-commercial use only. Our own
weights of Fast-R2D2 (docs/models/fast-r2d2.md) are free to use and lie beside this module.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from visloc.errors import refuse
from visloc.features.weights.checkpoint import MAX_FILE_BYTES, Checkpoint, read_checkpoint

Shapes = Mapping[str, tuple[int, ...]]


@dataclass(frozen=True, slots=True)
class PublishedWeights:
    """A weights file that its authors publish.

    Attributes:
        file_name: as published, and as looked for in the weights folder.
        sha256: of the published file; None if it was never seen here.
        max_bytes: a larger file is not read.
    """

    file_name: str
    network: str
    source: str
    licence: str
    sha256: str | None = None
    max_bytes: int = MAX_FILE_BYTES


def _of_r2d2(file_name: str, network: str, sha256: str) -> PublishedWeights:
    return PublishedWeights(
        file_name=file_name,
        network=network,
        source="folder models of https://github.com/naver/r2d2",
        licence="CC BY-NC-SA 3.0: non-commercial use only",
        sha256=sha256,
    )


R2D2_WASF_N16 = _of_r2d2(
    "r2d2_WASF_N16.pt",
    "R2D2",
    "9ae90e02a9a133d100ca7aeaa32f4d4d7736a6dd222a530a25c8f7da5e508528",
)
FASTER2D2_WASF_N16 = _of_r2d2(
    "faster2d2_WASF_N16.pt",
    "Fast-R2D2",
    "217daa3a166bfe9bf2b68c05c1607a09dd4d552ae1bbeda885479d504eefc14b",
)


# Our own weights that lie beside this module: sha256 of ``trained/NAME.safetensors`` by feature.
SHIPPED: Mapping[str, str] = {
    "faster2d2": "8cbe14c8c7764dc850e59f19b2bc952441d8cc8c0a4bc1654125b923bd38eed0",
}
_SHIPPED_FOLDER = Path(__file__).parent / "trained"


def shipped_path(feature: str) -> Path:
    """Return where our own weights of a feature lie."""
    return _SHIPPED_FOLDER / f"{feature}.safetensors"


def own_path(feature: str, weights_dir: Path | None) -> Path | None:
    """Return ``FEATURE.safetensors`` in the weights folder, if it is there."""
    path = None if weights_dir is None else weights_dir / f"{feature}.safetensors"
    return path if path is not None and path.is_file() else None


def published_path(weights_dir: Path | None, published: PublishedWeights) -> Path:
    """Return the named file in the weights folder.

    A file with another sha256 will do too, because people train their own. Its sha256 goes into
    the features' fingerprint, and ``check_shapes`` tells whether it fits the network.
    """
    path = None if weights_dir is None else weights_dir / published.file_name
    if path is None or not path.is_file():
        raise refuse(
            "weights.missing",
            f"the weights of {published.network} are not part of this software: download "
            f"{published.file_name} ({published.source}; licence {published.licence}), "
            "put it into a folder and name the folder with --weights-dir or "
            "VISLOC_WEIGHTS_DIR",
            field="weights_dir" if path is None else str(path),
            expected=f"a folder with {published.file_name}",
            got="no weights folder" if weights_dir is None else f"no such file in {weights_dir}",
        )
    return path


def read_weights(weights_dir: Path | None, published: PublishedWeights) -> Checkpoint:
    """Read the file that ``published_path`` finds."""
    return read_checkpoint(published_path(weights_dir, published), published.max_bytes)


def find_weights(
    file_name: str,
    weights_dir: Path | None,
    package: str,
    folder: str,
    *,
    missing: str,
    field: str,
) -> Path:
    """Look for a file in the weights folder, then in an installed package that carries it.

    Args:
        package: Python name of the package, which is located but never imported.
    """
    folders = [] if weights_dir is None else [weights_dir]
    found = importlib.util.find_spec(package)
    if found is not None:
        folders += [Path(place) / folder for place in found.submodule_search_locations or ()]
    for path in (each / file_name for each in folders):
        if path.is_file():
            return path
    got = "no such package" if found is None else "a package without that file"
    raise refuse(
        "weights.missing",
        missing,
        field=field,
        expected=f"the installed package {package} with {folder}/{file_name}",
        got=got if weights_dir is None else f"{got}; no such file in {weights_dir} either",
    )


def check_shapes(checkpoint: Checkpoint, expected: Shapes, *, network: str, held: str) -> None:
    """Check that a checkpoint has exactly the tensors of a network, all of them finite.

    Args:
        held: the network that the file seems to hold, for the message.
    """
    found = {name: array.shape for name, array in checkpoint.tensors.items()}
    if found != dict(expected):
        wrong = sorted(set(found.items()) ^ set(expected.items()))
        name = wrong[0][0]
        raise refuse(
            "weights.network",
            f"these are weights of {held}, not of {network}; the first difference is {name}",
            field=str(checkpoint.path),
            expected=str(expected.get(name, "no such tensor")),
            got=str(found.get(name, "no such tensor")),
        )
    for name, array in checkpoint.tensors.items():
        negative = name.endswith("running_var") and bool((array < 0).any())
        if negative or not np.isfinite(array).all():
            raise refuse("weights.values", field=str(checkpoint.path), name=name)
