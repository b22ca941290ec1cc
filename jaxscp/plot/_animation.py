"""A flight in motion."""

import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.animation import AbstractMovieWriter, FFMpegWriter, PillowWriter
from matplotlib.figure import Figure

from .._solution import Solution
from .._writing import check_writable, write_bytes
from ..missions import Mission
from ._link import rate
from ._places import ROUTE, positions
from ._profile import profile
from ._series import dense
from ._style import BLACK, GREY, VERMILLION
from ._top_view import top_view

_WRITERS: dict[str, Any] = {".gif": PillowWriter, ".mp4": FFMpegWriter}


def animate(
    mission: Mission,
    solution: Solution,
    file: str | os.PathLike[str],
    *,
    frames: int = 120,
    fps: int = 20,
    dpi: float = 100.0,
) -> Path:
    """Write a film of a flight: its route from above, its altitude and its data rate.

    **Arguments:**

    - `mission`: whose problem was solved.
    - `solution`: states in the mission's order.
    - `file`: ending in .gif, or in .mp4 where ffmpeg is installed.
    - `frames`: how many, evenly spaced in time, at least 2. `fps`: shown a second.
    - `dpi`: of 9 by 5 inches.

    **Returns:** the file, which is written whole or not at all.

    **Raises:** `ValueError` for another ending, a missing ffmpeg, a place that cannot be
    written, and numbers out of range, all before anything is drawn.
    """
    target = Path(file)
    writer = _writer(target, fps)
    if frames < 2:
        raise ValueError(f"frames={frames}: give at least 2.")
    if not dpi > 0:
        raise ValueError(f"dpi={dpi:g}: give a positive resolution.")
    check_writable("file", target)
    scene = _Scene(mission, solution)
    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder) / f"film{target.suffix.lower()}"
        with writer.saving(scene.figure, str(film), dpi):
            for share in np.linspace(0.0, 1.0, frames):
                scene.show(float(share))
                writer.grab_frame()
        write_bytes(target, film.read_bytes())
    return target


def _writer(target: Path, fps: int) -> AbstractMovieWriter:
    """What writes a file of that ending."""
    kind = _WRITERS.get(target.suffix.lower())
    if kind is None:
        raise ValueError(
            f"file={str(target)!r}: the ending {target.suffix!r} names no film format; "
            f"use one of {', '.join(_WRITERS)}."
        )
    if not kind.isAvailable():
        raise ValueError(
            f"file={str(target)!r}: films of that ending need ffmpeg, which is not "
            "installed; install it or use .gif."
        )
    if fps < 1:
        raise ValueError(f"fps={fps}: give at least 1 frame a second.")
    return kind(fps=fps)


class _Scene:
    """The flight's figure, at one moment."""

    def __init__(self, mission: Mission, solution: Solution):
        self.figure = Figure(figsize=(9.0, 5.0), layout="constrained")
        self._route = dense(solution)
        self._place = positions(self._route)
        columns = self.figure.add_gridspec(2, 2, width_ratios=(1.2, 1.0))
        above = self.figure.add_subplot(columns[:, 0])
        top_view(above, mission, self._route)
        (whole,) = (
            line for line in above.get_lines() if line.get_label() == ROUTE["label"]
        )
        whole.set(color=GREY, linewidth=0.9, label="")
        (self._trail,) = above.plot([], [], **ROUTE)
        marker: dict[str, Any] = {"marker": "o", "markersize": 7, "linestyle": "none"}
        (self._vehicle,) = above.plot([], [], color=VERMILLION, label="vehicle", **marker)
        above.legend(loc="upper left", fontsize="small")
        altitude = self.figure.add_subplot(columns[0, 1])
        profile(altitude, mission, self._route, over="time").legend().remove()
        below = self.figure.add_subplot(columns[1, 1], sharex=altitude)
        rate(below, mission, self._route)
        below.set_xlabel("time [s]")
        altitude.set_xlabel("")
        altitude.tick_params(labelbottom=False)
        self._cursors = [
            ax.axvline(0.0, color=BLACK, linewidth=0.8) for ax in (altitude, below)
        ]
        # Laid out once: otherwise every frame would be, and might jump.
        self.figure.draw_without_rendering()
        self.figure.set_layout_engine("none")

    def show(self, share: float) -> None:
        """The moment at that share of the flight time."""
        last = round(share * (len(self._place) - 1))
        self._trail.set_data(*self._place[: last + 1, :2].T)
        self._vehicle.set_data(*self._place[last : last + 1, :2].T)
        now = float(self._route.times[last])
        for cursor in self._cursors:
            cursor.set_xdata([now, now])
