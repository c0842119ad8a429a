"""The fuzz targets themselves, on their seeds and a few simple changes of these."""

from __future__ import annotations

import random
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.fuzz import costs
from tests.fuzz.child import TARGETS, make_target
from tests.fuzz.edits import Edit, EditedFolder, decode, encode
from tests.fuzz.target import MAX_MEMORY_BYTES, MemoryExceeded, Watch, refusal
from visloc.errors import InvalidInput

# Pillow warns of what it finds in broken photos; what NumPy says of numbers stays an error.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


def changed(data: bytes, rng: random.Random) -> bytes:
    """A copy with a few other bytes, a part left out, or a part twice."""
    copy = bytearray(data)
    start = rng.randrange(len(data) + 1)
    stop = min(len(data), start + rng.choice((1, 4, 64)))
    match rng.randrange(3):
        case 0:
            copy[start:stop] = rng.randbytes(stop - start)
        case 1:
            del copy[start:stop]
        case _:
            copy[start:start] = data[start:stop]
    return bytes(copy)


@pytest.mark.parametrize("name", TARGETS)
def test_a_target_takes_its_seeds_and_whatever_is_made_of_them(name: str, tmp_path: Path) -> None:
    target = make_target(name, tmp_path)
    seeds = list(target.seeds())
    outcomes = Counter(target.run(seed) for seed in seeds)
    assert outcomes["accepted"] > 0
    rng = random.Random(0)
    for _ in range(150):
        data = changed(rng.choice(seeds), rng)
        outcomes[target.run(data)] += 1
        outcomes[target.run(target.repair(data))] += 1
    outcomes[target.run(b"")] += 1
    assert len(outcomes) > 3  # it gets further than the first check


class Greedy:
    """Takes as many bytes as its input says."""

    def seeds(self) -> Iterator[bytes]:
        yield b"0"

    def run(self, data: bytes) -> str:
        return "accepted" if len(bytes(int(data))) else "refused"

    def repair(self, data: bytes) -> bytes:
        return data


@pytest.mark.skipif(sys.platform != "linux", reason="memory is read from /proc")
def test_memory_that_is_taken_and_given_back_is_noticed() -> None:
    watch = Watch(Greedy())
    watch(b"1000")
    # What the process once had and gave back does not count again.
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    had = 1024 * (int(status["VmPeak"].split()[0]) - int(status["VmSize"].split()[0]))
    with pytest.raises(MemoryExceeded):
        watch(str(had + 2 * MAX_MEMORY_BYTES).encode())


def test_a_refusal_is_one_of_those_that_are_told() -> None:
    assert refusal(InvalidInput("image.empty", "no bytes"), "image.") == "image.empty"
    with pytest.raises(AssertionError):
        refusal(InvalidInput("image.empty", "no bytes"), "kapture.")


def test_edits_come_back_from_their_bytes_and_a_folder_comes_back_from_its_edits(
    tmp_path: Path,
) -> None:
    (tmp_path / "room" / "sub").mkdir(parents=True)
    (tmp_path / "room" / "a").write_bytes(b"0123456789")
    (tmp_path / "room" / "sub" / "b").write_bytes(b"b")
    folder = EditedFolder(tmp_path / "room")
    edits = [Edit("a", "patch", b"\2\0xy"), Edit("sub/b", "link", b"outside")]
    assert decode(folder.names, encode(folder.names, edits, 7)) == (7, edits)
    assert list(folder.alter(edits)) == [("a", b"01xy456789")]
    assert (tmp_path / "room" / "sub" / "b").read_bytes() == b"outside"
    folder.restore()
    assert {name: (tmp_path / "room" / name).read_bytes() for name in folder.names} == folder.good
    assert not (tmp_path / "room" / "sub" / "b").is_symlink()


def _quadratic(data: bytes) -> None:
    sum(data.count(b"a") for each in data if each == ord("a"))


@pytest.mark.skipif(sys.platform != "linux", reason="memory is read from /proc")
def test_the_search_for_costs_finds_what_costs_more_and_measures_it_large() -> None:
    start = costs.Input(b"", b"b", b"")
    parser = costs.Parser("here", 20_000, _quadratic, (start,), (b"a",))
    (slow, size), _ = costs.search(parser, 1.0, seed=1)
    assert size <= parser.max_bytes
    assert slow.seconds > 2 * costs.cost_of(_quadratic, start.of(20_000)).seconds
    _, (large, size) = costs.search(
        costs.Parser("here", 2**22, lambda data: data * 20, (start,)), 0.1, seed=1
    )
    assert large.memory > 10 * size


@pytest.mark.parametrize("name", [name for name in costs.parsers() if "photo:" not in name])
def test_what_reads_strangers_bytes_takes_the_inputs_to_begin_with(name: str) -> None:
    parser = costs.parsers()[name]()
    for given in parser.starts:
        cost = costs.cost_of(parser.read, given.of(2**14))
        assert cost.seconds < 60
