"""``python -m service``: reads the settings, sets up logging, handles signals."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import sys
from multiprocessing import forkserver, get_context
from typing import TYPE_CHECKING

from service.descriptors import fit_connections
from service.settings import ServiceSettings, SettingsError, read_settings
from service.telemetry.logs import configure_logging
from service.telemetry.process_memory import give_back_memory, use_one_heap

if TYPE_CHECKING:
    from service.server import Server

logger = logging.getLogger("service")

# The pause before the next try to start.
RETRY_S = 5.0


def main() -> None:
    """Serve until SIGTERM or SIGINT."""
    try:
        settings = read_settings(sys.argv[1:], os.environ)
    except SettingsError as error:
        sys.exit(f"visloc-service: {error}")
    configure_logging(settings)
    use_one_heap()
    try:
        settings = fit_connections(settings)
    except SettingsError as error:
        sys.exit(f"visloc-service: {error}")
    # Libraries read these once when they are loaded: hence the late import below.
    os.environ.setdefault("OMP_NUM_THREADS", str(settings.threads_per_worker))
    # OpenVINO and compiled matching do the heavy work. OpenBLAS's threads would spin as they wait
    # for each other, on cores that these need.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(settings.max_image_pixels))
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # damaged photos get an answer, no log line
    # The fork server loads its libraries while this process loads the same ones.
    context = get_context("forkserver")
    context.set_forkserver_preload(["service.workers.forkserver"])
    forkserver.ensure_running()
    try:
        asyncio.run(_serve(settings))
    except (OSError, SettingsError) as error:
        sys.exit(f"visloc-service: {error}")
    # Threads that still fetch or verify a map can be cut off: they leave nothing half-done.
    logging.shutdown()
    os._exit(0)


async def _serve(settings: ServiceSettings) -> None:
    from service.server import Server

    server = Server(settings)
    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    stopping = asyncio.create_task(stop.wait())

    # The ports open first, so that /readyz answers while the maps are loaded.
    await server.open()
    loading = asyncio.create_task(_load(server))
    tidying = asyncio.create_task(give_back_memory())
    await asyncio.wait({loading, stopping}, return_when=asyncio.FIRST_COMPLETED)
    if loading.done():
        loading.result()
        logger.info(
            "ready: http://%s:%d grpc://%s:%d, maps: %s",
            *(settings.host, server.http_port, settings.host, server.grpc_port),
            ", ".join(server.engine.status.maps) or f"none in {settings.maps_dir}",
        )
        await stopping
    logger.info("stopping")
    loading.cancel()
    tidying.cancel()
    await asyncio.wait({loading})
    await server.close(settings.drain_timeout_s)


async def _load(server: Server) -> None:
    """Retry until it works: the storage of the maps, for example, may be down for a while."""
    from visloc.errors import Unavailable

    while True:
        try:
            await server.load()
        except Unavailable as error:
            logger.error("cannot start yet; trying again in %g s: %s", RETRY_S, error)  # noqa: TRY400
            await asyncio.sleep(RETRY_S)
        else:
            return


if __name__ == "__main__":
    main()
