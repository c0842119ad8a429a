"""The methods of ``Vision`` as tasks: ``Workers.run(Vision.localize, job, ...)``.

The main process gets their names only, so that it never loads torch and OpenCV; type checkers see
the methods.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from service.workers.vision import Vision
else:

    class _Names:
        def __getattr__(self, name: str) -> str:
            return name

    Vision = _Names()

__all__ = ["Vision"]
