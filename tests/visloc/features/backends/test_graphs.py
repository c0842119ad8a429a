from __future__ import annotations

import logging
import subprocess
import sys
from pathlib import Path

import pytest

from visloc.errors import InvalidInput, WeightsError
from visloc.features import make_local_features
from visloc.features.backends import graphs
from visloc.features.backends.graphs import _FOLDER, _SHIPPED, open_graph
from visloc.options import Inference

OWN = f"r2d2-{'0' * 64}"


def _open(weights_dir: Path | None, inference: Inference) -> object:
    return open_graph("r2d2", "0" * 64, weights_dir, inference, 1)


def test_every_shipped_graph_is_there_and_no_other() -> None:
    assert {path.stem for path in _FOLDER.glob("*.xml")} == set(_SHIPPED)
    assert {path.stem for path in _FOLDER.glob("*.bin")} == set(_SHIPPED)


@pytest.mark.parametrize("name", ["xfeat", "faster2d2"])
def test_shipped_networks_are_computed_without_torch(name: str) -> None:
    code = (
        "import sys; from visloc.features import make_local_features; "
        "from visloc.options import Inference; import numpy as np; "
        f"extractor = make_local_features({name!r}, None, Inference.FP32, 1); "
        "extractor.extract(np.eye(64, dtype=np.uint8)[:, :, None].repeat(3, 2), max_keypoints=9); "
        "sys.exit('torch' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_torch_computes_weights_without_a_graph_and_the_command_is_logged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    graphs._log_once.cache_clear()
    with caplog.at_level(logging.INFO):
        assert _open(tmp_path, Inference.AUTO) is None
    assert "mapping export-graph r2d2 --weights-dir" in caplog.text


def test_openvino_asked_for_without_a_graph_is_refused_with_the_command(tmp_path: Path) -> None:
    for folder in (None, tmp_path):
        with pytest.raises(InvalidInput, match="mapping export-graph r2d2") as caught:
            _open(folder, Inference.FP32)
        assert caught.value.code == "inference.unavailable"


def test_graph_that_openvino_cannot_read_is_refused_with_its_name(tmp_path: Path) -> None:
    (tmp_path / f"{OWN}.xml").write_text("<net")
    with pytest.raises(WeightsError, match=OWN) as caught:
        _open(tmp_path, Inference.FP32)
    assert caught.value.code == "weights.unreadable"  # the other file is not there
    (tmp_path / f"{OWN}.bin").write_bytes(b"")
    with pytest.raises(WeightsError, match=OWN) as caught:
        _open(tmp_path, Inference.FP32)
    assert caught.value.code == "weights.format"


def test_shipped_graph_that_was_changed_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for path in _FOLDER.glob("xfeat-*.*"):
        (tmp_path / path.name).write_bytes(path.read_bytes()[:-1])
    monkeypatch.setattr(graphs, "_FOLDER", tmp_path)
    with pytest.raises(WeightsError) as caught:
        make_local_features("xfeat", None, Inference.FP32)
    assert caught.value.code == "weights.altered"
