"""Figures of the experiments: one page with a title, saved as a picture."""

from __future__ import annotations

from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure


def page(title: str, width: float, height: float) -> Figure:
    """Return an empty figure of ``width`` by ``height`` (inches), drawn without a display."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    return figure


def saved(figure: Figure, path: Path) -> Path:
    """Write a figure as a picture and return its path."""
    figure.savefig(path, dpi=100)
    return path
