"""How accurate a map is when it is pruned to some sizes.

    python -m benchmarks.pruning MAP QUERIES [--sizes 50%,25%] [--weights-dir DIR]

MAP is a folder of a map's version, QUERIES a kapture dataset with poses in its frame. The map is
left as it is. Prints a table in Markdown.
"""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from mapping.maps.editing import content_of, selected
from mapping.own_test.publishing import publish_edited
from visloc.archive import Map, MapStore, open_map
from visloc.features import make_global_descriptor, make_local_features
from visloc_extensions.living_maps.prune_command import accuracy_rows, parse_size
from visloc_extensions.living_maps.pruning.accuracy import of_queries
from visloc_extensions.living_maps.pruning.job import keep_within


def pruned(opened: Map, size: str, root: Path) -> Map:
    """Publish a part of a map in a store of its own."""
    kept = keep_within(opened, parse_size(size, opened.size_bytes), None)
    content = selected(content_of(opened), kept.images, observations=kept.observations)
    return open_map(publish_edited(MapStore(root / size.replace("%", "")), content, "pruned"))


def main(
    map_folder: Annotated[Path, typer.Argument(metavar="MAP")],
    queries: Path,
    sizes: str = "50%,25%",
    weights_dir: Path | None = None,
) -> None:
    """Prune, localize, print."""
    full = open_map(map_folder)
    extractor = make_local_features(full.manifest.local_features.fingerprint.name, weights_dir)
    with tempfile.TemporaryDirectory() as folder:
        maps = [full, *(pruned(full, size, Path(folder)) for size in sizes.split(","))]
        accuracies = of_queries(
            maps,
            queries,
            extractor,
            partial(make_global_descriptor, weights_dir=weights_dir),
            lambda *_: None,
        )
        counts = [opened.manifest.counts for opened in maps]
        rows = [
            ("MB", *(f"{opened.size_bytes / 1e6:.1f}" for opened in maps)),
            ("photos", *(str(count.images) for count in counts)),
            ("landmarks", *(str(count.landmarks) for count in counts)),
            ("observations", *(str(count.observations) for count in counts)),
            *accuracy_rows(tuple(accuracies), metric=full.manifest.world.metric),
        ]
    typer.echo("| | whole | " + " | ".join(sizes.split(",")) + " |")
    typer.echo("|---" * (len(maps) + 1) + "|")
    for row in rows:
        typer.echo("| " + " | ".join(row) + " |")


if __name__ == "__main__":
    typer.run(main)
