from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save

from visloc.errors import WeightsError
from visloc.features.weights.checkpoint import MAX_FILE_BYTES, read_checkpoint
from visloc.features.weights.files import check_shapes


def _file(header: object, values: bytes = b"") -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + values


def _tensor(**changes: object) -> dict[str, object]:
    return {"a": {"dtype": "F32", "shape": [2], "data_offsets": [0, 8], **changes}}


WHOLE = _file({"__metadata__": {"format": "pt"}, **_tensor()}, np.array([1.5, -2], "<f4").tobytes())


def _write(folder: Path, data: bytes) -> Path:
    path = folder / "w.safetensors"
    path.write_bytes(data)
    return path


def test_a_file_written_by_the_format_s_description_is_read(tmp_path: Path) -> None:
    checkpoint = read_checkpoint(_write(tmp_path, WHOLE))
    assert checkpoint.tensors["a"].tolist() == [1.5, -2.0]
    assert not checkpoint.tensors["a"].flags.writeable
    assert checkpoint.sha256 == hashlib.sha256(WHOLE).hexdigest()
    assert not checkpoint.beside


def test_what_the_library_writes_is_read(tmp_path: Path) -> None:
    arrays = {
        "halves": np.arange(6, dtype=np.float16).reshape(2, 3),
        "counter": np.array(12345),
        "one": np.array(7.5, np.float32),
        "none": np.empty((0, 4)),
    }
    read = read_checkpoint(_write(tmp_path, save(arrays, {"licence": "free"}))).tensors
    assert read.keys() == arrays.keys()
    for name, array in arrays.items():
        assert (read[name].dtype, read[name].shape) == (array.dtype, array.shape)
        np.testing.assert_array_equal(read[name], array)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x01",
        (2**63).to_bytes(8, "little") + b"{}",
        (20).to_bytes(8, "little") + b"{}",
        _file([1]),
        _file(b"{,}"),
        _file(b'{"a":' * 100_000),
        _file({"__metadata__": {"a": 1}}),
        _file({"__metadata__": []}),
        _file({"a": 3}),
        _file(b'{"\xff": 3}'),
        _file(_tensor(dtype="F9"), bytes(8)),
        _file(_tensor(dtype=[]), bytes(8)),
        _file(_tensor(shape=[3]), bytes(8)),
        _file(_tensor(shape=[-2]), bytes(8)),
        _file(_tensor(shape=[True, 2]), bytes(8)),
        _file(_tensor(shape=2), bytes(8)),
        _file(_tensor(shape=[2] + [1] * 99), bytes(8)),
        _file(_tensor(data_offsets=[0, 9]), bytes(8)),
        _file(_tensor(data_offsets=[8, 0]), bytes(8)),
        _file(_tensor(data_offsets=[0]), bytes(8)),
        _file(_tensor(data_offsets=[-8, 0]), bytes(8)),
        _file(_tensor(shape=[2**39, 2**39], data_offsets=[0, 2**39]), bytes(8)),
        _file(_tensor(shape=[2**63, 2**63, 4]), bytes(8)),
        _file(_tensor(shape=[0, 2**63], data_offsets=[0, 0])),
        _file(_tensor(shape=[2**64 - 1, 0], data_offsets=[0, 0])),
        _file({**_tensor(), "b": _tensor()["a"]}, bytes(8)),  # both of the same bytes
        _file(_tensor(data_offsets=[4, 12]), bytes(12)),  # after bytes of nobody
        _file(_tensor(), bytes(12)),  # before bytes of nobody
        _file(_tensor(), bytes(7)),
    ],
)
def test_what_is_damaged_is_refused(data: bytes, tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="does not hold complete, plain tensors") as caught:
        read_checkpoint(_write(tmp_path, data))
    assert caught.value.code == "weights.format"


@pytest.mark.parametrize(
    ("dtype", "count"), [("BF16", 4), ("F8_E4M3", 8), ("F4", 16), ("BOOL", 8), ("C64", 1)]
)
def test_types_of_no_weights_of_ours_are_named(dtype: str, count: int, tmp_path: Path) -> None:
    data = _file(_tensor(dtype=dtype, shape=[count]), bytes(8))
    with pytest.raises(WeightsError, match=rf"of type ({dtype}|bool|complex64)") as caught:
        read_checkpoint(_write(tmp_path, data))
    assert caught.value.code == "weights.format"


def test_a_header_of_millions_of_tensors_is_refused_unread(tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="a header of 10000001 bytes"):
        read_checkpoint(_write(tmp_path, _file(b"{" + b" " * 10_000_000)))


def test_every_truncation_of_safetensors_is_refused(tmp_path: Path) -> None:
    for length in range(len(WHOLE)):
        with pytest.raises(WeightsError):
            read_checkpoint(_write(tmp_path, WHOLE[:length]))


def test_random_damage_to_safetensors_never_raises_anything_else(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    for _ in range(1000):
        damaged = bytearray(WHOLE)
        for position in generator.integers(len(WHOLE), size=3):
            damaged[position] = generator.integers(256)
        try:
            checkpoint = read_checkpoint(_write(tmp_path, bytes(damaged)))
        except WeightsError:
            continue
        assert all(array.nbytes <= 8 for array in checkpoint.tensors.values())


def test_numbers_that_are_none_are_left_to_the_check_of_the_network(tmp_path: Path) -> None:
    path = _write(tmp_path, save({"a": np.array([1, np.nan], np.float32)}))
    with pytest.raises(WeightsError) as caught:
        check_shapes(read_checkpoint(path), {"a": (2,)}, network="Net", held="another network")
    assert caught.value.code == "weights.values"


def test_safetensors_beyond_the_size_limit_are_refused(tmp_path: Path) -> None:
    path = _write(tmp_path, WHOLE)
    with path.open("r+b") as file:
        file.truncate(MAX_FILE_BYTES + 1)  # sparse
    with pytest.raises(WeightsError) as caught:
        read_checkpoint(path)
    assert caught.value.code == "weights.too_large"
