"""A figure of matplotlib that notebooks show. Needs matplotlib."""

from __future__ import annotations

import io

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure


class ShownFigure(Figure):
    """A figure without pyplot, whose state it would share with the caller's own figures.

    Notebooks otherwise show such a figure as text only.
    """

    def png(self, dpi: float = 100) -> bytes:
        """Draw the figure as a PNG."""
        FigureCanvasAgg(self)
        data = io.BytesIO()
        self.savefig(data, format="png", dpi=dpi)
        return data.getvalue()

    def _repr_png_(self) -> bytes:
        return self.png()
