"""A logistic regression from evidence to the probability that a pose is right."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visloc.localization.acceptance.evidence import FEATURES
from visloc.localization.acceptance.probability import ProbabilityModel

# Which way each feature may speak; a weight that the data would turn round becomes 0. Teachers are
# not the world: without it, differences between two correlated features are taken for evidence.
DIRECTIONS = {
    "ratio": 1,
    "supported": 1,
    "tight": 1,
    "coherent": -1,
    "scatter": -1,
    "apart": -1,
    "shown": 1,
    "similar": 1,
    "weak_cells": 1,
    "contradicted": -1,
    "covered": 1,
    "keypoints_outside": -1,
    "expected_outside": -1,
}
# Each map counts as so many right and wrong poses, and no pose more than twice.
_RIGHT_PER_MAP, _WRONG_PER_MAP, _MOST = 100.0, 60.0, 2.0
_RIDGE = 3.0
_STEPS, _LONGEST_STEP, _CLOSE = 100, 3.0, 1e-9
_BINS = 10
_SURE = 0.99


@dataclass(frozen=True, slots=True, eq=False)
class Lessons:
    """Poses known to be right or wrong; arrays have one row per pose."""

    map_ids: NDArray[np.str_]
    kinds: NDArray[np.str_]
    right: NDArray[np.bool_]
    believed: NDArray[np.bool_]
    features: NDArray[np.float64]

    @staticmethod
    def read(folder: Path) -> Lessons:
        """Read what ``teach`` kept."""
        maps = {path.stem: np.load(path) for path in sorted(folder.glob("*.npz"))}
        return Lessons(
            np.concatenate([np.full(len(of["right"]), name) for name, of in maps.items()]),
            np.concatenate([of["kind"] for of in maps.values()]),
            np.concatenate([of["right"] for of in maps.values()]),
            np.concatenate([of["believed"] for of in maps.values()]),
            np.concatenate([of["features"] for of in maps.values()]),
        )

    def selected(self, which: NDArray[np.bool_]) -> Lessons:
        """Keep some."""
        return Lessons(
            self.map_ids[which],
            self.kinds[which],
            self.right[which],
            self.believed[which],
            self.features[which],
        )

    @property
    def weights(self) -> NDArray[np.float64]:
        """(n,) how much each pose counts."""
        weights = np.zeros(len(self.right))
        for name in np.unique(self.map_ids):
            for right, total in ((True, _RIGHT_PER_MAP), (False, _WRONG_PER_MAP)):
                of = (self.map_ids == name) & (self.right == right)
                weights[of] = min(total / max(of.sum(), 1), _MOST)
        return weights


def learn(lessons: Lessons) -> ProbabilityModel:
    """Fit by Newton's method, with a ridge; weights of the wrong sign are left out one by one."""
    means, scales = lessons.features.mean(axis=0), lessons.features.std(axis=0) + 1e-9
    standard = np.column_stack([(lessons.features - means) / scales, np.ones(len(lessons.right))])
    directions = np.array([*(DIRECTIONS[name] for name in FEATURES), 0])
    ridge = np.append(np.full(len(FEATURES), _RIDGE), 1e-6)
    active = np.ones(len(directions), dtype=np.bool_)
    while True:
        fitted = np.zeros(len(directions))
        fitted[active] = _newton(
            standard[:, active], lessons.right.astype(np.float64), lessons.weights, ridge[active]
        )
        against = fitted * directions
        if against.min() >= 0:
            return ProbabilityModel(means, scales, fitted[:-1], float(fitted[-1]))
        active[int(np.argmin(against))] = False


def judged_by_others(lessons: Lessons) -> NDArray[np.float64]:
    """Return probabilities (n,) by models that learned from no pose of the same map."""
    probabilities = np.zeros(len(lessons.right))
    for name in np.unique(lessons.map_ids):
        own = lessons.map_ids == name
        probabilities[own] = learn(lessons.selected(~own)).probability(lessons.features[own])
    return probabilities


def calibration_error(probabilities: NDArray[np.float64], right: NDArray[np.bool_]) -> float:
    """Expected calibration error over ten bins of equal width (Naeini et al. 2015)."""
    bins = np.minimum((probabilities * _BINS).astype(np.int64), _BINS - 1)
    differences = [
        np.abs(np.sum(probabilities[bins == each] - right[bins == each])) for each in range(_BINS)
    ]
    return float(np.sum(differences)) / max(len(right), 1)


def table_of(lessons: Lessons, probabilities: NDArray[np.float64]) -> str:
    """Say, by map and kind, how many poses there are and how many stay with 0.5."""
    lines = [
        "| map | kind | right | kept | wrong, believed by the other gates | kept |",
        "|---|---|---|---|---|---|",
    ]
    kept = lessons.believed & (probabilities >= 0.5)
    for name in np.unique(lessons.map_ids):
        for kind in np.unique(lessons.kinds[lessons.map_ids == name]):
            of = (lessons.map_ids == name) & (lessons.kinds == kind) & lessons.believed
            right, wrong = of & lessons.right, of & ~lessons.right
            counts = [int(each.sum()) for each in (right, right & kept, wrong, wrong & kept)]
            lines.append(f"| {name} | {kind} | {' | '.join(map(str, counts))} |")
    of = lessons.believed
    sure = of & (probabilities >= _SURE)
    lines.append(
        f"\n{int(of.sum())} believed poses: expected calibration error "
        f"{calibration_error(probabilities[of], lessons.right[of]):.3f}; of {int(sure.sum())} with "
        f"at least {_SURE}, {int((sure & ~lessons.right).sum())} wrong"
    )
    return "\n".join(lines)


def _newton(
    rows: NDArray[np.float64],
    right: NDArray[np.float64],
    counts: NDArray[np.float64],
    ridge: NDArray[np.float64],
) -> NDArray[np.float64]:
    weights = np.zeros(rows.shape[1])
    for _ in range(_STEPS):
        chance = 1.0 / (1.0 + np.exp(-rows @ weights))
        gradient = rows.T @ (counts * (chance - right)) + ridge * weights
        curvature = counts * chance * (1.0 - chance)
        step = np.linalg.solve((rows * curvature[:, None]).T @ rows + np.diag(ridge), gradient)
        step *= min(1.0, _LONGEST_STEP / max(float(np.abs(step).max()), _CLOSE))
        weights -= step
        if np.abs(step).max() < _CLOSE:
            break
    return weights
