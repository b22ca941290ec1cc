"""Every figure looks as it did when somebody looked at it.

`pytest -n0 --mpl-generate-path=tests/pictures tests/test_plot_pictures.py` draws them
anew, to be looked at before they are kept.
"""

from pathlib import Path

import drawn
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from jaxscp import plot

FOLDER = Path(__file__).parent / "pictures"


def picture(dpi):
    """A test that returns a figure, to be compared with the one kept."""
    return pytest.mark.mpl_image_compare(
        baseline_dir=str(FOLDER),
        style="default",
        savefig_kwargs={"dpi": dpi},
        # Root mean square of 255: what another version's letters make. A curve that is
        # missing makes more.
        tolerance=6,
    )


def figure(width=5.0, height=3.6, layout="constrained"):
    return Figure(figsize=(width, height), layout=layout)


@picture(54)
def test_top_view():
    made = figure(5.4, 4.4, "compressed")
    mission, _, guess = drawn.flight()
    ax = made.subplots()
    plot.top_view(ax, mission, drawn.routes(), guess, rate_altitude=50.0)
    ax.legend(fontsize="small")
    return made


@picture(48)
def test_isometric():
    made = figure(5.0, 4.4)
    mission, _, guess = drawn.flight()
    ax = made.add_subplot(projection="3d")
    plot.isometric(ax, mission, drawn.routes(), guess).legend(fontsize="small")
    return made


@picture(60)
def test_profile():
    made = figure()
    plot.profile(made.subplots(), drawn.flight()[0], drawn.routes())
    return made


@picture(60)
def test_link():
    made = figure(4.5, 4.5)
    plot.link(made.subplots(3, sharex=True), *drawn.flight()[:2])
    return made


@picture(60)
def test_energy():
    made = figure()
    plot.energy(made.subplots(), *drawn.flight()[:2])
    return made


@picture(27)
def test_mission():
    return plot.mission(*drawn.flight())


@picture(60)
def test_states():
    made = figure()
    plot.states(made.subplots(2, sharex=True), drawn.double_integrator())
    return made


@picture(60)
def test_controls():
    made = figure(5.0, 2.5)
    plot.controls([made.subplots()], drawn.double_integrator())
    return made


@picture(60)
def test_convergence():
    made = figure()
    plot.convergence(made.subplots(), drawn.with_history())
    return made


@picture(60)
def test_costates():
    made = figure()
    plot.costates(made.subplots(2, sharex=True), drawn.double_integrator())
    return made


@picture(60)
def test_multipliers():
    made = figure()
    plot.multipliers(made.subplots(2, sharex=True), drawn.with_multipliers())
    return made


@picture(60)
def test_pareto():
    made = figure()
    x = np.array([20.0, 30.0, 40.0, 60.0])
    values = {"values": x, "objectives": 2e4 + 3.0 * x**2, "slopes": 6.0 * x}
    names = {"requirement": "data required [MB]", "objective": "objective [N² s]"}
    plot.pareto(made.subplots(), **values, **names)
    return made


@picture(60)
def test_gradient_map():
    made = figure(5.0, 4.0, "compressed")
    x, y = np.linspace(0.0, 500.0, 6), np.linspace(0.0, 400.0, 5)
    east, north = np.meshgrid(x - 180.0, y - 250.0)
    values = 4e4 + 0.05 * (east**2 + 1.5 * north**2 + 0.8 * east * north)
    slopes = (2.0 * east + 0.8 * north, 3.0 * north + 0.8 * east)
    labels = ("station, x [m]", "station, y [m]", "objective [N² s]")
    gradients = 0.05 * np.stack(slopes, axis=-1)
    plot.gradient_map(made.subplots(), x, y, values, gradients, labels=labels)
    return made


@picture(60)
def test_ellipses():
    made = figure(4.5, 4.0)
    mission, solution, _ = drawn.flight()
    route = solution.trajectory
    share = np.asarray(route.fractions * (1.0 - route.fractions))
    jacobian = share[:, None, None] * np.array([[4.0, 0.0], [2.0, 4.0]])
    ax = plot.top_view(made.subplots(), mission, route)
    plot.ellipses(ax, route, jacobian, np.diag([100.0, 40.0]), every=3)
    ax.legend(fontsize="small", loc="upper left")
    return made


@picture(60)
def test_animation(tmp_path):
    """Its middle."""
    mission, solution, _ = drawn.flight()
    file = plot.animate(mission, solution, tmp_path / "a.gif", frames=3, dpi=60.0)
    made = Figure(figsize=(9.0, 5.0))
    with Image.open(file) as film:
        film.seek(1)
        made.figimage(np.asarray(film.convert("RGB")))
    return made
