"""A comparison: a dataset is localized with each value of an axis, all else fixed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np

from clients.client import AsyncClient
from clients.evaluation.benchmark import Run, figures_of, known_poses
from clients.evaluation.queries import Query
from clients.evaluation.readers import Reader
from clients.evaluation.run import Outcome, QueryClient
from clients.wire.answers import ServerInfo
from clients.wire.options import options_from_texts
from visloc.errors import Forbidden, Unauthenticated, Unavailable, VislocError, refuse
from visloc.evaluation import Threshold
from visloc_api.words.maps import MapInfo
from visloc_api.words.options import CHOICES, LocalizeOptions


class Axis(StrEnum):
    """The choice that a comparison varies."""

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
    **{axis: CHOICES[axis.value] for axis in Axis if axis.value in CHOICES},
    Axis.TOP_K: ("1", "5", "10", "20", "50"),
}
ALL_TOGETHER = "all"


@dataclass(frozen=True, slots=True)
class Variant:
    """One value of an axis, with the map and the options that it stands for."""

    value: str
    map: MapInfo
    options: LocalizeOptions


@dataclass(slots=True, eq=False)
class Asked:
    """The results with one value.

    Attributes:
        refusal: why the server does not take it at all.
        outcomes: of all requests, in their order.
    """

    variant: Variant
    refusal: VislocError | None = None
    outcomes: list[Outcome] = field(default_factory=list)

    @property
    def run(self) -> Run:
        """The first outcome of each photo, and the times of all, one request after the other."""
        firsts = {outcome.query.name: outcome for outcome in reversed(self.outcomes)}
        photos = list(dict.fromkeys(outcome.query.name for outcome in self.outcomes))
        answered = [(o.seconds, o.result.seconds) for o in self.outcomes if o.result is not None]
        latencies_s = tuple(seconds for seconds, _ in answered)
        return Run(
            tuple(firsts[name] for name in photos),
            latencies_s,
            tuple(stages for _, stages in answered),
            sum(latencies_s),
        )


def parse_values(text: str | None) -> tuple[str, ...]:
    """Parse words with commas between, each once; none for None."""
    if text is None:
        return ()
    values = tuple(value.strip() for value in text.split(","))
    if not all(values) or len(set(values)) < len(values):
        raise refuse("compare.values", field="values", got=text)
    return values


def make_variants(
    axis: Axis, values: Sequence[str], maps: Sequence[MapInfo], fixed: LocalizeOptions
) -> list[Variant]:
    """Return the rows of the table, in its order.

    Args:
        axis: the axis.
        values: of the axis; its usual ones when empty.
        maps: one for each of the local features, else one.
        fixed: the options that do not vary.
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
            Variant(value, info, _changed(fixed, fusion_weights=dict.fromkeys(names, 1.0)))
            for value, names in named.items()
        ]
    if axis is not Axis.TOP_K:
        _check_words(values, DEFAULT_VALUES[axis])
    return [
        Variant(value, info, _changed(fixed, **_parsed(name, value)))
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
    """Localize each photo with each value, one request at a time.

    The speed of a machine drifts, so the values take turns photo by photo, in an order drawn for
    each photo. A first request of each value is not counted: its caches are cold. A value that
    the server refuses is marked and not tried again.

    Args:
        repeats: how often each photo is sent with each value.
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
                    asked[index].outcomes.append(outcome)
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
        axis: the axis.
    """
    return {
        "axis": axis.value,
        **told,
        "server": {"version": server.version},
        "photos": len(queries),
        "photos_with_truth": sum(query.truth is not None for query in queries),
        "metric": all(bool(each.variant.map.metric) for each in asked),
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
    """Send photos until one is answered: the first ones may be broken."""
    for query in queries:
        outcome = await _ask(client, asked, query, readers)
        if outcome is None or outcome.result is not None:
            return


async def _ask(
    client: AsyncClient, asked: Asked, query: Query, readers: Mapping[str, Reader]
) -> Outcome | None:
    """Localize one photo; None for a value that is refused."""
    if asked.refusal is not None:
        return None
    variant = asked.variant
    ref = variant.map.ref
    try:
        return await QueryClient(client, ref, variant.options, readers[ref]).localize(query)
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
    """Refuse now what the server would refuse after everything else was measured."""
    for word in words:
        if word not in known:
            raise refuse(
                "compare.values",
                "the axis does not have this value",
                field="values",
                expected=f"of {', '.join(known)}",
                got=word,
            )


def _changed(options: LocalizeOptions, **changes: Any) -> LocalizeOptions:
    return LocalizeOptions(**options.given() | changes)


def _parsed(name: str, value: str) -> Mapping[str, Any]:
    return options_from_texts([f"{name}={value}"]).given()
