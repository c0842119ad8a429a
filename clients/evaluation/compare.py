"""What one choice brings: a dataset asked about with each value of an axis, all else fixed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

import numpy as np

from clients.cli.display import unit_of
from clients.client import AsyncClient
from clients.evaluation.benchmark import Run, figures_of, known_poses
from clients.evaluation.queries import Query
from clients.evaluation.running import Outcome, localize_one
from clients.evaluation.sending import Reader
from clients.wire.types import LocalizeOptions, MapInfo, ServerInfo
from visloc.errors import Forbidden, Unauthenticated, Unavailable, VislocError, refuse
from visloc.evaluation import Threshold


class Axis(StrEnum):
    """What is varied."""

    LOCAL_FEATURES = "local-features"  # a map for each
    GLOBAL_FEATURES = "global-features"  # of one map: each alone, then all together
    FUSION = "fusion"
    MATCHER = "matcher"
    SOLVER = "solver"
    TOP_K = "top-k"
    EXTRACTION = "extraction"

    @property
    def option(self) -> str | None:
        """The option that it varies, None when it is the map."""
        if self is Axis.LOCAL_FEATURES:
            return None
        return "fusion_weights" if self is Axis.GLOBAL_FEATURES else self.value.replace("-", "_")


# The values when none are named: all words that the server knows.
DEFAULT_VALUES: Mapping[Axis, tuple[str, ...]] = {
    Axis.FUSION: (
        *("gharm", "mean", "power", "min", "max", "mean_and_power", "min_and_max", "mean_and_min"),
        *("harmonic", "round_robin"),
    ),
    Axis.MATCHER: ("mutual", "ratio", "lightglue"),
    Axis.SOLVER: ("pycolmap", "poselib", "registration"),
    Axis.TOP_K: ("1", "5", "10", "20", "50"),
    Axis.EXTRACTION: ("fast", "default", "accurate"),
}
ALL_TOGETHER = "all"


@dataclass(frozen=True, slots=True)
class Variant:
    """One value of an axis.

    Attributes:
        value: its name.
        map: that is asked.
        options: for every photo.
    """

    value: str
    map: MapInfo
    options: LocalizeOptions


@dataclass(slots=True, eq=False)
class Asked:
    """What became of one value.

    Attributes:
        variant: what was asked for.
        refusal: why the server does not do this at all.
        outcomes: of each photo, by its name; of several requests the first.
        latencies_s: of all answers.
        stage_seconds: of all answers.
    """

    variant: Variant
    refusal: VislocError | None = None
    outcomes: dict[str, Outcome] = field(default_factory=dict)
    latencies_s: list[float] = field(default_factory=list)
    stage_seconds: list[Mapping[str, float]] = field(default_factory=list)

    def keep(self, outcome: Outcome) -> None:
        """Count an outcome."""
        self.outcomes.setdefault(outcome.query.name, outcome)
        if outcome.result is not None:
            self.latencies_s.append(outcome.seconds)
            self.stage_seconds.append(outcome.result.seconds)

    @property
    def run(self) -> Run:
        """What was measured, one request after the other."""
        return Run(
            tuple(self.outcomes.values()),
            tuple(self.latencies_s),
            tuple(self.stage_seconds),
            sum(self.latencies_s),
        )


def parse_values(text: str | None) -> tuple[str, ...]:
    """Parse words with commas between, each once; none for None.

    Raises:
        InvalidInput: ``compare.values``.
    """
    if text is None:
        return ()
    values = tuple(value.strip() for value in text.split(","))
    if not all(values) or len(set(values)) < len(values):
        raise refuse("compare.values", field="values", got=text)
    return values


def make_variants(
    axis: Axis, values: Sequence[str], maps: Sequence[MapInfo], fixed: LocalizeOptions
) -> list[Variant]:
    """Return what is asked about each photo, in the order of the table.

    Args:
        axis: what is varied.
        values: of it; those that are usual when there are none.
        maps: one for each of the local features, else one.
        fixed: the options that do not vary.

    Raises:
        InvalidInput: ``compare.maps``, ``compare.values``, ``compare.option``, or ``options.*``
            for a value that cannot be sent.
    """
    if axis is Axis.LOCAL_FEATURES:
        return _variants_of_maps(values, maps, fixed)
    if len(maps) > 1:
        raise refuse(
            "compare.maps",
            field="map",
            got=", ".join(info.ref for info in maps),
            axis=Axis.LOCAL_FEATURES,
        )
    (info,) = maps
    name = axis.option
    assert name is not None
    if name in fixed.given():
        raise refuse(
            "compare.option",
            field="option",
            expected=f"--values, and no --option {name}=...",
            got=fixed.given()[name],
            axis=axis,
            name=name,
        )
    if axis is Axis.GLOBAL_FEATURES:
        known = info.global_features
        values = values or (*known, *([ALL_TOGETHER] if len(known) > 1 else []))
        named = {value: known if value == ALL_TOGETHER else value.split("+") for value in values}
        for names in named.values():
            _check_words(names, known)
        return [
            Variant(value, info, replace(fixed, fusion_weights=dict.fromkeys(names, 1.0)))
            for value, names in named.items()
        ]
    if axis is not Axis.TOP_K:
        _check_words(values, DEFAULT_VALUES[axis])
    return [
        Variant(value, info, replace(fixed, **_parsed(name, value)))
        for value in values or DEFAULT_VALUES[axis]
    ]


async def ask_each(
    client: AsyncClient,
    variants: Sequence[Variant],
    queries: Sequence[Query],
    readers: Mapping[str, Reader],
    *,
    repeats: int,
    seed: int,
    advance: Callable[[], None],
) -> list[Asked]:
    """Ask about each photo with each value, one request at a time.

    Machines have moods, so the values take turns photo by photo, in an order drawn anew for each.
    Before that, each value is asked about once, which counts for nothing: its caches are cold.
    A value that the server refuses is marked and not asked about again.

    Args:
        client: of the server.
        variants: the values.
        queries: the photos.
        readers: by ``MapInfo.ref``: gives what is sent of a photo.
        repeats: how many times each photo is asked about with each value.
        seed: of the order.
        advance: called once for each photo, repetition and value.

    Raises:
        VislocError: when the server is gone, or refuses all values.
    """
    asked = [Asked(variant) for variant in variants]
    for each in asked:
        await _warm_up(client, each, queries, readers)
    refusals = [each.refusal for each in asked if each.refusal is not None]
    if len(refusals) == len(asked):
        raise refusals[0]
    rng = np.random.default_rng(seed)
    for query in queries:
        for _ in range(repeats):
            for index in rng.permutation(len(asked)):
                outcome = await _ask(client, asked[index], query, readers)
                if outcome is not None:
                    asked[index].keep(outcome)
                advance()
    return asked


def make_comparison(
    axis: Axis,
    asked: Sequence[Asked],
    thresholds: Sequence[Threshold],
    queries: Sequence[Query],
    server: ServerInfo,
    **told: object,
) -> dict[str, Any]:
    """Summarize a comparison as plain JSON; null where nothing can be said.

    Figures are as in the report of ``localize benchmark``.

    Args:
        axis: what was varied.
        asked: what became of each value.
        thresholds: of the recall.
        queries: the photos.
        server: that answered.
        told: what more to write down: how it was called.
    """
    units = {unit_of(each.variant.map) for each in asked}
    return {
        "axis": axis.value,
        **told,
        "server": {"version": server.version},
        "photos": len(queries),
        "photos_with_truth": sum(query.truth is not None for query in queries),
        "metric": units == {"m"},
        "thresholds": [[t.max_position_error_m, t.max_orientation_error_deg] for t in thresholds],
        "values": [_row(each, thresholds) for each in asked],
    }


_FIGURES = (
    *("localized", "recall", "median_position_error_m", "median_orientation_error_deg"),
    *("position_error_m", "orientation_error_deg", "latency_s", "stage_seconds"),
)


def _row(asked: Asked, thresholds: Sequence[Threshold]) -> dict[str, Any]:
    variant, refusal, run = asked.variant, asked.refusal, asked.run
    figures = None if refusal is not None else figures_of(run, known_poses(run), thresholds)
    return {
        "value": variant.value,
        "map": variant.map.ref,
        "local_features": variant.map.local_features,
        "global_features": list(variant.map.global_features),
        "landmarks": variant.map.landmarks,
        "size_bytes": variant.map.size_bytes,
        "options": variant.options.given(),
        "refusal": None if refusal is None else {"code": refusal.code, "message": str(refusal)},
        "errors": sum(outcome.error is not None for outcome in run.outcomes),
        "figures": None if figures is None else {name: figures[name] for name in _FIGURES},
    }


async def _warm_up(
    client: AsyncClient, asked: Asked, queries: Sequence[Query], readers: Mapping[str, Reader]
) -> None:
    """Ask until there is an answer, which needs more than one photo when the first is broken."""
    for query in queries:
        outcome = await _ask(client, asked, query, readers)
        if outcome is None or outcome.result is not None:
            return


async def _ask(
    client: AsyncClient, asked: Asked, query: Query, readers: Mapping[str, Reader]
) -> Outcome | None:
    """Ask about one photo; None for a value that is refused."""
    if asked.refusal is not None:
        return None
    variant = asked.variant
    ref = variant.map.ref
    try:
        return await localize_one(client, query, ref, variant.options, readers[ref])
    except (Unavailable, Unauthenticated, Forbidden):
        raise
    except VislocError as error:
        asked.refusal = error
        return None


def _variants_of_maps(
    values: Sequence[str], maps: Sequence[MapInfo], fixed: LocalizeOptions
) -> list[Variant]:
    if values:
        raise refuse(
            "compare.values",
            f"the values of --axis {Axis.LOCAL_FEATURES} are the maps",
            field="values",
            expected="a --map for each of the local features",
            got=",".join(values),
        )
    refs = [info.ref for info in maps]
    if len(set(refs)) < len(refs):
        raise refuse("compare.maps", "a map is named twice", field="map", expected="different maps")
    kinds = [info.local_features for info in maps]
    return [
        Variant(
            info.local_features
            if kinds.count(info.local_features) == 1
            else f"{info.local_features} ({info.ref})",
            *(info, fixed),
        )
        for info in maps
    ]


def _check_words(words: Sequence[str], known: Sequence[str]) -> None:
    """Refuse what the server would, after everything else was measured."""
    for word in words:
        if word not in known:
            raise refuse(
                "compare.values",
                "the axis does not have this value",
                field="values",
                expected=f"of {', '.join(known)}",
                got=word,
            )


def _parsed(name: str, value: str) -> Mapping[str, Any]:
    return LocalizeOptions.from_texts([f"{name}={value}"]).given()
