"""The dataset that everything is measured on, and the queries of it that are asked."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from visloc.kapture import read_dataset, write_dataset

Error = Sequence[float]
"""Of a pose: metres and degrees."""


@dataclass(frozen=True, slots=True)
class Bench:
    """What is measured, and where its files go.

    Attributes:
        dataset: holds ``mapping`` and ``query``, kapture datasets.
        features: a name of ``visloc.features.LOCAL_FEATURES``.
        weights_dir: folder with network weights.
        query: the kapture dataset of the queries that are asked.
        num_queries: so many.
        has_depth: whether landmarks are made of depth maps; else of matches.
        work: folder for maps and the like.
    """

    dataset: Path
    features: str
    weights_dir: Path | None
    query: Path
    num_queries: int
    has_depth: bool
    work: Path

    @property
    def mapping(self) -> Path:
        """The kapture dataset of the map."""
        return self.dataset / "mapping"


def make_bench(
    dataset: Path, features: str, weights_dir: Path | None, queries: int | None, work: Path
) -> Bench:
    """Choose the queries, evenly, as the peer's ``--queries`` does."""
    root, mapping = dataset / "query", read_dataset(dataset / "mapping")
    whole = read_dataset(root)
    count = min(queries or len(whole.images), len(whole.images))
    if count < len(whole.images):
        by_name = sorted(whole.images, key=lambda record: record.path)
        step = len(by_name) / count
        chosen = {by_name[int(i * step)].path for i in range(count)}
        root = work / f"query-{count}"
        records = root / "sensors" / "records_data"
        if not records.is_symlink():
            records.parent.mkdir(parents=True, exist_ok=True)
            records.symlink_to((whole.root / "sensors" / "records_data").resolve())
            images = tuple(record for record in whole.images if record.path in chosen)
            write_dataset(replace(whole, root=root, images=images, depth_maps=()))
    return Bench(
        dataset=dataset,
        features=features,
        weights_dir=weights_dir,
        query=root,
        num_queries=count,
        has_depth=bool(mapping.depth_maps),
        work=work,
    )


def read_errors(path: Path) -> list[Error | None]:
    """Read the peer's ``errors.csv``; None for queries without a pose."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.reader(file) if not row[0].startswith("#")]
    errors = [(float(row[1]), float(row[2])) for row in rows]
    return [None if math.isnan(metres) else (metres, degrees) for metres, degrees in errors]


def num_within(errors: Iterable[Error | None], metres: float, degrees: float) -> int:
    """Count poses that are as good as that."""
    return sum(e is not None and e[0] <= metres and e[1] <= degrees for e in errors)
