from __future__ import annotations

import numpy as np

from visloc.retrieval.index import GlobalRows, retrieve


def test_retrieve_ranks_by_cosine_and_reports_it() -> None:
    angles = np.radians([80.0, 10.0, 45.0])
    rows = np.column_stack([np.cos(angles), np.sin(angles)]).astype(np.float32)
    index = {"one": GlobalRows(rows)}
    found = retrieve({"one": np.array([1.0, 0.0], dtype=np.float32)}, index, top_k=2)
    assert found.images.tolist() == [1, 2]
    assert np.allclose(found.scores, np.cos(np.radians([10.0, 45.0])), atol=1e-6)
    assert np.allclose(found.similarities["one"], found.scores)


def test_retrieve_prefers_what_both_descriptors_like() -> None:
    unit = np.eye(3, dtype=np.float32)
    mix = (unit[0] + unit[1]) / np.float32(np.sqrt(2.0))
    index = {
        "a": GlobalRows(np.stack([unit[0], mix])),
        "b": GlobalRows(np.stack([unit[1], mix])),
    }
    found = retrieve({"a": unit[0], "b": unit[0]}, index, top_k=2)
    # photo 0 is perfect for a and nothing for b; photo 1 is good for both
    assert found.images.tolist() == [1, 0]


def test_equal_scores_keep_the_order_of_the_map() -> None:
    index = {"a": GlobalRows(np.ones((5, 1), dtype=np.float32))}
    found = retrieve({"a": np.ones(1, dtype=np.float32)}, index, top_k=3)
    assert found.images.tolist() == [0, 1, 2]


def test_a_blank_query_is_similar_to_nothing() -> None:
    index = {"a": GlobalRows(np.ones((2, 1), dtype=np.float32))}
    found = retrieve({"a": np.zeros(1, dtype=np.float32)}, index, top_k=9)
    assert found.scores.tolist() == [0.0, 0.0]
