"""The figures of the paper's Section V, from flights of our own."""

from collections.abc import Sequence
from typing import cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D

from .. import missions
from .._reproduction import PUBLISHED, READINGS, Reproduction
from ._isometric import isometric
from ._style import BLUE, GREEN, GREY
from ._top_view import top_view

# The paper's Figures 4 and 5: which missions they show.
_FIGURES = {
    "free-space": tuple(name for name in PUBLISHED if name.startswith("free")),
    "urban": tuple(name for name in PUBLISHED if name.startswith("urban")),
}


def reproduction(found: Reproduction) -> dict[str, Figure]:
    """Draw the paper's routes in both readings of b, and the mission times.

    **Returns:** figures by name, such as `free-space-60dB`; those without a trajectory
    are left out.
    """
    figures = {}
    for ending in READINGS.values():
        for name, shown in _FIGURES.items():
            flown = [each + ending for each in shown]
            if any(found.flight(each) is not None for each in flown):
                figures[f"{name}{ending}"] = _routes(found, flown)
    figures["times"] = Figure(figsize=(7.0, 3.5), layout="constrained")
    _times(figures["times"].subplots(), found)
    return figures


def _routes(found: Reproduction, names: Sequence[str]) -> Figure:
    """From above and in space, as the paper has them; guesses dotted."""
    figure = Figure(figsize=(11.0, 5.0), layout="constrained")
    flights = {name: found.flight(name) for name in names}
    routes = {name: flight for name, flight in flights.items() if flight is not None}
    mission = missions.get(names[-1])
    guess = mission.guess(100)
    above = figure.add_subplot(1, 2, 1)
    top_view(above, mission, routes, guess)
    above.legend(loc="upper left", fontsize="small")
    space = figure.add_subplot(1, 2, 2, projection="3d")
    isometric(cast(Axes3D, space), mission, routes, guess)
    return figure


def _times(ax: Axes, found: Reproduction) -> Axes:
    """Mission times, ours beside the paper's, on a logarithmic axis."""
    places, width = np.arange(len(PUBLISHED)), 0.27
    ax.bar(places - width, list(PUBLISHED.values()), width, color=GREY, label="paper")
    for shift, colour, (reading, ending) in zip(
        (0.0, width), (BLUE, GREEN), READINGS.items(), strict=True
    ):
        times = [float(found.row(name + ending)["final_time"]) for name in PUBLISHED]
        ax.bar(places + shift, times, width, color=colour, label=f"ours, {reading}")
    ax.set_xticks(places, list(PUBLISHED))
    ax.set_yscale("log")
    ax.set_ylabel("mission time [s]")
    ax.legend(fontsize="small")
    return ax
