"""Tables in Markdown of where photos are lost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np
from scipy.stats import chi2

from benchmarks.change.stages import OPTIONS, STAGES, Staged

# Chi-square of a position: 95 % of the squared distances are below it.
_INSIDE = float(chi2.ppf(0.95, 3))


def write_tables(found: Sequence[Staged]) -> Iterator[str]:
    """Yield the lines of two tables: stages, and retrieval by global descriptor."""
    conditions = list(dict.fromkeys(each.condition for each in found))
    yield "\n**Where photos are lost**\n"
    yield (
        "| condition | photos | right | wrong | lost in retrieval | matching | pose | gate "
        "| refused because | median error | truth inside the stated 95 % |"
    )
    yield "|---|---|---|---|---|---|---|---|---|---|---|"
    for condition in conditions:
        rows = [each for each in found if each.condition == condition]
        yield _stages(condition, rows)
    names = list(dict.fromkeys(name for each in found for name in each.ranks))
    yield f"\n**Retrieval: a photo of the place among the first {OPTIONS.top_k}**\n"
    yield f"| condition | photos | {' | '.join(names)} |"
    yield f"|---|---|{'---|' * len(names)}"
    for condition in conditions:
        rows = [each for each in found if each.condition == condition]
        shares = [
            sum(0 < each.ranks[name] <= OPTIONS.top_k for each in rows if name in each.ranks)
            for name in names
        ]
        yield f"| {condition} | {len(rows)} | {' | '.join(map(str, shares))} |"


def _stages(condition: str, rows: Sequence[Staged]) -> str:
    counts = Counter(each.lost for each in rows)
    reasons = Counter(each.reason for each in rows if each.reason is not None)
    told = ", ".join(f"{reason} {count}" for reason, count in reasons.most_common()) or "-"
    errors = [each.error for each in rows if each.lost == "right" and each.error is not None]
    error = f"{np.median(errors):.3f}" if errors else "-"
    lost = [counts[stage] for stage in ("right", "wrong", *STAGES[1:5])]
    distances = [each.distance2 for each in rows if each.distance2 is not None]
    inside = f"{np.mean(np.array(distances) <= _INSIDE):.0%}" if distances else "-"
    cells = [condition, len(rows), *lost, told, error, inside]
    return f"| {' | '.join(map(str, cells))} |"
