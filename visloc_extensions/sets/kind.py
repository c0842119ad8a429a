"""What this extension does with the ids of sets: each part is loaded where it is used."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from visloc.archive import SetOutline
from visloc_extensions.sets import files

if TYPE_CHECKING:
    from service.engine.catalog import Catalog
    from service.engine.searches import Search
    from service.telemetry.metrics import Metrics
    from service.workers.instants import ExtractorOf
    from service.workers.open_maps import OpenSet
    from service.workers.pool import Workers


class SetKind:
    """Opens, searches and describes sets of maps."""

    @staticmethod
    def verify(folder: Path) -> SetOutline:
        """Read every byte of a set."""
        return files.verify_set(folder)

    @staticmethod
    def search(catalog: Catalog, workers: Workers, metrics: Metrics) -> Search:
        """Return what answers requests to sets, in the main process of the service."""
        from visloc_extensions.sets.sequences import SetSearches

        return SetSearches(catalog, workers, metrics)

    @staticmethod
    def open(folder: Path, extractor_of: ExtractorOf) -> OpenSet:
        """Open a set in a worker process; torch and OpenCV are loaded."""
        from visloc_extensions.sets.ranking import open_ranker

        return open_ranker(folder, extractor_of)

    @staticmethod
    def shown(folder: Path) -> tuple[dict[str, Any], Callable[[], None]]:
        """Return the contents of a set for programs, and what prints them."""
        from visloc_extensions.sets.display import shown

        return shown(folder)

    @staticmethod
    def check(folder: Path, maps_dir: Path | None) -> None:
        """Check every byte of a set, and its tiles in a folder of maps, and say so."""
        from visloc_extensions.sets.display import check

        check(folder, maps_dir)
