"""Colours, units, and how limits are shown."""

import re
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from matplotlib.axes import Axes

# A list, or what `Figure.subplots` gives.
ManyAxes: TypeAlias = Axes | Sequence[Axes] | np.ndarray

# The palette of Okabe and Ito, told apart with every common colour vision.
BLACK = "#000000"
BLUE = "#0072B2"
GREEN = "#009E73"
ORANGE = "#E69F00"
PURPLE = "#CC79A7"
SKY = "#56B4E9"
VERMILLION = "#D55E00"
GREY = "#999999"
DARK = "#4D4D4D"

# Kept for limits alone.
LIMIT = VERMILLION
CYCLE = (BLUE, GREEN, PURPLE, ORANGE, SKY, BLACK)
MARGIN = 0.08
MEGA = 1e6
MINUS = "\N{MINUS SIGN}"
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def typeset(unit: str) -> str:
    """A unit with its exponents raised: "N^2 s" becomes "N² s"."""
    return re.sub(r"\^(-?\d+)", lambda found: found[1].translate(_RAISED), unit)


def label(name: str, unit: str) -> str:
    """Axis label with the unit in brackets, if there is one."""
    return f"{name} [{typeset(unit)}]" if unit else name


def listed(axes: ManyAxes, names: Sequence[str], kind: str) -> list[Axes]:
    """One Axes for each name; `figure.subplots()` makes no list of a single one.

    **Raises:** `ValueError` if there are more or fewer.
    """
    each = [axes] if isinstance(axes, Axes) else list(axes)
    if len(each) != len(names):
        raise ValueError(
            f"axes has {len(each)} entries for {len(names)} {kind}s; give one for each "
            f"of {', '.join(names)}."
        )
    return each


def shade_limits(
    ax: Axes, lower: float, upper: float, *, always: bool = False, name: str = ""
) -> Axes:
    """Shade what lies outside the limits, after the data has been drawn.

    A limit farther from the data than the data's own spread is left out, since showing
    it would flatten the curve; `always` shows it all the same. `name` goes to the legend.
    """
    low, high = data_range(ax)
    spread = high - low
    reach = np.inf if always else spread
    shown_low, shown_high = low - MARGIN * spread, high + MARGIN * spread
    if np.isfinite(lower) and low - lower <= reach:
        shown_low = min(shown_low, lower - MARGIN * (high - lower))
    if np.isfinite(upper) and upper - high <= reach:
        shown_high = max(shown_high, upper + MARGIN * (upper - low))
    ax.set_ylim(shown_low, shown_high)
    for limit, edge in ((lower, shown_low), (upper, shown_high)):
        if np.isfinite(limit) and shown_low <= limit <= shown_high:
            ax.axhspan(limit, edge, color=LIMIT, alpha=0.15, linewidth=0)
            ax.axhline(limit, color=LIMIT, linewidth=0.8, label=name or None)
    return ax


def data_range(ax: Axes) -> tuple[float, float]:
    """Smallest and largest finite value drawn, widened where they coincide."""
    drawn = [np.asarray(line.get_ydata(), float) for line in ax.get_lines()]
    values = np.concatenate([*drawn, np.zeros(0)])
    values = values[np.isfinite(values)]
    if values.size == 0:
        return -1.0, 1.0
    low, high = float(values.min()), float(values.max())
    if high - low < 1e-9 * max(1.0, abs(low), abs(high)):
        half = max(0.5, 0.05 * abs(low))
        return low - half, high + half
    return low, high
