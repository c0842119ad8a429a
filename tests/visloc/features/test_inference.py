from __future__ import annotations

import logging
import subprocess
import sys
from pathlib import Path

import pytest

from visloc.errors import InvalidInput
from visloc.features import inference, make_local_features
from visloc.features.inference import choose_inference
from visloc.types import Inference


@pytest.fixture(autouse=True)
def _no_gpu_and_nothing_logged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inference, "_has_cuda", lambda: False)
    inference._log_once.cache_clear()


def _pretend_cpu(monkeypatch: pytest.MonkeyPatch, folder: Path, flags: str) -> None:
    info = folder / "cpuinfo"
    info.write_text(f"processor\t: 0\nmodel name\t: Some CPU\nflags\t\t: {flags}\n\n")
    monkeypatch.setattr(inference, "_CPU_INFO", info)


@pytest.mark.parametrize("flag", ["avx512_vnni", "avx_vnni", "amx_int8"])
def test_processors_made_for_8_bits_compute_in_them(
    flag: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    _pretend_cpu(monkeypatch, tmp_path, f"fpu avx2 {flag} sse4_2")
    assert choose_inference(Inference.AUTO) is Inference.INT8


def test_other_processors_compute_in_floats_and_the_reason_is_logged_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    _pretend_cpu(monkeypatch, tmp_path, "fpu avx2 avx512f")
    with caplog.at_level(logging.INFO):
        assert choose_inference(Inference.AUTO) is Inference.FP32
        assert choose_inference(Inference.AUTO) is Inference.FP32
    assert [record.getMessage() for record in caplog.records] == [
        "networks are computed with fp32: the processor has neither VNNI nor AMX"
    ]


def test_unknown_processor_computes_in_floats(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(inference, "_CPU_INFO", tmp_path / "absent")
    assert choose_inference(Inference.AUTO) is Inference.FP32


def test_gpu_computes_with_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inference, "_has_cuda", lambda: True)
    assert choose_inference(Inference.AUTO) is Inference.TORCH


def test_without_openvino_torch_computes_and_the_reason_is_logged(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(inference, "has_openvino", lambda: False)
    with caplog.at_level(logging.INFO):
        assert choose_inference(Inference.AUTO) is Inference.TORCH
    assert "openvino is not installed" in caplog.text
    assert make_local_features("xfeat").computed_with.startswith("torch ")


@pytest.mark.parametrize("wanted", [Inference.INT8, Inference.FP32])
def test_asking_for_openvino_without_it_is_refused(
    wanted: Inference, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inference, "has_openvino", lambda: False)
    with pytest.raises(InvalidInput, match="pip install openvino") as caught:
        make_local_features("xfeat", None, wanted)
    assert caught.value.code == "inference.unavailable"


@pytest.mark.parametrize("wanted", [Inference.INT8, Inference.FP32, Inference.TORCH])
def test_what_is_named_is_what_computes(wanted: Inference) -> None:
    assert choose_inference(wanted) is wanted


def test_openvino_is_loaded_without_torch_and_without_telemetry() -> None:
    code = (
        "import sys; from visloc.features import make_local_features; "
        "from visloc.types import Inference; make_local_features('xfeat', None, Inference.FP32); "
        "sys.exit(any(n.startswith(('openvino_telemetry', 'openvino.tools', 'torch')) "
        "for n in sys.modules))"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
