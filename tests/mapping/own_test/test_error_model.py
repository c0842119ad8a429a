from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from mapping.own_test.error_model import fitted_factor, mahalanobis2

INSIDE = chi2.ppf(0.95, 3)


def squares(factor: float, count: int, seed: int = 0) -> np.ndarray:
    """Of errors that are so many times as large as their photos tell."""
    random = np.random.default_rng(seed)
    return factor**2 * np.sum(random.normal(size=(count, 3)) ** 2, axis=1)


@pytest.mark.parametrize("factor", [3.0, 15.0])
def test_the_factor_of_simulated_errors_is_found_and_holds_95_percent(factor: float) -> None:
    found = fitted_factor(squares(factor, 200))
    assert factor < found < 1.35 * factor
    inside = np.mean(squares(factor, 20_000, seed=1) <= found**2 * INSIDE)
    assert 0.95 < inside < 0.998


def test_heavy_tails_lie_inside_too() -> None:
    random = np.random.default_rng(0)

    def heavy(count: int) -> np.ndarray:
        return squares(3.0, count, seed=2) * 8 / random.chisquare(8, count)

    found = fitted_factor(heavy(400))
    assert 0.94 < np.mean(heavy(20_000) <= found**2 * INSIDE) < 0.99


def test_a_photo_that_is_kilometres_off_changes_little() -> None:
    few = squares(3.0, 40)
    assert fitted_factor(np.append(few, 1e12)) < 1.2 * fitted_factor(few)


def test_few_photos_are_not_believed_that_a_map_is_better_than_usual() -> None:
    usual = fitted_factor(np.empty(0))
    few, many = fitted_factor(squares(0.5, 3)), fitted_factor(squares(0.5, 100))
    assert 2.0 < usual < 3.0
    assert 1.0 <= many < few < usual


def test_a_map_is_believed_at_once_that_it_is_worse() -> None:
    assert fitted_factor(squares(15.0, 8)) > 10.0


def test_exact_photos_and_absurd_ones_stay_in_the_range_of_the_manifest() -> None:
    assert 1.0 <= fitted_factor(np.zeros(30)) < 2.5
    assert fitted_factor(np.full(30, 1e20)) == 1000.0


def test_errors_are_measured_in_units_of_their_covariance() -> None:
    errors = np.array([[2.0, 0.0, 0.0], [0.0, 3.0, 4.0]])
    covariances = np.array([np.diag([4.0, 1.0, 1.0]), np.diag([1.0, 9.0, 16.0])])
    assert mahalanobis2(errors, covariances).tolist() == pytest.approx([1.0, 2.0])
