"""Log lines with which strangers could fill a disk: the first, and how many more there were."""

from __future__ import annotations

from time import monotonic

_PERIOD_S = 60.0
_LINES = 20  # of a kind in a period


class Floods:
    """Tells which lines to write: of each kind the first twenty of a minute."""

    def __init__(self) -> None:
        self._kinds: dict[str, tuple[float, int]] = {}  # when the minute began; lines since

    def passes(self, kind: str) -> tuple[bool, int]:
        """Count a line of a kind.

        Returns:
            Whether to write it, and how many were left out since the last one that was written.
        """
        began, lines = self._kinds.get(kind, (0.0, 0))
        unwritten = max(0, lines - _LINES)
        if monotonic() >= began + _PERIOD_S:
            self._kinds[kind] = monotonic(), 1
            return True, unwritten
        self._kinds[kind] = began, lines + 1
        return lines < _LINES, 0
