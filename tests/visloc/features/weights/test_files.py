from __future__ import annotations

import hashlib
import os
import pickle
import struct
import subprocess
import zipfile
from collections import OrderedDict, defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from visloc.errors import WeightsError
from visloc.features.weights.checkpoint import MAX_FILE_BYTES, Checkpoint, read_checkpoint
from visloc.features.weights.files import (
    FASTER2D2_WASF_N16,
    R2D2_WASF_N16,
    check_shapes,
    read_weights,
)
from visloc.features.weights.torch_file import _KNOWN

OLD_START = pickle.dumps(0x1950A86A20F9469CFC6C, 2) + pickle.dumps(1001, 2)
SYSTEM_INFO = pickle.dumps({"protocol_version": 1001, "little_endian": True}, 2)
TENSOR = (  # a tensor of two values in storage "7", as torch pickles it
    b"ctorch._utils\n_rebuild_tensor_v2\n((X\x07\x00\x00\x00storagectorch\nFloatStorage\n"
    b"X\x01\x00\x00\x007X\x03\x00\x00\x00cpuK%cNtQK%c(K%ct(K\x01t\x89ccollections\nOrderedDict\n)RtR"
)


def _tensor(*, length: int = 2, offset: int = 0, size: int = 2) -> bytes:
    return TENSOR % (length, offset, size)


def _dict_of(value: bytes, name: bytes = b"weight") -> bytes:
    """Pickle {name: value}, whose value is given as opcodes."""
    return b"\x80\x02}X" + struct.pack("<I", len(name)) + name + value + b"s."


def _old_file(path: Path, content: bytes, *, values: tuple[float, ...] = (1.5, -2.0)) -> Path:
    numbers = struct.pack(f"<q{len(values)}f", len(values), *values)
    path.write_bytes(OLD_START + SYSTEM_INFO + content + pickle.dumps(["7"], 2) + numbers)
    return path


def _zip_file(
    path: Path, content: bytes, *, numbers: bytes = struct.pack("<2f", 1.5, -2.0), **options: Any
) -> Path:
    with zipfile.ZipFile(path, "w", **options) as archive:
        archive.writestr("archive/data.pkl", content.replace(b"NtQ", b"tQ"))  # no view
        archive.writestr("archive/version", "3\n")
        archive.writestr("archive/byteorder", "little")
        archive.writestr("archive/data/7", numbers)
    return path


NO_STORAGE = "storage 7, which no tensor uses"  # of the older layout, where nothing uses it
WRITERS = pytest.mark.parametrize("write", [_old_file, _zip_file])
Writer = Callable[[Path, bytes], Path]


class _Call:
    """Pickles as a call of ``function(*arguments)``."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return self.call


@WRITERS
def test_hand_made_files_of_both_layouts_are_read(write: Writer, tmp_path: Path) -> None:
    checkpoint = read_checkpoint(write(tmp_path / "w.pt", _dict_of(_tensor())))
    np.testing.assert_array_equal(checkpoint.tensors["weight"], np.float32([1.5, -2.0]))
    assert checkpoint.sha256 == hashlib.sha256((tmp_path / "w.pt").read_bytes()).hexdigest()


@pytest.mark.parametrize("zipped", [True, False])
def test_what_torch_saves_is_read_exactly(zipped: bool, tmp_path: Path) -> None:
    base = torch.arange(24.0)
    state = {
        "plain": torch.randn(3, 2, generator=torch.Generator().manual_seed(0)),
        "transposed": torch.arange(6.0).reshape(2, 3).T,
        "part_of_a_shared_storage": base[4:12].reshape(2, 4),
        "another_part": base[1::2],
        "counter": torch.tensor(12345),
    }
    log = [defaultdict(list, loss=[0.5, 0.25])]
    content = {"net": "Net()", "state_dict": OrderedDict(state), "log": log}
    path = tmp_path / "w.pt"
    torch.save(content, path, _use_new_zipfile_serialization=zipped)
    tensors = read_checkpoint(path).tensors
    assert list(tensors) == list(state)
    for name, tensor in state.items():
        np.testing.assert_array_equal(tensors[name], tensor.numpy())


def test_published_fast_file_is_read_and_agrees_with_published_facts(shared_weights: Path) -> None:
    checkpoint = read_weights(shared_weights, FASTER2D2_WASF_N16)
    assert checkpoint.sha256 == FASTER2D2_WASF_N16.sha256
    assert sum(array.size for array in checkpoint.tensors.values()) == 485_803
    np.testing.assert_allclose(checkpoint.tensors["clf.bias"], [0.0919, -0.1127], atol=1e-4)
    np.testing.assert_allclose(checkpoint.tensors["sal.bias"], [-0.4595], atol=1e-4)


def test_published_r2d2_file_agrees_with_torch(shared_weights: Path) -> None:
    checkpoint = read_weights(shared_weights, R2D2_WASF_N16)
    assert checkpoint.sha256 == R2D2_WASF_N16.sha256
    expected = torch.load(checkpoint.path, weights_only=True)["state_dict"]
    assert set(checkpoint.tensors) == set(expected)
    for name, tensor in expected.items():
        np.testing.assert_array_equal(checkpoint.tensors[name], tensor.numpy())


@pytest.mark.parametrize("name", ["aliked-n16.pth", "aliked-t16.pth"])
def test_published_aliked_files_agree_with_torch(name: str, shared_weights: Path) -> None:
    checkpoint = read_checkpoint(shared_weights / name)
    expected = torch.load(checkpoint.path, weights_only=True)
    assert list(checkpoint.tensors) == list(expected)
    for key, tensor in expected.items():
        np.testing.assert_array_equal(checkpoint.tensors[key], tensor.numpy())


@WRITERS
@pytest.mark.parametrize("protocol", [0, 1, 2, 4, 5])
@pytest.mark.parametrize(
    "function", [os.system, subprocess.check_call, eval, exec, torch.load, torch.hub.load, getattr]
)
def test_code_in_a_file_is_refused_and_not_run(
    function: Callable[..., Any], protocol: int, write: Writer, tmp_path: Path
) -> None:
    witness = tmp_path / "ran"
    argument = f"open({str(witness)!r}, 'w')" if function in (eval, exec) else f"touch {witness}"
    evil = pickle.dumps({"weight": _Call(function, argument)}, protocol)
    with pytest.raises(WeightsError, match="does not hold complete, plain tensors") as caught:
        read_checkpoint(write(tmp_path / "w.pt", evil))
    assert caught.value.code == "weights.format"
    assert not witness.exists()


@WRITERS
@pytest.mark.parametrize(
    "name",
    [
        b"torch._utils\n_rebuild_tensor",
        b"torch._utils\n_rebuild_tensor_v2.__globals__",
        b"torch\nserialization.os.system",
        b"torch\nFloatStorage.from_file",
        b"collections\nOrderedDict.fromkeys",
        b"collections\nsys.modules",
        b"builtins\nlist.append",
        b"__builtin__\neval",
    ],
)
def test_names_beside_the_known_ones_are_refused(
    name: bytes, write: Writer, tmp_path: Path
) -> None:
    with pytest.raises(WeightsError, match="is no name that a state dict needs"):
        read_checkpoint(write(tmp_path / "w.pt", _dict_of(b"c" + name + b"\n")))


@WRITERS
@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (_dict_of(_tensor(size=3)), "reaches beyond its storage|another size"),
        (_dict_of(_tensor(offset=1)), "reaches beyond its storage|another size"),
        (_dict_of(_tensor(length=200)), "8 bytes for 200 numbers|another size"),
        (_dict_of(b"K\x01"), f"holds int|{NO_STORAGE}"),
        (b"\x80\x02}.", f"no state dict|{NO_STORAGE}"),
        (b"\x80\x02K\x05.", f"no state dict|{NO_STORAGE}"),
        (b"\x80\x02.", "stack underflow|pop from empty"),
        (b"\x80\x02}", "exhausted|unknown"),
        (b"\x80\x03}.", "not a pickle of protocol 2"),
        # a terabyte of zeros
        (_dict_of(b"c__builtin__\nbytearray\n\x8a\x06" + bytes(5) + b"\x01\x85R"), "no name"),
        # a memo entry that would make Python's unpickler allocate tens of gigabytes
        (b"\x80\x02}r\xf0\xff\xff\xff.", "memo entry 4294967280"),
        (_dict_of(b"X\xff\xff\xff\x7fabc"), "only"),
        (_dict_of(b"\x8d" + b"\xff" * 8), "byte count"),
        (_dict_of(b"\x8e" + b"\xff" * 7 + b"\x00"), "only"),
        (_dict_of(b"cbuiltins\nlist\n(]tR"), f"holds Pickled|{NO_STORAGE}"),
        (_dict_of(b"ccollections\nOrderedDict\n(]tR"), "takes 1 positional argument"),
        # one list copied again and again, a few bytes each
        (
            b"\x80\x02ccollections\nOrderedDict\nq\x00]q\x01("
            + b"K\x01K\x02\x86" * 3000
            + b"e("
            + b"h\x00h\x01\x85R" * 6000
            + b"t.",
            "again and again|1 positional argument|more than",
        ),
        # hashing a tuple as deep as this ends the process
        (b"\x80\x02})" + b"\x85" * 100_000 + b"K\x01s.", "keys are neither"),
        # an empty list is one byte here and 56 in memory
        (b"\x80\x02(" + b"]" * 1_000_000 + b"t.", "more than 1000000 opcodes"),
    ],
)
def test_malformed_content_is_refused_with_the_reason(
    content: bytes, reason: str, write: Writer, tmp_path: Path
) -> None:
    with pytest.raises(WeightsError, match=reason) as caught:
        read_checkpoint(write(tmp_path / "w.pt", content))
    assert caught.value.code == "weights.format"
    assert str(tmp_path / "w.pt") in str(caught.value)


@WRITERS
@pytest.mark.parametrize(
    "call",
    [
        b"X\x07\x00\x00\x00_codecsX\x06\x00\x00\x00encode\x93X\x00\x00\x00\x00X\x03\x00\x00\x00hex\x86R",
        b"(X\x00\x00\x00\x00X\x03\x00\x00\x00heximd5\n_codecs\nencode\n",
        b"\x82\x01",
        b"\x96\xff\xff\xff\xff\xff\xff\xff\x00",
    ],
)
def test_other_ways_to_name_and_to_make_things_are_refused(
    call: bytes, write: Writer, tmp_path: Path
) -> None:
    with pytest.raises(WeightsError, match="does not hold complete, plain tensors"):
        read_checkpoint(write(tmp_path / "w.pt", _dict_of(call)))


@WRITERS
@pytest.mark.parametrize("kind", [b"O", b"<i2", b"S9", b"(9,)f4", b"<f4,<f4"])
def test_numbers_are_of_no_other_type(kind: bytes, write: Writer, tmp_path: Path) -> None:
    text = b"X" + struct.pack("<I", len(kind)) + kind
    content = _dict_of(_tensor().replace(b"ctorch\nFloatStorage\n", text))
    with pytest.raises(WeightsError, match="named as torch names none"):
        read_checkpoint(write(tmp_path / "w.pt", content))


@pytest.mark.parametrize("name", sorted(_KNOWN))
@pytest.mark.parametrize("state", [b"}X\x01\x00\x00\x00aNs", b"N}X\x01\x00\x00\x00aNs\x86"])
def test_a_file_cannot_change_what_names_stand_for(name: str, state: bytes, tmp_path: Path) -> None:
    module, _, rest = name.rpartition(".")
    content = _dict_of(f"c{module}\n{rest}\n".encode() + state + b"b")
    with pytest.raises(WeightsError):
        read_checkpoint(_zip_file(tmp_path / "w.pt", content))
    assert not hasattr(_KNOWN[name], "a")


def _doubled(tuples: int) -> bytes:
    """A tuple of the one before, twice, and so on: hashing it takes two to that power."""
    steps = [b"N\x85q\x00"]
    for number in range(tuples):
        old, new = bytes([number]), bytes([number + 1])
        steps.append(b"h" + old + b"h" + old + b"\x86q" + new)
    return b"(" + b"".join(steps) + b"t"


@WRITERS
@pytest.mark.parametrize(
    "content",
    [
        b"\x80\x02}" + _doubled(60) + b"K\x01s.",
        b"\x80\x02}(" + _doubled(60) + b"K\x01u.",
        # numbers with equal hashes
        b"\x80\x02}(" + b"\x8a\x09" + (2**64 + 7).to_bytes(9, "little") + b"K\x01u.",
        # a mark that is kept, so that keys and values change places
        b"\x80\x02}(q\x00)K\x01u.",
    ],
)
def test_keys_that_take_forever_are_refused(content: bytes, write: Writer, tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match=r"keys are neither|more than 8 bytes|not there"):
        read_checkpoint(write(tmp_path / "w.pt", content))


def test_a_text_that_becomes_bytes_again_and_again_is_refused_whatever_follows(
    tmp_path: Path,
) -> None:
    text = b"X" + struct.pack("<I", 2**20) + b"a" * 2**20 + b"q\x01"
    encoded = b"c_codecs\nencode\nh\x01X\x06\x00\x00\x00latin1\x86R"
    content = b"\x80\x02}(" + b"X\x01\x00\x00\x00a" + text
    content += b"".join(b"K%c" % number + encoded for number in range(80))
    padding = b"X\x01\x00\x00\x00zX" + struct.pack("<I", 2**23) + b"z" * 2**23
    with pytest.raises(WeightsError, match="again and again"):
        read_checkpoint(_zip_file(tmp_path / "w.pt", content + padding + b"u."))


@WRITERS
@pytest.mark.parametrize(
    ("tensor", "reason"),
    [
        # a billion times the same number
        (
            _tensor().replace(b"(K\x02t(K\x01t", b"(J\x00\x00\x00\x40t(K\x00t"),
            "more than 268435456 bytes",
        ),
        (_tensor().replace(b")RtR", b")R}X\x03\x00\x00\x00neg\x88stR"), "describes none"),
    ],
)
def test_tensors_that_are_more_than_their_numbers_are_refused(
    tensor: bytes, reason: str, write: Writer, tmp_path: Path
) -> None:
    with pytest.raises(WeightsError, match=reason):
        read_checkpoint(write(tmp_path / "w.pt", _dict_of(tensor)))


def test_views_of_storages_are_refused(tmp_path: Path) -> None:
    view = _tensor().replace(b"NtQ", b"(X\x01\x00\x00\x008K\x01K\x01ttQ")
    with pytest.raises(WeightsError, match="named as torch names none"):
        read_checkpoint(_old_file(tmp_path / "w.pt", _dict_of(view)))


def test_archives_of_very_many_members_are_refused_unread(tmp_path: Path) -> None:
    path = _zip_file(tmp_path / "w.pt", _dict_of(_tensor()))
    with zipfile.ZipFile(path, "a") as archive:
        for number in range(10_000):
            archive.writestr(f"archive/{number}", b"")
    with pytest.raises(WeightsError, match="more than 10000 members"):
        read_checkpoint(path)


@WRITERS
def test_check_of_tensors_cannot_be_switched_off_by_the_file(write: Writer, tmp_path: Path) -> None:
    far_away = struct.pack("<i", -(10**9))  # a stride that would read outside of the storage
    tensor = TENSOR[TENSOR.index(b"(X") :]
    storage = b"(X" + tensor[2 : tensor.index(b"Q") + 1] % 2
    ordered_dict = b"ccollections\nOrderedDict\n"
    content = (
        *(b"\x80\x02", ordered_dict, b")R", b"X\x06\x00\x00\x00weight"),
        *(b"](", storage, b"K\x00", b"K\x02\x85", b"J", far_away, b"\x85", b"es"),
        *(b"}X\x05\x00\x00\x00items", ordered_dict, b"sb."),
    )
    with pytest.raises(WeightsError, match="holds list"):
        read_checkpoint(write(tmp_path / "w.pt", b"".join(content)))


def test_storage_shorter_than_it_says_is_refused(tmp_path: Path) -> None:
    content = _dict_of(_tensor(length=3, size=3))
    for path in (
        _zip_file(tmp_path / "zip.pt", content),
        _old_file(tmp_path / "old.pt", content),
        _old_file(tmp_path / "declared.pt", content, values=(1, 2, 3)),
    ):
        if path.name == "declared.pt":
            path.write_bytes(path.read_bytes()[:-4])
        with pytest.raises(WeightsError, match="does not hold complete, plain tensors"):
            read_checkpoint(path)


@pytest.mark.parametrize("keys", [[], ["6"], [["7"]], ("7",), {"6": "7"}])
def test_storage_whose_numbers_are_not_there_is_refused(keys: object, tmp_path: Path) -> None:
    path = _old_file(tmp_path / "w.pt", _dict_of(_tensor()))
    path.write_bytes(path.read_bytes().replace(pickle.dumps(["7"], 2), pickle.dumps(keys, 2)))
    with pytest.raises(WeightsError, match="does not hold complete, plain tensors"):
        read_checkpoint(path)


def test_zip_that_unpacks_to_more_than_the_file_is_refused(tmp_path: Path) -> None:
    bomb = _zip_file(
        tmp_path / "w.pt",
        _dict_of(_tensor()),
        numbers=bytes(10_000_000),
        compression=zipfile.ZIP_DEFLATED,
    )
    with pytest.raises(WeightsError, match="compressed"):
        read_checkpoint(bomb)


def test_zip_with_two_members_of_one_name_is_refused(tmp_path: Path) -> None:
    path = _zip_file(tmp_path / "w.pt", _dict_of(_tensor()))
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("archive/DATA.pkl", _dict_of(_tensor()))
    with pytest.raises(WeightsError, match="several members of one name"):
        read_checkpoint(path)


def test_big_endian_files_of_the_older_layout_are_refused(tmp_path: Path) -> None:
    content = OLD_START + pickle.dumps({"little_endian": False}, 2) + _dict_of(_tensor())
    (tmp_path / "w.pt").write_bytes(content)
    with pytest.raises(WeightsError, match="little-endian"):
        read_checkpoint(tmp_path / "w.pt")


@pytest.mark.parametrize("content", [b"", b"PK", b"<html>404</html>", b"PK\x03\x04" + bytes(99)])
def test_what_is_no_weights_file_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "w.pt").write_bytes(content)
    with pytest.raises(WeightsError, match="a state dict saved by"):
        read_checkpoint(tmp_path / "w.pt")


def test_every_truncation_is_refused(tmp_path: Path) -> None:
    for write in (_old_file, _zip_file):
        whole = write(tmp_path / "whole.pt", _dict_of(_tensor())).read_bytes()
        for length in range(len(whole)):
            (tmp_path / "cut.pt").write_bytes(whole[:length])
            with pytest.raises(WeightsError):
                read_checkpoint(tmp_path / "cut.pt")


def test_random_damage_never_raises_anything_else(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    for write in (_old_file, _zip_file):
        whole = write(tmp_path / "whole.pt", _dict_of(_tensor())).read_bytes()
        for _ in range(300):
            damaged = bytearray(whole)
            for position in generator.integers(len(whole), size=3):
                damaged[position] = generator.integers(256)
            (tmp_path / "damaged.pt").write_bytes(damaged)
            try:
                checkpoint = read_checkpoint(tmp_path / "damaged.pt")
            except WeightsError:
                continue
            assert all(array.size <= 2 for array in checkpoint.tensors.values())


def test_file_beyond_the_size_limit_is_refused(tmp_path: Path) -> None:
    with (tmp_path / "w.pt").open("wb") as file:
        file.truncate(MAX_FILE_BYTES + 1)  # sparse
    with pytest.raises(WeightsError, match="too large"):
        read_checkpoint(tmp_path / "w.pt")


def test_missing_weights_say_what_to_download_and_where_to_put_it(tmp_path: Path) -> None:
    for weights_dir in (None, tmp_path, tmp_path / "absent"):
        with pytest.raises(WeightsError) as caught:
            read_weights(weights_dir, FASTER2D2_WASF_N16)
        assert caught.value.code == "weights.missing"
        for part in (
            "faster2d2_WASF_N16.pt",
            "https://github.com/naver/r2d2",
            "CC BY-NC-SA 3.0",
            "non-commercial",
            "--weights-dir",
            "VISLOC_WEIGHTS_DIR",
        ):
            assert part in str(caught.value)


def test_folder_in_place_of_the_file_counts_as_missing(tmp_path: Path) -> None:
    (tmp_path / R2D2_WASF_N16.file_name).mkdir()
    with pytest.raises(WeightsError, match="download"):
        read_weights(tmp_path, R2D2_WASF_N16)


def _checkpoint(**tensors: np.ndarray[Any, Any]) -> Checkpoint:
    return Checkpoint(Path("w.pt"), "0" * 64, tensors)


@pytest.mark.parametrize(
    ("tensors", "difference"),
    [
        ({"a": np.ones(2)}, "b"),
        ({"a": np.ones(2), "b": np.ones(3), "c": np.ones(1)}, "c"),
        ({"a": np.ones((2, 1)), "b": np.ones(3)}, "a"),
    ],
)
def test_other_tensors_than_the_networks_are_named(
    tensors: dict[str, np.ndarray[Any, Any]], difference: str
) -> None:
    with pytest.raises(WeightsError, match=f"first difference is {difference}") as caught:
        check_shapes(
            _checkpoint(**tensors), {"a": (2,), "b": (3,)}, network="Net", held="another network"
        )
    assert caught.value.code == "weights.network"


def test_file_of_another_sha256_is_refused_before_it_is_read(tmp_path: Path) -> None:
    (tmp_path / "w.pt").write_bytes(b"not weights")
    with pytest.raises(WeightsError) as caught:
        read_checkpoint(tmp_path / "w.pt", sha256="0" * 64)
    assert caught.value.code == "weights.altered"


@pytest.mark.parametrize(
    "tensors",
    [{"a": np.array([1, np.nan])}, {"a": np.array([np.inf, 0])}, {"bn.running_var": -np.ones(2)}],
)
def test_numbers_that_no_network_has_are_refused(tensors: dict[str, Any]) -> None:
    shapes = {name: array.shape for name, array in tensors.items()}
    with pytest.raises(WeightsError) as caught:
        check_shapes(_checkpoint(**tensors), shapes, network="Net", held="another network")
    assert caught.value.code == "weights.values"
