"""Figures as files: in the format that the ending names, whole or not at all."""

import io
from pathlib import Path
from typing import TYPE_CHECKING

from .._writing import write_bytes

if TYPE_CHECKING:
    # Imported where needed: Matplotlib takes a second.
    from matplotlib.figure import Figure


def write_figure(path: str | Path, figure: "Figure") -> None:
    """Write a figure."""
    picture = io.BytesIO()
    figure.savefig(picture, format=_format(path), dpi=150)
    write_bytes(path, picture.getvalue())


def check_format(path: str) -> None:
    """**Raises:** `ValueError` unless the ending names a picture format."""
    from matplotlib.backend_bases import FigureCanvasBase

    known = FigureCanvasBase.get_supported_filetypes()
    if _format(path) not in known:
        raise ValueError(
            f"--plot {path}: the ending {Path(path).suffix!r} names no picture format; "
            f"use one of {', '.join('.' + name for name in sorted(known))}."
        )


def _format(path: str | Path) -> str:
    return Path(path).suffix.removeprefix(".").lower()
