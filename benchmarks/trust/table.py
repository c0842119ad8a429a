"""The tables in Markdown, from outcomes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from benchmarks.trust.maps import FLOOR_11
from benchmarks.trust.measures import calibration_error, uncertainty
from benchmarks.trust.outcomes import Outcome
from benchmarks.trust.scenarios import FOCAL_FACTORS, OWN, PRINT_SHARES, RIG

SURE = 0.99
OWN_NAMES = [*(scenario for scenario, *_ in OWN), RIG]


def write_tables(outcomes: Sequence[Outcome]) -> Iterator[str]:
    """Yield the lines of every table that the outcomes have something for."""
    by_scenario: dict[str, list[Outcome]] = {}
    for each in outcomes:
        by_scenario.setdefault(each.scenario, []).append(each)
    yield from _own(by_scenario)
    yield from _spoiled(by_scenario)
    yield from _places(by_scenario)
    yield from _calibration(outcomes)


def _table(title: str, columns: Sequence[str], rows: Sequence[Sequence[object]]) -> Iterator[str]:
    if rows:
        yield f"\n**{title}**\n"
        yield f"| {' | '.join(columns)} |"
        yield f"|{'---|' * len(columns)}"
        for row in rows:
            yield f"| {' | '.join(map(str, row))} |"


def _own(by_scenario: dict[str, list[Outcome]]) -> Iterator[str]:
    right, stated = [], []
    for name in OWN_NAMES:
        outcomes = by_scenario.get(name, [])
        if not outcomes:
            continue
        found = [each for each in outcomes if each.error is not None]
        angles = [each.error_deg for each in found if each.error_deg is not None]
        medians = "-"
        if found:
            position = float(np.median([each.distance for each in found]))
            medians = f"{100 * position:.2f}, {float(np.median(angles)):.3f}°"
        right.append(
            [
                name,
                len(outcomes),
                sum(each.accepted for each in outcomes),
                sum(each.right is True for each in outcomes),
                sum(each.right is False for each in outcomes),
                _likely(outcomes),
                medians,
            ]
        )
        holds = uncertainty(outcomes)
        if holds is not None:
            stated.append(
                [
                    name,
                    holds.count,
                    f"{holds.inside / holds.count:.0%}",
                    f"{holds.p_value:.2g}",
                    "yes" if holds.holds else "no",
                    f"{holds.ratio:.1f}",
                ]
            )
    yield from _table(
        "Stated uncertainty of the position",
        (
            "photos of",
            "answers",
            "truth inside the stated 95 %",
            "p of the binomial test",
            "holds at 1 %",
            "error over stated deviation, median",
        ),
        stated,
    )
    yield from _table(
        "Photos of the mapped place",
        (
            *("photos of", "photos", "answered", "right", "wrong"),
            *(_OF_LIKELY, "median error, cm (gardenspoint: 0.01 units)"),
        ),
        right,
    )


def _spoiled(by_scenario: dict[str, list[Outcome]]) -> Iterator[str]:
    names = [
        *(f"focal x{factor}" for factor in FOCAL_FACTORS),
        *(f"print {share:.0%}" for share in PRINT_SHARES),
        *("mirrored", "enlarged half", "corner", "stretched"),
    ]
    rows = []
    for name in names:
        outcomes = by_scenario.get(name, [])
        if outcomes:
            far = [each.distance for each in outcomes if each.accepted and each.error is not None]
            rows.append([*_counts(name, outcomes), f"{np.median(far):.2f} m" if far else "-"])
    yield from _table(
        "Spoiled photos of redkitchen: wrong is further than 15 cm, or any pose of a print",
        (*_COUNTS, "median error"),
        rows,
    )


def _places(by_scenario: dict[str, list[Outcome]]) -> Iterator[str]:
    rows = []
    for map_id in FLOOR_11:
        for what in ("other floors", "held out"):
            name = f"{map_id}: {what}"
            rows += [_counts(name, by_scenario[name])] if name in by_scenario else []
    for name, outcomes in by_scenario.items():
        if name.startswith(("floors as a set", "night", "photos of")):
            rows.append(_counts(name, outcomes))
    yield from _table("Other floors, other places, and the same place at night", _COUNTS, rows)


LIKELY = 0.8
_OF_LIKELY = f"right, wrong at a probability of {LIKELY}"
_COUNTS = ("what", "photos", "accepted", "right", "wrong", _OF_LIKELY, "refused because")


def _likely(outcomes: Sequence[Outcome]) -> str:
    """Count the answers that are left for a caller who gates on the probability."""
    kept = [each.right for each in outcomes if each.accepted and (each.probability or 0) >= LIKELY]
    return f"{kept.count(True)}, {kept.count(False)}"


def _counts(name: str, outcomes: Sequence[Outcome]) -> list[object]:
    reasons = Counter(each.reason for each in outcomes if not each.accepted)
    return [
        name,
        len(outcomes),
        sum(each.accepted for each in outcomes),
        sum(each.right is True for each in outcomes),
        sum(each.right is False for each in outcomes),
        _likely(outcomes),
        ", ".join(f"{reason} {count}" for reason, count in reasons.most_common()) or "-",
    ]


# Where probabilities err in opposite directions; the sum over all hides it.
_KINDS: Mapping[str, tuple[str, ...]] = {
    "by night": ("gardenspoint night", "night by number"),
    "of floors that look alike": ("lobby11", "hallway11", "floors as a set"),
}


def _calibration(outcomes: Sequence[Outcome]) -> Iterator[str]:
    # Night photos of gardenspoint that have a pose are asked by number too. One photo in one map
    # has one answer, which counts once.
    known = {
        (each.map_id, each.photo, each.probability): each
        for each in outcomes
        if each.probability is not None and each.right is not None
    }.values()
    rows = []
    for name in ("all", *_KINDS, "others"):
        of_kind = [each for each in known if name in ("all", _kind(each))]
        if of_kind and (name == "all" or len(of_kind) < len(known)):
            rows.append([name, *_calibrated(of_kind)])
    yield from _table(
        "Calibration of `probability`",
        (
            *("photos", "answers whose rightness is known", "stated in the mean", "right"),
            "expected calibration error, 10 bins",
            *(f"answers of at least {SURE}", "wrong among these"),
        ),
        rows,
    )


def _kind(outcome: Outcome) -> str:
    return next((k for k, start in _KINDS.items() if outcome.scenario.startswith(start)), "others")


def _calibrated(outcomes: Sequence[Outcome]) -> list[object]:
    stated = [each.probability or 0.0 for each in outcomes]
    right = [each.right is True for each in outcomes]
    of_sure = [came for probability, came in zip(stated, right, strict=True) if probability >= SURE]
    return [
        len(outcomes),
        f"{np.mean(stated):.2f}",
        f"{np.mean(right):.2f}",
        f"{calibration_error(stated, right):.3f}",
        len(of_sure),
        of_sure.count(False),
    ]
