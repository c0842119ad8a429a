"""Makes the graph that OpenVINO computes of the network that torch computes.

In 8 bits, each convolution's weights are scaled per output and its input as a whole, by the
extremes in eight pictures that code paints, averaged.
"""

from __future__ import annotations

import importlib
import sys
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from samples import papers, surfaces
from visloc.errors import refuse
from visloc.features.backends.openvino import Graph, import_openvino
from visloc_extensions.graphs.networks import NETWORKS, Exported

_TELEMETRY = "openvino_telemetry"
# 255 and 256 levels are what OpenVINO turns into 8-bit integers, -127 to 127 and 0 to 255.
_WEIGHT_LEVELS, _ACTIVATION_LEVELS = 255, 256
_TINY = float(np.finfo(np.float32).tiny)
_PICTURE_SIZE = (480, 640)
_LEAST_SIDE_PX = 8  # below, nothing would be left after a pooling
_MIDDLE = (slice(120, 360), slice(160, 480))  # whole pictures take long
_PAINTERS = (
    surfaces.book_shelf,
    surfaces.mural_wall,
    surfaces.pinboard_wall,
    surfaces.brick_wall,
    surfaces.desk,
    papers.town_map,
    papers.text_page,
    papers.art_poster,
)


def export_graph(feature: str, weights_dir: Path) -> Path:
    """Write the graph of a feature's network beside its weights, and return the path of its XML."""
    if feature not in NETWORKS:
        raise refuse(
            "features.unknown",
            "these features have no network that OpenVINO could compute",
            field="feature",
            expected=sorted(NETWORKS),
            got=feature,
        )
    network = NETWORKS[feature](weights_dir)
    model = _converted(network)
    if network.in_floats is not None:
        _round(model, network)
    name = f"{feature}-{network.weights_sha256}"
    with tempfile.TemporaryDirectory(dir=weights_dir) as folder:
        written = Path(folder) / f"{name}.xml"
        import_openvino().save_model(model, str(written), compress_to_fp16=False)
        for suffix in (".bin", ".xml"):  # the XML last: it is what is looked for
            written.with_suffix(suffix).replace(weights_dir / f"{name}{suffix}")
    return weights_dir / f"{name}.xml"


def _converted(network: Exported) -> Any:
    """Return the network as an ``openvino.Model``, in floats."""
    openvino = import_openvino()
    example = torch.from_numpy(network.input_of(np.zeros((96, 160, 3), np.uint8)))
    sides = {}
    for axis, name in zip(network.axes, ("height", "width"), strict=True):
        multiple = torch.export.Dim(name, min=-(-_LEAST_SIDE_PX // network.side_px), max=2**16)
        sides[axis] = multiple if network.side_px == 1 else network.side_px * multiple
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # of torch about itself
        program = torch.export.export(network.module, (example,), dynamic_shapes=(sides,))
        model = _converter().convert_model(program)
    outputs = [each.input_value(0) for each in model.get_results()]
    outputs += [_operations().constant(each).output(0) for each in network.constants]
    return openvino.Model(outputs, model.get_parameters(), "network")


def _converter() -> Any:
    """Return OpenVINO's converter, which reports to nobody that it was loaded."""
    hidden = _TELEMETRY not in sys.modules
    if hidden:
        sys.modules[_TELEMETRY] = None  # type: ignore[assignment]
    try:
        return importlib.import_module("openvino.tools.ovc")
    finally:
        if hidden:
            del sys.modules[_TELEMETRY]


def _operations() -> Any:
    import_openvino()
    return importlib.import_module("openvino.opset13")


def _round(model: Any, network: Exported) -> None:
    """Round weights and inputs of the convolutions to 8 bits, unless they stay in floats."""
    operations = _operations()
    convolutions = [
        each
        for each in model.get_ordered_ops()
        if each.get_type_name() == "Convolution" and not _stays(each, network.in_floats or ())
    ]
    for convolution, (low, high) in zip(
        convolutions, _ranges(model, convolutions, network), strict=True
    ):
        weight = convolution.input_value(1).get_node().data
        largest = np.maximum(np.abs(weight).max(axis=(1, 2, 3), keepdims=True), _TINY)
        if low < 0:  # -128 to 127 steps of one size, so that zero, the padding, is exact
            low, high = -max(-low, high), max(-low, high) * 127 / 128
        ends = (low, max(high, _TINY)), (-largest, largest)
        for number, levels in enumerate((_ACTIVATION_LEVELS, _WEIGHT_LEVELS)):
            limits = [operations.constant(np.float32(end)) for end in ends[number]]
            rounded = operations.fake_quantize(
                convolution.input_value(number), *limits, *limits, levels
            )
            convolution.input(number).replace_source_output(rounded.output(0))


def _stays(convolution: Any, in_floats: tuple[str, ...]) -> bool:
    """Return whether the name that torch gave the weight begins with one of these."""
    beginnings = tuple(f"network_{each}" for each in in_floats)
    names = convolution.input_value(1).get_names()
    return any(name.startswith(beginnings) for name in names)


def _ranges(
    model: Any, convolutions: Sequence[Any], network: Exported
) -> list[tuple[float, float]]:
    """Return the extremes of what enters each convolution, averaged over the pictures.

    Averages cut off outliers of one picture. Zero is always among what enters: it is the padding.
    """
    operations = _operations()
    axes = np.arange(4)
    extremes = [
        reduce(convolution.input_value(0), axes, keep_dims=False).output(0)
        for reduce in (operations.reduce_min, operations.reduce_max)
        for convolution in convolutions
    ]
    measured = import_openvino().Model(extremes, model.get_parameters(), "extremes")
    graph = Graph(measured, in_8_bits=False, threads=None, computed_with="floats")
    means = np.mean([graph(network.input_of(picture)) for picture in pictures()], axis=0)
    # Four digits are plenty, and the same on machines that add up in another order.
    lows, highs = np.split(np.array([float(f"{mean:.4g}") for mean in means]), 2)
    return [(min(low, 0.0), max(high, 0.0)) for low, high in zip(lows, highs, strict=True)]


def pictures() -> list[NDArray[np.uint8]]:
    """Paint the pictures to measure on: (240, 320, 3) RGB."""
    return [
        np.asarray(paint(np.random.default_rng(number), *_PICTURE_SIZE)[_MIDDLE], np.uint8)
        for number, paint in enumerate(_PAINTERS)
    ]
