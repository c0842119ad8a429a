"""File descriptors: raises the limit for the connections, or lowers their number."""

from __future__ import annotations

import logging
import resource

from service.settings import ServiceSettings, SettingsError

logger = logging.getLogger(__name__)

# Connections of the metrics port.
METRICS_CONNECTIONS = 32
# Libraries, logs, keys, maps, uploads, the store, and connections beyond the limit until they are
# closed.
_OWN = 192
# A service with fewer connections is refused.
_LEAST_CONNECTIONS = 10
# Pipes to and from a worker process.
_PER_WORKER = 16


def fit_connections(settings: ServiceSettings) -> ServiceSettings:
    """Raise the soft limit of open files as needed, or lower ``max_connections``.

    HTTP and gRPC have ``max_connections`` each. Processes that are started later inherit the limit.
    """
    own = _OWN + _PER_WORKER * settings.workers + METRICS_CONNECTIONS
    needed = own + 2 * settings.max_connections
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    available = needed if hard == resource.RLIM_INFINITY else min(hard, needed)
    if soft != resource.RLIM_INFINITY and soft < available:
        resource.setrlimit(resource.RLIMIT_NOFILE, (available, hard))
        logger.info("limit of open files raised from %d to %d", soft, available)
    fitting = (available - own) // 2
    least = min(_LEAST_CONNECTIONS, settings.max_connections)
    if fitting < least:
        raise SettingsError(
            f"{hard} open files are allowed (ulimit -Hn), {own + 2 * least} are the least that is"
            " needed"
        )
    if fitting >= settings.max_connections:
        return settings
    logger.warning(
        "max_connections is %d instead of %d: %d open files are allowed (ulimit -Hn), %d needed",
        *(fitting, settings.max_connections, hard, needed),
    )
    return settings.model_copy(update={"max_connections": fitting})
