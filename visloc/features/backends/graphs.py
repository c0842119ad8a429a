"""Finds the graph with which OpenVINO computes a network with certain weights.

A graph is two files, ``FEATURE-SHA256.xml`` and ``.bin``; the sha256 is that of the weights of
which it was made. Those of weights that come with this software lie in
``visloc/features/weights/graphs``. The command ``mapping export-graph`` makes those of others.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import logging
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from visloc.errors import refuse
from visloc.features.backends.choice import choose_inference
from visloc.features.backends.openvino import ROUNDING, Graph, import_openvino
from visloc.options import Inference

_LOGGER = logging.getLogger(__name__)
_FOLDER = Path(__file__).parents[1] / "weights" / "graphs"
# The sha256 of both files, one after the other.
_SHIPPED: Mapping[str, str] = {
    "faster2d2-8cbe14c8c7764dc850e59f19b2bc952441d8cc8c0a4bc1654125b923bd38eed0": (
        "7db2c72b425c3aa6458ba06a7af03011689d9edb509bee598cf4b9aead472da2"
    ),
    "xfeat-0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b": (
        "249337efa46ee32f113f055ab306316d5221dabda48b451d09cee823cc2975de"
    ),
}


def open_graph(
    feature: str,
    weights_sha256: str,
    weights_dir: Path | None,
    inference: Inference,
    threads: int | None,
) -> Graph | None:
    """Return the compiled graph of a network, None if torch is to compute it.

    AUTO is torch on a GPU, without OpenVINO, and for weights of which no graph was made.
    """
    chosen = choose_inference(inference)
    if chosen is Inference.TORCH:
        return None
    name = f"{feature}-{weights_sha256}"
    is_shipped = name in _SHIPPED
    folder = _FOLDER if is_shipped else weights_dir
    path = None if folder is None else folder / f"{name}.xml"
    if path is None or not (is_shipped or path.is_file()):
        hint = f"mapping export-graph {feature} --weights-dir FOLDER makes it"
        if inference is Inference.AUTO:
            _log_once(f"torch computes {feature}: there is no graph of these weights; {hint}")
            return None
        raise refuse(
            "inference.unavailable",
            f"OpenVINO computes graphs, and there is none of these weights of {feature}: {hint}",
            field="inference",
            expected=f"{Inference.AUTO} or {Inference.TORCH}, or {name}.xml in the weights folder",
            got=inference.value,
        )
    model, sha256 = _read(path, _SHIPPED.get(name))
    # Graphs of some networks have no 8-bit numbers.
    rounds = any(operation.get_type_name() == ROUNDING for operation in model.get_ops())
    in_8_bits = chosen is Inference.INT8 and rounds
    numbers = f"int8, graph {sha256[:8]}" if in_8_bits else "fp32"
    return Graph(
        model,
        in_8_bits=in_8_bits,
        threads=threads,
        computed_with=f"openvino {importlib.metadata.version('openvino')}, {numbers}",
    )


def _read(path: Path, expected_sha256: str | None) -> tuple[Any, str]:
    """Return the ``openvino.Model`` in a file, and the sha256 of both files."""
    try:
        structure, numbers = path.read_bytes(), path.with_suffix(".bin").read_bytes()
    except OSError as error:
        raise refuse("weights.unreadable", field=str(path), got=error.strerror) from error
    sha256 = hashlib.sha256(structure + numbers).hexdigest()
    if expected_sha256 not in (None, sha256):
        raise refuse(
            "weights.altered", field=str(path), expected=f"sha256 {expected_sha256}", got=sha256
        )
    try:
        return import_openvino().Core().read_model(structure, numbers), sha256
    except RuntimeError as error:
        raise refuse(
            "weights.format",
            "this is no graph that OpenVINO can read",
            field=str(path),
            got=str(error),
        ) from error


@cache
def _log_once(message: str) -> None:
    _LOGGER.info(message)
