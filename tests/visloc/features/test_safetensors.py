from __future__ import annotations

import json

import numpy as np
import pytest

from visloc.features.safetensors import decode_tensors, encode_tensors, is_safetensors


def _file(header: object, values: bytes = b"") -> bytes:
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + values


def test_what_is_written_is_read() -> None:
    arrays = {
        "halves": np.arange(6, dtype=np.float16).reshape(2, 3),
        "bytes": np.array([1, 2, 255], np.uint8),
        "one": np.array(7.5, np.float32),
        "none": np.empty((0, 4)),
    }
    data = encode_tensors(arrays, {"licence": "free"})
    assert is_safetensors(data)
    read = decode_tensors(data)
    assert read.metadata == {"licence": "free"}
    assert read.arrays.keys() == arrays.keys()
    for name, array in arrays.items():
        assert read.arrays[name].dtype == array.dtype
        np.testing.assert_array_equal(read.arrays[name], array)


def test_a_file_written_by_the_format_s_description_is_read() -> None:
    header = {
        "__metadata__": {"format": "pt"},
        "a": {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]},
    }
    read = decode_tensors(_file(header, np.array([1.5, -2], "<f4").tobytes()))
    assert read.arrays["a"].tolist() == [1.5, -2.0]
    assert not read.arrays["a"].flags.writeable


def _tensor(**changes: object) -> dict[str, object]:
    return {"a": {"dtype": "F32", "shape": [2], "data_offsets": [0, 8], **changes}}


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x01",
        (2**63).to_bytes(8, "little") + b"{}",
        (20).to_bytes(8, "little") + b"{}",
        _file([1]),
        (3).to_bytes(8, "little") + b"{,}",
        (100_000).to_bytes(8, "little") + b"[" * 100_000,
        _file({"__metadata__": {"a": 1}}),
        _file({"__metadata__": []}),
        _file({"a": 3}),
        _file(_tensor(dtype="F8"), bytes(8)),
        _file(_tensor(dtype=[]), bytes(8)),
        _file(_tensor(shape=[3]), bytes(8)),
        _file(_tensor(shape=[-2]), bytes(8)),
        _file(_tensor(shape=[True, 2]), bytes(8)),
        _file(_tensor(shape=2), bytes(8)),
        _file(_tensor(shape=[1] * 9), bytes(8)),
        _file(_tensor(data_offsets=[0, 9]), bytes(8)),
        _file(_tensor(data_offsets=[8, 0]), bytes(8)),
        _file(_tensor(data_offsets=[0]), bytes(8)),
        _file(_tensor(data_offsets=[-8, 0]), bytes(8)),
        _file(_tensor(shape=[2**39, 2**39], data_offsets=[0, 2**39]), bytes(8)),
    ],
)
def test_what_is_damaged_is_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"tensor|header|metadata|counts"):
        decode_tensors(data)
