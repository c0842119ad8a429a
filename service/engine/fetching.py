"""Maps brought from the store to this machine's disk."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from service.engine.instant_tasks import together
from visloc.archive import MapStore
from visloc.errors import VislocError

# Number of maps that are fetched at the same time.
_MAX_FETCHES = 4


class Fetcher:
    """Fetches versions of maps, each only once at a time. Used from one event loop."""

    def __init__(self, store: MapStore) -> None:
        self._store = store
        # A fetch may take minutes; other work has threads of its own meanwhile.
        self._threads = ThreadPoolExecutor(_MAX_FETCHES, thread_name_prefix="fetch")
        self._fetching: dict[str, asyncio.Future[Path]] = {}  # by id@version

    async def folder(self, ref: str) -> Path:
        """Return the folder of ``id@version`` on this machine; fetch it if necessary."""
        here = await asyncio.to_thread(self._store.at_hand, ref)
        if here is not None:
            return here
        fetching = self._fetching.get(ref)
        if fetching is None:
            loop = asyncio.get_running_loop()
            fetching = loop.run_in_executor(self._threads, self._store.folder, ref)
            self._fetching[ref] = fetching

            def fetched(done: asyncio.Future[Path]) -> None:
                self._fetching.pop(ref, None)
                if not done.cancelled():
                    done.exception()  # retrieved, even if no caller waits any more

            fetching.add_done_callback(fetched)
        return await asyncio.shield(fetching)

    async def away(self, refs: Sequence[str]) -> tuple[str, ...]:
        """Return the versions that must be fetched before they can be used."""

        def is_away(ref: str) -> bool:
            try:
                return self._store.at_hand(ref) is None
            except VislocError:
                return False  # using it reports the error

        return tuple([ref for ref in refs if await asyncio.to_thread(is_away, ref)])

    async def fetch(self, refs: Sequence[str]) -> dict[str, VislocError]:
        """Fetch versions; return the errors of those that failed."""

        async def error_of(ref: str) -> VislocError | None:
            try:
                await self.folder(ref)
            except VislocError as error:
                return error
            return None

        errors = await together(error_of(ref) for ref in refs)
        return {ref: error for ref, error in zip(refs, errors, strict=True) if error is not None}

    def close(self) -> None:
        self._threads.shutdown(wait=False, cancel_futures=True)
