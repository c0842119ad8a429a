from __future__ import annotations

import multiprocessing
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from mapping.stages.work_folder import WorkFolder, exclusive, key_of
from visloc.errors import Conflict, InvalidInput, Unavailable


def test_a_finished_item_is_not_computed_again(tmp_path: Path) -> None:
    work = WorkFolder(tmp_path)
    calls = []

    def compute() -> Mapping[str, np.ndarray]:
        calls.append(1)
        return {"a": np.arange(3), "b": np.eye(2, dtype=np.float32)}

    key = key_of("stage", 1, photo="x")
    first, second = work.get(key, compute), work.get(key, compute)
    assert calls == [1]
    assert all(np.array_equal(first[name], second[name]) for name in ("a", "b"))


@pytest.mark.parametrize(
    "other",
    [
        key_of("stage", 2, photo="x"),
        key_of("stage", 1, photo="y"),
        key_of("stage", 1, photo="x", scale=1.0),
        key_of("other", 1, photo="x"),
    ],
)
def test_a_key_changes_with_everything_that_goes_in(other: str) -> None:
    assert other != key_of("stage", 1, photo="x")


@pytest.mark.parametrize("torn", [b"", b"PK\x03\x04 torn"])
def test_a_torn_item_is_computed_again(tmp_path: Path, torn: bytes) -> None:
    work = WorkFolder(tmp_path)
    key = key_of("stage", 1)
    work.get(key, lambda: {"a": np.zeros(1)})
    next(tmp_path.rglob("*.npz")).write_bytes(torn)
    assert work.get(key, lambda: {"a": np.ones(1)})["a"].tolist() == [1.0]


def test_a_damaged_item_is_named_and_made_again_by_the_next_build(tmp_path: Path) -> None:
    work = WorkFolder(tmp_path)
    key = key_of("stage", 1)
    work.get(key, lambda: {"a": np.zeros(100)})
    path = next(tmp_path.rglob("*.npz"))
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    assert work.has(key)
    with pytest.raises(Unavailable, match="same command again to redo it") as caught:
        work.read(key)
    assert (caught.value.code, caught.value.field) == ("build.damaged_item", str(path))
    assert not work.has(key)
    assert work.get(key, lambda: {"a": np.ones(1)})["a"].tolist() == [1.0]


def _damaged(good: bytes, rng: np.random.Generator) -> bytes:
    """Cut the file, or overwrite a piece of it, half of the time in its directory at the end."""
    damaged = bytearray(good)
    start = len(good) - int(rng.integers(1, rng.choice([300, len(good)])))
    piece = slice(start, start + int(rng.choice([1, 8, 4096])))
    match rng.integers(3):
        case 0:
            return good[:start]
        case 1:
            damaged[piece] = bytes(len(damaged[piece]))
        case _:
            damaged[piece] = rng.bytes(len(damaged[piece]))
    return bytes(damaged)


@pytest.mark.filterwarnings("ignore")  # of NumPy, about headers
def test_whatever_happened_to_an_item_it_is_good_or_made_again(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    work, key = WorkFolder(tmp_path), key_of("stage", 1)
    item: dict[str, np.ndarray] = {
        "rows": rng.normal(size=(300, 8)).astype(np.float32),
        "offsets": np.arange(700),
        "models": np.array(["PINHOLE", "OPENCV"]),
        "scale": np.array(3.0),
    }
    work.get(key, lambda: item)
    path = next(tmp_path.rglob("*.npz"))
    good = path.read_bytes()
    made = 0
    for _ in range(600):
        path.write_bytes(_damaged(good, rng))
        try:
            found = work.read(key)
        except Unavailable:
            made += 1
            assert not work.has(key)
            path.write_bytes(_damaged(good, rng))
            found = work.get(key, lambda: item)
        assert found.keys() == item.keys()
        assert all(np.array_equal(found[name], item[name]) for name in item)
    assert made > 400


def test_an_item_read_again_may_be_changed_as_one_just_made(tmp_path: Path) -> None:
    work, key = WorkFolder(tmp_path), key_of("stage", 1)
    work.get(key, lambda: {"a": np.zeros(3), "names": np.array(["b"])})
    found = work.read(key)
    found["a"][0] = 1.0
    assert found["a"].tolist() == [1, 0, 0]
    assert found["names"].tolist() == ["b"]


def test_a_failing_computation_leaves_nothing(tmp_path: Path) -> None:
    work = WorkFolder(tmp_path)

    def fail() -> Mapping[str, np.ndarray]:
        raise RuntimeError("no")

    with pytest.raises(RuntimeError):
        work.get(key_of("stage", 1), fail)
    assert list(tmp_path.rglob("*")) == []


def test_only_a_folder_of_its_own_is_taken_for_finished_work(tmp_path: Path) -> None:
    work = WorkFolder(tmp_path / "new" / "room")
    work.claim()
    work.get(key_of("stage", 1), lambda: {"a": np.zeros(1)})
    work.claim()  # of a build that was interrupted
    work.remove()
    assert not work.root.exists()
    work.root.mkdir()
    work.claim()  # it was empty


def test_a_folder_with_files_of_others_is_refused_and_stays(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InvalidInput, match="no build made") as caught:
        WorkFolder(tmp_path).claim()
    assert (caught.value.code, caught.value.field) == ("build.work_dir", "--work-dir")
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def _hold(lock: Path, ready: object, leave: object) -> None:
    with exclusive(lock):
        ready.set()  # type: ignore[attr-defined]
        leave.wait()  # type: ignore[attr-defined]


def test_a_second_build_of_the_same_map_is_refused_until_the_first_ends(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    ready, leave = context.Event(), context.Event()
    lock = tmp_path / "room.lock"
    holder = context.Process(target=_hold, args=(lock, ready, leave))
    holder.start()
    assert ready.wait(60)
    with pytest.raises(Conflict, match="another build"), exclusive(lock):
        pass
    holder.kill()
    holder.join()
    with exclusive(lock):
        pass
