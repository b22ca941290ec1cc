"""Filled contours with a colour bar."""

import functools

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, ListedColormap, LogNorm
from matplotlib.ticker import Locator, LogLocator, MaxNLocator

# How much of each colour is left beside white.
_STRENGTH = 0.42
# Values that span more than this factor get a logarithmic scale.
_WIDE = 300.0


@functools.cache
def pale() -> Colormap:
    """Cividis mixed with white: perceptually uniform, and coloured lines show on it."""
    colours = colormaps["cividis"](np.linspace(0.0, 1.0, 256))[:, :3]
    return ListedColormap(1.0 - _STRENGTH * (1.0 - colours), name="pale cividis")


def filled_contours(
    ax: Axes, x: np.ndarray, y: np.ndarray, values: np.ndarray, name: str
) -> Axes:
    """Fill between level lines of `values`, shape (len(y), len(x)), under all else.

    The colour bar stands beside the Axes, as high as these, and bears the name.
    """
    low, high = float(values.min()), float(values.max())
    if not low < high:
        low, high = low - 0.5, high + 0.5
    wide = 0.0 < low < high / _WIDE
    if wide:
        locator: Locator = LogLocator(subs=(1.0, 2.0, 5.0), numticks=99)
    else:
        locator = MaxNLocator(12, steps=(1, 2, 2.5, 5, 10))
    levels = np.asarray(locator.tick_values(low, high))
    # One level beyond either end, no more.
    first, last = np.searchsorted(levels, low, "right"), np.searchsorted(levels, high)
    levels = levels[max(first - 1, 0) : last + 1]
    filled = ax.contourf(
        *(x, y, values, levels),
        cmap=pale(),
        norm=LogNorm(levels[0], levels[-1]) if wide else None,
        zorder=0,
    )
    # Without edges, viewers of vector graphics show gaps between the levels.
    filled.set_edgecolor("face")
    bar = ax.figure.colorbar(filled, cax=ax.inset_axes((1.03, 0.0, 0.04, 1.0)))
    bar.set_label(name)
    if wide:
        decades = levels[np.isclose(np.log10(levels) % 1.0, 0.0)]
        bar.set_ticks(decades, labels=[f"{decade:g}" for decade in decades])
    return ax
