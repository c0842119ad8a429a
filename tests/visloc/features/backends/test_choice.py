from __future__ import annotations

import logging
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from visloc.errors import InvalidInput
from visloc.features import make_local_features
from visloc.features.backends import choice as inference
from visloc.features.backends.choice import choose_inference
from visloc.options import Inference

ROOT = Path(__file__).resolve().parents[4]
NOT_INSTALLED = ModuleNotFoundError("No module named 'openvino'", name="openvino")
NOT_LOADABLE = [
    ImportError("libtbb.so.12: cannot open shared object file"),
    ModuleNotFoundError("No module named 'openvino.opset13'", name="openvino.opset13"),
    OSError("wrong system"),
]


@pytest.fixture(autouse=True)
def _no_gpu_and_nothing_logged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inference, "has_cuda", lambda: False)
    inference._log_once.cache_clear()


def _pretend_cpu(
    monkeypatch: pytest.MonkeyPatch, folder: Path, flags: str, name: str = "flags"
) -> None:
    info = folder / "cpuinfo"
    info.write_text(f"processor\t: 0\nmodel name\t: Some CPU\n{name}\t\t: {flags}\n\n")
    monkeypatch.setattr(inference, "_CPU_INFO", info)


def _pretend_failing_import(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def fail() -> ModuleType:
        raise error

    monkeypatch.setattr(inference, "import_openvino", fail)


@pytest.mark.parametrize("flag", ["avx512_vnni", "avx_vnni", "amx_int8"])
def test_processors_made_for_8_bits_compute_in_them(
    flag: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    _pretend_cpu(monkeypatch, tmp_path, f"fpu avx2 {flag} sse4_2")
    assert choose_inference(Inference.AUTO) is Inference.INT8
    assert choose_inference(Inference.INT8) is Inference.INT8


@pytest.mark.parametrize(
    ("name", "flags"), [("flags", "fpu avx2 avx512f"), ("Features", "fp asimd asimddp i8mm")]
)
def test_other_processors_compute_in_floats_and_the_reason_is_logged_once(
    name: str,
    flags: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    _pretend_cpu(monkeypatch, tmp_path, flags, name)
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
    with pytest.raises(InvalidInput, match="does not say"):
        choose_inference(Inference.INT8)


def test_8_bits_are_refused_where_their_sums_may_overflow(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    _pretend_cpu(monkeypatch, tmp_path, "fpu avx2 avx512f")
    with pytest.raises(InvalidInput, match="overflow: the processor has neither VNNI") as caught:
        make_local_features("xfeat", None, Inference.INT8)
    assert caught.value.code == "inference.unavailable"
    assert (caught.value.expected, caught.value.got) == ("fp32", "int8")
    assert choose_inference(Inference.FP32) is Inference.FP32


def test_gpu_computes_with_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inference, "has_cuda", lambda: True)
    assert choose_inference(Inference.AUTO) is Inference.TORCH


def test_without_openvino_torch_computes_and_the_reason_is_logged(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    _pretend_failing_import(monkeypatch, NOT_INSTALLED)
    with caplog.at_level(logging.INFO):
        assert choose_inference(Inference.AUTO) is Inference.TORCH
    assert "openvino is not installed" in caplog.text
    assert make_local_features("xfeat").computed_with.startswith("torch ")


@pytest.mark.parametrize("error", NOT_LOADABLE)
def test_openvino_that_cannot_be_loaded_is_done_without_and_the_reason_is_logged(
    error: Exception, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    _pretend_failing_import(monkeypatch, error)
    with caplog.at_level(logging.INFO):
        assert choose_inference(Inference.AUTO) is Inference.TORCH
    assert f"openvino cannot be loaded ({error})" in caplog.text


@pytest.mark.parametrize("error", [NOT_INSTALLED, *NOT_LOADABLE])
@pytest.mark.parametrize("wanted", [Inference.INT8, Inference.FP32])
def test_asking_for_openvino_without_it_is_refused(
    wanted: Inference, error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    _pretend_failing_import(monkeypatch, error)
    with pytest.raises(InvalidInput, match="pip install openvino") as caught:
        make_local_features("xfeat", None, wanted)
    assert caught.value.code == "inference.unavailable"
    assert caught.value.expected == "auto or torch"


@pytest.mark.parametrize("wanted", [Inference.FP32, Inference.TORCH])
def test_what_is_named_is_what_computes(wanted: Inference) -> None:
    assert choose_inference(wanted) is wanted


def test_openvino_is_loaded_without_telemetry() -> None:
    code = (
        "import sys; from visloc.features import make_local_features; "
        "from visloc.options import Inference; make_local_features('xfeat', None, Inference.FP32); "
        "sys.exit(any(n.startswith(('openvino_telemetry', 'openvino.tools')) "
        "for n in sys.modules))"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_nothing_loads_openvino_with_its_telemetry() -> None:
    plain_import = re.compile(r"^\s*(import|from)\s(.*[\s,])?openvino\b", re.MULTILINE)
    assert plain_import.search("import os, openvino as ov")
    assert plain_import.search("    from openvino.opset13 import add")
    assert not plain_import.search("from visloc.features.backends.openvino import import_openvino")
    folders = [path for path in ROOT.iterdir() if path.is_dir() and path.name[0] != "."]
    files = [*ROOT.glob("*.py"), *(file for folder in folders for file in folder.rglob("*.py"))]
    assert len(files) > 100
    for file in files:
        found = plain_import.search(file.read_text(encoding="utf-8"))
        assert not found, f"{file}: use visloc.features.backends.openvino.import_openvino"
