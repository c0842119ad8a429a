"""Opens the executor ``ray``."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager

from mapping.cluster.executors import Executor
from visloc.errors import refuse

# Ray reads these when it is loaded. It reports no usage statistics. Workers see the GPUs of their
# machine. An address where nothing listens is an error within a minute, not thirteen. A batch that
# runs out of memory is retried as often as one whose worker died, not for ever.
_SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_NUM_REDIS_GET_RETRIES": "1",
    "RAY_task_oom_retries": "3",
}


def open_ray(workers: int, address: str) -> AbstractContextManager[Executor]:
    """Return the executor, which ends with its ``with`` block."""
    for setting, value in _SETTINGS.items():
        os.environ.setdefault(setting, value)
    try:
        from visloc_extensions.ray.pool import RayPool  # ray is optional
    except ImportError as error:
        raise refuse("build.no_ray", field="--executor", got=str(error)) from error
    return RayPool(workers, address)
