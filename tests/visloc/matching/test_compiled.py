from __future__ import annotations

import logging
import os
import platform
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from visloc.matching import compiled
from visloc.matching.products import nearest

MACHINE = (platform.system(), platform.machine())
needs_library = pytest.mark.skipif(
    not compiled.LIBRARY.exists(), reason="the compiled search was not built: no C compiler"
)


@pytest.fixture(autouse=True)
def asked_anew() -> object:
    compiled.level.cache_clear()
    yield
    compiled.level.cache_clear()


def test_it_is_built_where_there_is_a_compiler() -> None:
    compiler = shlex.split(os.environ.get("CC", "cc"))[0]
    if MACHINE != ("Linux", "x86_64") or shutil.which(compiler) is None:
        pytest.skip("there is no C compiler, or the machine is of another kind")
    assert compiled.LIBRARY.exists()
    assert ("avx2" in Path("/proc/cpuinfo").read_text().split()) == (compiled.level() > 0)


@needs_library
@given(
    n=st.integers(1, 40),
    m=st.integers(1, 200),
    dim=st.integers(1, 140),
    largest=st.sampled_from([1, 2, 127]),
    seed=st.integers(0, 2**32 - 1),
)
def test_largest_products_are_those_of_the_definition(
    n: int, m: int, dim: int, largest: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    a, b = (rng.integers(-largest - 1, largest + 1, (k, dim)).astype(np.int8) for k in (n, m))
    check(a, b)


@needs_library
@pytest.mark.parametrize("dim", [1, 1024, 2**16 - 1])
@pytest.mark.parametrize("value", [-128, 127])
def test_the_largest_numbers_overflow_nothing(dim: int, value: int) -> None:
    check(np.full((7, dim), -128, np.int8), np.full((70, dim), value, np.int8))


def check(a: NDArray[np.int8], b: NDArray[np.int8]) -> None:
    exact = a.astype(np.int64) @ b.astype(np.int64).T
    for level in range(1, compiled.level() + 1):
        found = compiled.nearest_columns(a, b, with_second=True, at_level=level)
        assert np.array_equal(found.best, exact.max(axis=1))
        assert np.array_equal(found.columns, exact.argmax(axis=1))
        assert np.array_equal(found.column_best, exact.max(axis=0))
        assert found.second is not None
        if len(b) > 1:
            assert np.array_equal(found.second, np.sort(exact, axis=1)[:, -2])
        else:
            assert (found.second < exact.min()).all() or exact.min() == -(2**31)
        alone = compiled.nearest_columns(a, b, with_second=False, at_level=level)
        assert alone.second is None
        assert np.array_equal(alone.best, found.best)
        assert np.array_equal(alone.columns, found.columns)
        assert np.array_equal(alone.column_best, found.column_best)


@needs_library
def test_rows_of_other_arrays_are_copied() -> None:
    rng = np.random.default_rng(0)
    wide = rng.integers(-128, 128, (30, 64)).astype(np.int8)
    check(wide[::2, ::2], np.asfortranarray(wide[:, :32]))


@needs_library
def test_rows_of_another_length_or_kind_are_a_bug() -> None:
    rows = np.ones((3, 8), np.int8)
    for other in (rows[:, :7], rows.astype(np.uint8)):
        with pytest.raises(ValueError, match="do not match"):
            compiled.nearest_columns(rows, other, with_second=False)


@needs_library
def test_code_that_finds_wrong_products_is_not_used(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(compiled, "_is_right", lambda _: False)
    with caplog.at_level(logging.INFO, compiled.__name__):
        assert compiled.level() == 0
    assert "gives wrong matches" in caplog.text


def test_a_library_of_another_system_is_not_used(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "nearest.so").write_bytes(b"\x7fELF of another system")
    monkeypatch.setattr(compiled, "LIBRARY", tmp_path / "nearest.so")
    compiled._library.cache_clear()
    with caplog.at_level(logging.WARNING, compiled.__name__):
        assert compiled.level() == 0
    compiled._library.cache_clear()
    assert f"not by compiled code: {tmp_path}" in caplog.text


def test_without_it_torch_finds_the_same(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rng = np.random.default_rng(1)
    a, b = (rng.integers(-3, 4, (k, 64)).astype(np.int8) for k in (300, 500))
    found = nearest(a, b, with_second=True)
    compiled.level.cache_clear()
    monkeypatch.setattr(compiled, "LIBRARY", tmp_path / "nearest.so")
    with caplog.at_level(logging.INFO, compiled.__name__):
        again = nearest(a, b, with_second=True)
    assert "it was not built" in caplog.text
    for one, other in zip(found, again, strict=True):
        assert np.array_equal(one, other)
