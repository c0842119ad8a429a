from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from visloc.errors import InvalidInput
from visloc.options import Fusion, LocalizeOptions
from visloc.retrieval.fusion import (
    EQUAL_GHARM,
    FUSION_OPERATORS,
    LateFusion,
    chosen_fusion,
    equal_weights,
    gharm,
)

Floats = NDArray[np.float64]
FEW = settings(max_examples=30, deadline=None, derandomize=True)
EVERY = pytest.mark.parametrize("fusion", Fusion)
cosine = st.floats(-1.0, 1.0)


def fused(
    fusion: Fusion, similarities: Floats, weights: Floats | None = None, parameter: float = 0.5
) -> Floats:
    given = equal_weights(len(similarities)) if weights is None else weights
    return FUSION_OPERATORS[fusion](similarities, given, parameter)


@st.composite
def tables(draw: st.DrawFn) -> Floats:
    """Similarities of 1 to 5 descriptors with 1 to 6 photos, many of them equal or extreme."""
    shape = draw(st.tuples(st.integers(1, 5), st.integers(1, 6)))
    elements = cosine | st.sampled_from([-1.0, -0.5, 0.0, 5e-324, 0.3, 1.0])
    return draw(arrays(np.float64, shape, elements=elements))


def weights_of(draw: st.DrawFn, count: int) -> Floats:
    drawn = draw(st.lists(st.floats(1e-6, 1e6), min_size=count, max_size=count))
    weights = np.array(drawn)
    return weights / weights.sum()


@st.composite
def weighted_tables(draw: st.DrawFn) -> tuple[Floats, Floats]:
    table = draw(tables())
    return table, weights_of(draw, len(table))


def test_every_operator_of_the_options_is_there() -> None:
    assert list(FUSION_OPERATORS) == list(Fusion)


@pytest.mark.parametrize(
    ("fusion", "expected"),
    [
        # 1 / mean(1 / 0.9, 1 / 0.6) - 0.5
        (Fusion.GHARM, 0.22),
        (Fusion.MEAN, 0.5),
        (Fusion.POWER, 0.4),  # sqrt(0.16)
        (Fusion.MIN, 0.2),
        (Fusion.MAX, 0.8),
        (Fusion.MEAN_AND_POWER, 0.45),
        (Fusion.MIN_AND_MAX, 0.5),
        (Fusion.MEAN_AND_MIN, 0.35),
        (Fusion.VILLENA_ROMAN, 0.42),  # (0.8 + 0.04 / 1) / 2
        (Fusion.HARMONIC, 0.16),  # 1 / mean(1 / 0.4, 1 / 0.1)
        (Fusion.ROUND_ROBIN, 1.0),
    ],
)
def test_each_operator_gives_its_worked_example(fusion: Fusion, expected: float) -> None:
    assert fused(fusion, np.array([[0.8], [0.2]])) == pytest.approx([expected], rel=1e-12)


def test_weights_count_as_their_formulas_say() -> None:
    similarities, weights = np.array([[0.8], [0.2]]), np.array([0.75, 0.25])
    assert fused(Fusion.MEAN, similarities, weights) == pytest.approx([0.65])
    assert fused(Fusion.POWER, similarities, weights) == pytest.approx([0.8**0.75 * 0.2**0.25])
    assert fused(Fusion.GHARM, similarities, weights) == pytest.approx(
        [2 / (1 / (0.5 + 0.6) + 1 / (0.5 + 0.05)) - 0.5]
    )
    assert fused(Fusion.HARMONIC, similarities, weights) == pytest.approx(
        [0.5 / (0.75 / 0.8 + 0.25 / 0.2)]
    )


@pytest.mark.parametrize(
    "fusion", [Fusion.GHARM, Fusion.MEAN, Fusion.POWER, Fusion.MEAN_AND_POWER, Fusion.HARMONIC]
)
def test_a_descriptor_of_more_weight_decides(fusion: Fusion) -> None:
    # Each photo is liked by one descriptor.
    similarities = np.array([[0.6, 0.4], [0.4, 0.6]])
    a, b = fused(fusion, similarities, np.array([0.6, 0.4]))
    assert a > b


def test_gharm_of_equal_weights_is_the_formula_to_the_last_bit() -> None:
    rng = np.random.default_rng(0)
    for m in range(2, 9):
        similarities = rng.uniform(-0.9, 1.0, (m, 200))
        expected = m / np.sum(1.0 / (0.5 + similarities / m), axis=0) - 0.5
        assert np.array_equal(fused(Fusion.GHARM, similarities), expected)


@FEW
@given(tables())
def test_gharm_of_equal_weights_stays_within_its_bound(similarities: Floats) -> None:
    scores = gharm(similarities, equal_weights(len(similarities)), 0.5)
    assert (np.abs(scores) <= 1.0 / len(similarities) + 1e-9).all()


@EVERY
@FEW
@given(table=weighted_tables())
def test_every_cosine_and_weight_gives_a_number(
    fusion: Fusion, table: tuple[Floats, Floats]
) -> None:
    similarities, weights = table
    before = similarities.copy()
    scores = fused(fusion, similarities, weights)
    assert scores.shape == similarities.shape[1:]
    assert scores.dtype == np.float64
    assert np.isfinite(scores).all()
    assert (np.abs(scores) <= 1.0 + 1e-9).all()
    assert np.array_equal(similarities, before)


@EVERY
@FEW
@given(table=weighted_tables(), data=st.data())
def test_no_score_falls_when_a_similarity_of_its_photo_rises(
    fusion: Fusion, table: tuple[Floats, Floats], data: st.DataObject
) -> None:
    similarities, weights = table
    row, photo = (data.draw(st.integers(0, size - 1)) for size in similarities.shape)
    higher = similarities.copy()
    higher[row, photo] = data.draw(st.floats(similarities[row, photo], 1.0))
    raised = fused(fusion, higher, weights)[photo]
    assert raised >= fused(fusion, similarities, weights)[photo] - 1e-12


@EVERY
@FEW
@given(similarities=tables(), data=st.data())
def test_with_equal_weights_the_order_of_descriptors_does_not_matter(
    fusion: Fusion, similarities: Floats, data: st.DataObject
) -> None:
    if fusion is Fusion.ROUND_ROBIN:
        return  # descriptors take turns in their order
    order = data.draw(st.permutations(range(len(similarities))))
    assert fused(fusion, similarities[order]) == pytest.approx(
        fused(fusion, similarities), rel=1e-9, abs=1e-12
    )


@EVERY
@FEW
@given(table=weighted_tables(), data=st.data())
def test_descriptors_bring_their_weights_along(
    fusion: Fusion, table: tuple[Floats, Floats], data: st.DataObject
) -> None:
    if fusion is Fusion.ROUND_ROBIN:
        return  # descriptors take turns in their order
    similarities, weights = table
    order = data.draw(st.permutations(range(len(similarities))))
    assert fused(fusion, similarities[order], weights[order]) == pytest.approx(
        fused(fusion, similarities, weights), rel=1e-9, abs=1e-12
    )


@EVERY
@FEW
@given(similarities=tables(), data=st.data())
def test_the_order_of_photos_does_not_matter(
    fusion: Fusion, similarities: Floats, data: st.DataObject
) -> None:
    order = data.draw(st.permutations(range(similarities.shape[1])))
    assert np.array_equal(fused(fusion, similarities[:, order]), fused(fusion, similarities)[order])


@EVERY
@FEW
@given(steps=st.lists(st.integers(-1000, 1000), min_size=1, max_size=8), data=st.data())
def test_descriptors_that_agree_rank_as_one(
    fusion: Fusion, steps: list[int], data: st.DataObject
) -> None:
    row = np.array(steps) / 1000.0
    count = data.draw(st.integers(1, 5))
    scores = fused(fusion, np.tile(row, (count, 1)), weights_of(data.draw, count))
    for a, b in itertools.combinations(range(len(row)), 2):
        assert (scores[a] < scores[b]) == (row[a] < row[b])
        assert (scores[a] > scores[b]) == (row[a] > row[b])


@EVERY
@FEW
@given(row=arrays(np.float64, st.integers(1, 6), elements=cosine))
def test_a_single_descriptor_keeps_its_cosines(fusion: Fusion, row: Floats) -> None:
    assert fused(fusion, row[None]).tolist() == row.tolist()


@pytest.mark.parametrize("fusion", [Fusion.POWER, Fusion.HARMONIC, Fusion.GHARM])
@pytest.mark.parametrize("others", [0.2, 1.0])
def test_where_a_formula_ends_the_scores_go_on_without_a_step(
    fusion: Fusion, others: float
) -> None:
    # gharm ends where 0.5 + 0.8 s = 0.
    weights, end = (
        (np.array([0.8, 0.2]), -0.625)
        if fusion is Fusion.GHARM
        else (
            equal_weights(2),
            0.0,
        )
    )
    line = end + np.linspace(-1e-9, 1e-9, 21)
    scores = fused(fusion, np.stack([line, np.full(21, others)]), weights)
    assert (np.diff(scores) > 0).all()
    assert np.ptp(scores) < 1e-4  # the power rises like a root there


@EVERY
def test_no_photos_have_no_scores(fusion: Fusion) -> None:
    assert fused(fusion, np.empty((2, 0))).shape == (0,)


def test_round_robin_takes_the_first_of_each_then_the_second() -> None:
    similarities = np.array(
        [
            [0.9, 0.8, 0.1, 0.0, 0.7],  # 0, 1, 4, 2, 3
            [0.2, 0.3, 0.9, 0.8, 0.1],  # 2, 3, 1, 0, 4
        ]
    )
    scores = fused(Fusion.ROUND_ROBIN, similarities)
    # Round 1: 0 and 2; round 2: 1 and 3; round 3: 4.
    assert np.argsort(-scores).tolist() == [0, 2, 1, 3, 4]
    assert np.sort(scores)[::-1] == pytest.approx([1, 1 / 2, 1 / 3, 1 / 4, 1 / 5])
    # The other descriptor goes first when it comes first, whatever it weighs.
    weighted = fused(Fusion.ROUND_ROBIN, similarities[::-1], np.array([0.3, 0.7]))
    assert np.argsort(-weighted).tolist() == [2, 0, 3, 1, 4]


def robin_of_the_paper(similarities: Floats, k: int) -> list[int]:
    """Take rank 1 of each list in turn, then rank 2, and so on; skip what was taken; stop at k."""
    taken: list[int] = []
    for photos in np.argsort(-similarities, axis=1).T:
        for photo in photos:
            if photo not in taken:
                taken.append(int(photo))
    return taken[:k]


def test_round_robin_takes_what_the_paper_takes_in_2000_random_cases() -> None:
    rng = np.random.default_rng(0)
    for case in range(2000):
        similarities = rng.uniform(-1, 1, (2 + case % 4, 50))
        order = np.argsort(-fused(Fusion.ROUND_ROBIN, similarities), kind="stable")
        for k in (5, 10, 20):
            assert order[:k].tolist() == robin_of_the_paper(similarities, k)


def formulas(s: list[float], a: list[float], p: float) -> dict[Fusion, float]:
    """The operators of the paper (appendix B) and of kapture, one photo at a time."""
    mean = math.fsum(x * y for x, y in zip(a, s, strict=True))
    power = math.prod(y**x for x, y in zip(a, s, strict=True))
    low, high, m = min(s), max(s), len(s)
    gharm_mean = math.fsum(1 / (p + x * y) for x, y in zip(a, s, strict=True)) / m
    return {
        Fusion.GHARM: 1 / gharm_mean - p,
        Fusion.MEAN: mean,
        Fusion.POWER: power,
        Fusion.MIN: low,
        Fusion.MAX: high,
        Fusion.MEAN_AND_POWER: p * mean + (1 - p) * power,
        Fusion.MIN_AND_MAX: p * low + (1 - p) * high,
        Fusion.MEAN_AND_MIN: p * mean + (1 - p) * low,
        Fusion.VILLENA_ROMAN: (1 - p) * high + p * low**2 / (high + low),
        Fusion.HARMONIC: 1 / (m * math.fsum(x / y for x, y in zip(a, s, strict=True))),
    }


def test_operators_are_their_formulas_in_2000_random_cases() -> None:
    rng = np.random.default_rng(1)
    for case in range(2000):
        m = 2 + case % 4
        similarities, weights = rng.uniform(0.01, 1, (m, 1)), rng.dirichlet(np.ones(m))
        parameter = 0.5 if case % 2 else float(rng.uniform(0, 1))
        expected = formulas(similarities[:, 0].tolist(), weights.tolist(), parameter)
        for fusion, value in expected.items():
            found = float(fused(fusion, similarities, weights, parameter)[0])
            assert found == pytest.approx(value, abs=1e-12), fusion


def test_a_large_gamma_tends_to_the_mean() -> None:
    similarities = np.random.default_rng(2).uniform(-1, 1, (3, 20))
    np.testing.assert_allclose(
        fused(Fusion.GHARM, similarities, parameter=100.0), similarities.mean(axis=0) / 3, atol=2e-3
    )


def test_a_share_above_one_is_refused_where_it_is_a_share() -> None:
    large = LocalizeOptions(fusion_parameter=2.0)
    assert chosen_fusion(large, EQUAL_GHARM, ("a",)).parameter == 2.0
    for fusion in (Fusion.MEAN_AND_MIN, Fusion.VILLENA_ROMAN):
        with pytest.raises(InvalidInput) as caught:
            chosen_fusion(large, LateFusion(fusion), ("a",))
        assert caught.value.code == "options.fusion_parameter"


def test_photos_that_nothing_tells_apart_share_a_place() -> None:
    scores = fused(Fusion.ROUND_ROBIN, np.array([[0.5, 0.9, 0.5], [0.4, 0.1, 0.4]]))
    # The first round holds photo 1 for one descriptor, and both others for the other.
    assert scores == pytest.approx([1 / 2, 1.0, 1 / 2])


def test_weights_of_any_sum_are_shares_and_what_has_none_is_left_out() -> None:
    similarities = {"a": np.array([0.8]), "b": np.array([-1.0]), "c": np.array([0.2])}
    fusion = LateFusion(Fusion.MEAN, {"c": 5.0, "a": 15.0})
    assert fusion.counted(similarities) == ("a", "c")
    assert fusion.scores(similarities) == pytest.approx([0.65])
    assert EQUAL_GHARM.counted(similarities) == ("a", "b", "c")


def test_a_query_asks_for_what_it_names_and_gets_the_default_for_the_rest() -> None:
    default = LateFusion(Fusion.POWER, {"b": 2.0})
    names = ("a", "b")
    assert chosen_fusion(LocalizeOptions(), default, names) == default
    assert chosen_fusion(LocalizeOptions(fusion=Fusion.MIN), default, names) == LateFusion(
        Fusion.MIN, {"b": 2.0}
    )
    assert chosen_fusion(LocalizeOptions(fusion_weights={"a": 1}), default, names) == LateFusion(
        Fusion.POWER, {"a": 1}
    )


def test_weights_of_unknown_descriptors_are_refused_with_those_that_there_are() -> None:
    options = LocalizeOptions(fusion_weights={"a": 1.0, "gem": 1.0})
    with pytest.raises(InvalidInput, match="weights of a, b") as caught:
        chosen_fusion(options, EQUAL_GHARM, ("a", "b"))
    error = caught.value
    assert (error.code, error.field, error.got) == (
        *("options.fusion_weights", "options.fusion_weights"),
        "gem",
    )


@pytest.mark.parametrize("weights", [{}, {"a": 0.0}, {"a": -1.0}, {"a": float("nan")}, {"a": 1e7}])
def test_weights_that_mean_nothing_are_refused(weights: dict[str, float]) -> None:
    with pytest.raises(InvalidInput) as caught:
        LocalizeOptions(fusion_weights=weights)
    assert caught.value.code == "options.fusion_weights"
