"""Figures: drawn on the Axes given, complete, and without global state."""

import io
import subprocess
import sys

import drawn
import numpy as np
import pytest
from matplotlib.figure import Figure

from jaxscp import plot


@pytest.fixture(scope="module")
def double_integrator():
    return drawn.double_integrator()


@pytest.fixture(scope="module")
def flight():
    return drawn.flight()


def test_states_have_units_and_limits(double_integrator):
    axes = Figure().subplots(2, sharex=True)
    assert plot.states(axes, double_integrator) is axes
    assert [ax.get_ylabel() for ax in axes] == ["position [m]", "speed [m/s]"]
    assert axes[-1].get_xlabel() == "time [s]"
    # The speed's limit is close enough to show, the position's lower one too.
    assert axes[1].get_ylim()[1] > 1.2
    assert axes[1].patches


def test_controls_are_drawn_as_held(double_integrator):
    (ax,) = axes = [Figure().subplots()]
    plot.controls(axes, double_integrator)
    curve = ax.get_lines()[0]
    assert curve.get_drawstyle() == "steps-post"
    np.testing.assert_array_equal(
        curve.get_ydata(), double_integrator.trajectory.controls[:, 0]
    )


def test_a_single_axes_is_one(double_integrator):
    ax = Figure().subplots()
    assert plot.controls(ax, double_integrator) is ax
    assert ax.get_lines()
    with pytest.raises(ValueError, match="axes has 1 entries for 2 states"):
        plot.states(Figure().subplots(), double_integrator)


def test_wrong_number_of_axes_is_refused(double_integrator):
    with pytest.raises(ValueError, match="axes has 1 entries for 2 states"):
        plot.states([Figure().subplots()], double_integrator)


def test_convergence(double_integrator):
    ax = Figure().subplots()
    assert plot.convergence(ax, double_integrator) is ax
    assert ax.get_yscale() == "log"
    assert ax.get_xlabel() == "subproblem"
    assert len(ax.get_lines()) == 3


def test_top_view_shows_the_mission(flight):
    mission, solution, guess = flight
    ax = plot.top_view(Figure().subplots(), mission, solution.trajectory, guess)
    labels = set(ax.get_legend_handles_labels()[1])
    assert labels == {"trajectory", "initial guess", "start", "goal", "ground station"}
    radii = {patch.get_radius() for patch in ax.patches}
    assert radii == {float(d) for d in mission.obstacles.safe_distances}
    lines = {line.get_label(): line for line in ax.get_lines()}
    assert lines["initial guess"].get_linestyle() == ":"
    for label, flown in (("initial guess", guess), ("trajectory", solution.trajectory)):
        np.testing.assert_array_equal(lines[label].get_ydata(), flown.states[:, 1])


def test_several_routes_are_told_apart(flight):
    mission, _, guess = flight
    routes = drawn.routes()
    flat = plot.top_view(Figure().subplots(), mission, routes, guess)
    deep = Figure().add_subplot(projection="3d")
    assert plot.isometric(deep, mission, routes, guess) is deep
    for ax in (flat, deep):
        lines = {line.get_label(): line for line in ax.get_lines()}
        shown = [lines[name] for name in (*routes, "initial guess")]
        assert [line.get_linestyle() for line in shown] == ["-", "--", "-.", ":"]
        assert len({line.get_color() for line in shown}) == 4
    with pytest.raises(ValueError, match="give a trajectory, or at least one by name"):
        plot.top_view(flat, mission, {})


def test_the_rate_map_is_of_the_altitude_given(flight):
    mission, solution, _ = flight
    rates = []
    for altitude in (50.0, 200.0):
        ax = Figure().subplots()
        plot.top_view(ax, mission, solution.trajectory, rate_altitude=altitude)
        (bar,) = ax.child_axes
        assert bar.get_ylabel() == f"data rate at {altitude:g} m [Mbit/s]"
        rates.append(bar.get_ylim()[1])
        (contours,) = ax.collections
        top = contours.levels.searchsorted(bar.get_ylim()[1]) - 1
        middle = contours.get_paths()[top].get_extents().get_points().mean(axis=0)
        np.testing.assert_allclose(middle, (200.0, 400.0), atol=5.0)
    # In line of sight overhead; b = 60, w = 1 MHz, beta = 2.3.
    highest = np.log2(1.0 + 60.0 / np.array([50.0, 200.0]) ** 2.3)
    assert np.all((highest <= rates) & (rates <= 2.5 * highest))
    with pytest.raises(ValueError, match="rate_altitude=nan: give a finite altitude"):
        plot.top_view(ax, mission, solution.trajectory, rate_altitude=np.nan)


def test_profile(flight):
    mission, solution, _ = flight
    route = solution.trajectory
    x, y, z = np.asarray(route.states)[:, :3].T
    ax = plot.profile(Figure().subplots(), mission, route)
    lines = {line.get_label(): line for line in ax.get_lines()}
    distance = np.sum(np.hypot(np.diff(x), np.diff(y)))
    assert lines["trajectory"].get_xdata()[-1] == pytest.approx(distance)
    # Safe distances are 40 m.
    beside = np.hypot(x - 190.0, y - 200.0) <= 60.0
    beside |= np.hypot(x - 420.0, y - 400.0) <= 60.0
    assert 0 < beside.sum() < beside.size
    band = lines["beside a building"].get_ydata()
    np.testing.assert_array_equal(band, np.where(beside, z, np.nan))
    ax = plot.profile(Figure().subplots(), mission, route, over="time")
    np.testing.assert_array_equal(ax.get_lines()[0].get_xdata(), route.times)
    assert ax.get_xlabel() == "time [s]"
    with pytest.raises(ValueError, match="over='height': choose 'distance' or 'time'"):
        plot.profile(ax, mission, route, over="height")


def test_link_follows_the_papers_formulas(flight):
    mission, solution, _ = flight
    axes = plot.link(Figure().subplots(3), mission, solution)
    rate, elevation, sight = (ax.get_lines()[0] for ax in axes)
    place = np.asarray(solution.sample(rate.get_xdata()).states)[:, :3]
    away = place - (200.0, 400.0, 0.0)
    distance = np.linalg.norm(away, axis=1)
    angle = np.degrees(np.arcsin(away[:, 2] / distance))
    probability = 1.0 / (1.0 + 10.0 * np.exp(-0.6 * (angle - 10.0)))
    ratio = 60.0 * (0.2 + 0.8 * probability) / distance**2.3
    np.testing.assert_allclose(elevation.get_ydata(), angle, rtol=1e-6)
    np.testing.assert_allclose(sight.get_ydata(), probability, rtol=1e-6)
    np.testing.assert_allclose(rate.get_ydata(), np.log2(1.0 + ratio), rtol=1e-6)
    with pytest.raises(ValueError, match="axes has 2 entries for 3 curves"):
        plot.link(axes[:2], mission, solution)


def test_energy_adds_up(flight):
    mission, solution, _ = flight
    ax = plot.energy(Figure().subplots(), mission, solution)
    times, controls = solution.trajectory.times, solution.trajectory.controls
    steps, hover = np.diff(times), (3.0 * 9.81) ** 2
    # Held from each node to the next.
    spent = np.sum(np.asarray(controls)[:-1] ** 2, axis=1) - hover
    parts = (np.full_like(spent, hover), np.maximum(spent, 0.0), np.minimum(spent, 0.0))
    texts = [text.get_text() for text in ax.get_legend().get_texts()]
    for text, part in zip(texts, parts, strict=True):
        written = text.split(": ")[1].removesuffix(" N² s").replace(",", "")
        assert float(written.replace("\N{MINUS SIGN}", "-")) == round(steps @ part)
    assert ax.get_ylabel() == "control effort [N²]"


@pytest.mark.parametrize("form", ["pdf", "svg"])
def test_mission_figure_is_written(flight, form):
    figure = plot.mission(*flight)
    labels = [ax.get_ylabel() for ax in figure.axes]
    for quantity in ("speed [m/s]", "tilt [deg]", "thrust [N]", "rate [Mbit/s]"):
        assert quantity in labels
    content = io.BytesIO()
    figure.savefig(content, format=form)
    assert len(content.getvalue()) > 10_000


def test_no_display_state_is_touched():
    code = (
        "import sys, jaxscp; assert 'matplotlib' not in sys.modules;"
        "import jaxscp.plot; assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
