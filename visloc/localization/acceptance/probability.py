"""The probability that a pose is right, from the evidence for and against it.

A logistic regression with a dozen numbers (``probability.json``), learned from poses that were
known to be right or wrong: ``python -m benchmarks.probability fit`` (docs/decisions/0029).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visloc.localization.acceptance.evidence import FEATURES

MODEL_FILE = Path(__file__).with_name("probability.json")
_FAR = 6.0  # standard deviations: beyond what was learned from, more of a feature says no more


@dataclass(frozen=True, slots=True, eq=False)
class ProbabilityModel:
    """Weights of standardized features.

    Attributes:
        means: (f,) of the features that were learned from.
        scales: (f,) their standard deviations, above 0.
        weights: (f,)
        bias: log odds where every feature has its mean.
    """

    means: NDArray[np.float64]
    scales: NDArray[np.float64]
    weights: NDArray[np.float64]
    bias: float

    def log_odds(self, features: NDArray[np.float64]) -> NDArray[np.float64]:
        """Add up what each feature (..., f) says for the pose, and against it: (...)."""
        standard = np.clip((features - self.means) / self.scales, -_FAR, _FAR)
        return np.asarray(np.sum(standard * self.weights, axis=-1) + self.bias)

    def probability(self, features: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the probabilities (...) that poses with features (..., f) are right."""
        return np.asarray(1.0 / (1.0 + np.exp(-np.clip(self.log_odds(features), -30.0, 30.0))))

    def as_json(self) -> dict[str, Any]:
        """Return what ``read_model`` reads."""
        numbers = {
            name: [float(f"{number:.6g}") for number in row]
            for name, *row in zip(FEATURES, self.means, self.scales, self.weights, strict=True)
        }
        return {"bias": float(f"{self.bias:.6g}"), "mean_scale_weight": numbers}


def read_model(path: Path = MODEL_FILE) -> ProbabilityModel:
    """Read a model; its features must be those of ``FEATURES``, in this order."""
    raw = json.loads(path.read_text(encoding="utf-8"))
    numbers = raw["mean_scale_weight"]
    if tuple(numbers) != FEATURES:
        raise ValueError(f"{path}: features {', '.join(numbers)}, expected {', '.join(FEATURES)}")
    means, scales, weights = np.array(list(numbers.values()), dtype=np.float64).T
    return ProbabilityModel(means, scales, weights, float(raw["bias"]))


@cache
def shipped_model() -> ProbabilityModel:
    """Return the model that answers carry."""
    return read_model()


def against(features: NDArray[np.float64]) -> str:
    """Say in words what the photo shows of what the map has around a pose."""
    value = dict(zip(FEATURES, features.tolist(), strict=True))
    shown = 1.0 / (1.0 + np.exp(-value["shown"]))
    return (
        f"{shown:.0%} of the landmarks that a camera there would see look as in the map, and "
        f"{value['keypoints_outside']:.0%} of the keypoints lie where the pose explains nothing"
    )
