from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from visloc.retrieval.fusion import gharm

cosine = st.floats(-1.0, 1.0)


def test_gharm_gives_the_worked_example() -> None:
    # facts: s = (0.8, 0.2), gamma 0.5, weights 1/2 -> 0.22; equal 0.8 on both -> 0.4
    fused = gharm(np.array([[0.8, 0.8], [0.2, 0.8]]))
    assert fused == pytest.approx([0.22, 0.4])


def test_gharm_keeps_the_cosine_of_a_single_descriptor() -> None:
    similarities = np.array([[0.9, -0.5, 0.1]])
    assert gharm(similarities).tolist() == [0.9, -0.5, 0.1]


@given(arrays(np.float64, st.tuples(st.integers(2, 5), st.integers(1, 6)), elements=cosine))
def test_gharm_is_defined_and_bounded_for_every_cosine(similarities: np.ndarray) -> None:
    fused = gharm(similarities)
    bound = 1.0 / len(similarities) + 1e-9
    assert np.isfinite(fused).all()
    # With two descriptors the pole at s = -1 is where the bound -1/2 is reached.
    assert (np.abs(fused) <= bound).all()


@given(
    arrays(np.float64, (3, 4), elements=cosine),
    st.integers(0, 2),
    st.floats(0.0, 1.0),
)
def test_gharm_never_falls_when_one_similarity_rises(
    similarities: np.ndarray, row: int, rise: float
) -> None:
    higher = similarities.copy()
    higher[row] = np.minimum(higher[row] + rise, 1.0)
    assert (gharm(higher) >= gharm(similarities) - 1e-12).all()


@given(arrays(np.float64, (4, 3), elements=cosine))
def test_gharm_does_not_depend_on_the_order_of_descriptors(similarities: np.ndarray) -> None:
    assert gharm(similarities[::-1]) == pytest.approx(gharm(similarities), abs=1e-9)
