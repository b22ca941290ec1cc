"""The ten missions: the paper's figures, changes to them, and their guesses."""

import json
import math
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.testing import assert_allclose

from jaxscp import missions
from jaxscp._validation import check_guess
from jaxscp.models import Channel, Cylinders, Quadrotor

NAMES = (
    "free-flight",
    "urban-flight",
    "free-space-30MB",
    "free-space-50MB",
    "free-space-70MB",
    "urban-30MB",
    "free-space-30MB-60dB",
    "free-space-50MB-60dB",
    "free-space-70MB-60dB",
    "urban-30MB-60dB",
)
# Paths that scripts rely on.
CONTRACT = (
    "vehicle.mass",
    "vehicle.inertia",
    "channel.ground_station",
    "channel.snr_constant",
    "channel.path_loss_exponent",
    "channel.reflection_attenuation",
    "channel.bandwidth",
    "data_required",
    "obstacles.centers",
    "obstacles.safe_distances",
    "start",
    "goal",
    "altitude_floor",
    "limits.tilt",
    "limits.thrust",
    "limits.torque",
)


def entry(mission, path):
    value = json.loads(mission.to_json())
    for name in path.split("."):
        value = value[name]
    return value


def test_there_are_ten():
    assert missions.names() == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_what_is_limited_is_known_of_traced_missions_too(name):
    mission = missions.get(name)
    state = mission.problem().state
    found = tuple(
        tuple(np.isfinite(limit).tolist()) for limit in (state.lower, state.upper)
    )
    assert state.limited == found
    seen = []
    jax.eval_shape(
        lambda start: seen.append(
            eqx.tree_at(lambda m: m.start, mission, start).problem().state.limited
        ),
        mission.start,
    )
    assert seen == [found]


def test_where_limits_hold_has_two_answers():
    with pytest.raises(ValueError, match="enforce='everywhere': choose 'nodes' or"):
        missions.solve(missions.get("free-flight"), enforce="everywhere")


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"'free-fligth': no such .*free-flight, urban"):
        missions.get("free-fligth")


@pytest.mark.parametrize("name", NAMES)
def test_the_paper_s_figures(name):
    mission = missions.get(name)
    problem = mission.problem()
    assert mission.name == name
    assert "\n" not in mission.summary
    start, goal = np.zeros((2, 12))
    start[:3], goal[:3] = [0, 0, 10], [500, 500, 100]
    for bounds, expected in (
        (problem.initial_state, start),
        (problem.final_state, goal),
    ):
        assert_allclose(bounds.lower, expected)
        assert_allclose(bounds.upper, expected)
        assert bounds.is_fixed.all()
    tilt = np.radians(35.0)
    assert_allclose(problem.state.upper[6:8], [tilt, tilt])
    assert_allclose(problem.state.lower[6:8], [-tilt, -tilt])
    assert np.isinf(problem.state.upper[np.r_[0:6, 8:12]]).all()
    assert_allclose(problem.control.lower, [0, -1, -1, -0.5])
    assert_allclose(problem.control.upper, [58.86, 1, 1, 0.5], rtol=1e-12)
    assert isinstance(problem.dynamics, Quadrotor)
    assert float(problem.dynamics.mass) == 3.0
    assert_allclose(problem.dynamics.inertia, np.array([0.04, 0.04, 0.08]))


@pytest.mark.parametrize("name", NAMES)
def test_requirements_follow_from_the_name(name):
    mission = missions.get(name)
    problem = mission.problem()
    megabytes = re.search(r"(\d+)MB", name)
    if megabytes:
        bounds = problem.integrals["data"].bounds
        assert float(bounds.lower) == 8e6 * int(megabytes[1])
        assert float(bounds.upper) == np.inf
        assert float(problem.state.lower[2]) == 10.0
        channel = problem.integrals["data"].integrand
        assert isinstance(channel, Channel)
        b = 1e6 if name.endswith("-60dB") else 60.0
        assert float(channel.snr_constant) == b
        assert_allclose(channel.ground_station, [200, 400, 0])
    else:
        assert problem.integrals == {}
        assert float(problem.state.lower[2]) == -np.inf
    if name.startswith("urban"):
        buildings = problem.path_constraints["buildings"]
        assert isinstance(buildings, Cylinders)
        assert_allclose(buildings.centers, [[190, 200], [420, 400]])
        assert_allclose(buildings.safe_distances, [40, 40])
    else:
        assert problem.path_constraints == {}


def test_names_and_units():
    problem = missions.get("urban-30MB").problem()
    assert " ".join(problem.state_names) == "x y z vx vy vz roll pitch yaw p q r"
    expected = ("thrust", "roll_torque", "pitch_torque", "yaw_torque")
    assert problem.control_names == expected
    named = ("z", "vx", "pitch", "r", "thrust", "yaw_torque", "buildings", "data")
    units = tuple(problem.unit(name) for name in named)
    assert units == ("m", "m/s", "rad", "rad/s", "N", "N m", "m", "bit")


@pytest.mark.parametrize("name", NAMES)
def test_json_gives_the_same_mission_again(name):
    mission = missions.get(name)
    again = missions.Mission.from_json(mission.to_json())
    assert eqx.tree_equal(mission, again)
    assert (again.name, again.summary) == (mission.name, mission.summary)


@given(st.floats(0.1, 1e3), st.lists(st.floats(1e-6, 1.0), min_size=3, max_size=3))
def test_json_keeps_every_digit(mass, inertia):
    changes = {
        "vehicle.mass": mass,
        "vehicle.inertia": inertia,
        "limits.thrust": 20 * mass,
    }
    mission = missions.replace_many(missions.get("free-flight"), changes)
    again = missions.Mission.from_json(mission.to_json())
    assert float(again.vehicle.mass) == mass
    assert again.vehicle.inertia.tolist() == inertia


def test_json_that_is_not_a_mission():
    text = missions.get("free-flight").to_json()
    entries = json.loads(text)
    del entries["vehicle"]["mass"]
    with pytest.raises(ValueError, match=r"^vehicle\.mass is missing"):
        missions.Mission.from_json(json.dumps(entries))
    entries = json.loads(text) | {"weather": "fine"}
    with pytest.raises(ValueError, match=r"^weather: no such entry; valid ones are name"):
        missions.Mission.from_json(json.dumps(entries))
    entries = json.loads(text) | {"vehicle": 3}
    with pytest.raises(ValueError, match=r"^vehicle=3: give an object"):
        missions.Mission.from_json(json.dumps(entries))
    with pytest.raises(ValueError, match=r"^\[1, 2\]: give an object"):
        missions.Mission.from_json("[1, 2]")


def test_contract_s_paths_exist():
    assert set(CONTRACT) <= set(missions.paths(missions.get("free-flight")))


@pytest.mark.parametrize("path", missions.paths(missions.get("urban-30MB")))
def test_every_path_takes_the_value_it_has(path):
    mission = missions.get("urban-30MB")
    assert eqx.tree_equal(missions.replace(mission, path, entry(mission, path)), mission)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("vehicle.mass", 4),
        ("vehicle.rotors.drag_ratio", 0.02),
        ("channel.ground_station", [1.0, 2.0, 3.0]),
        ("data_required", None),
        ("altitude_floor", None),
        ("obstacles.centers", [[100.0, 300.0], [300.0, 420.0]]),
        ("limits.torque", [0.1, 0.2, 0.3]),
        ("plan.transit_share", 0.5),
    ],
)
def test_replace_changes_that_entry_and_no_other(path, value):
    mission = missions.get("urban-30MB")
    changed = missions.replace(mission, path, value)
    assert entry(changed, path) == value
    assert eqx.tree_equal(missions.replace(changed, path, entry(mission, path)), mission)


def test_the_number_of_buildings_may_change():
    mission = missions.get("urban-flight")
    changes = {"obstacles.centers": [[250, 200]], "obstacles.safe_distances": [35]}
    assert missions.replace_many(mission, changes).obstacles.count == 1
    none: dict[str, list] = {"obstacles.centers": [], "obstacles.safe_distances": []}
    cleared = missions.replace_many(mission, none)
    assert cleared.problem().path_constraints == {}
    with pytest.raises(ValueError, match=r"obstacles\.safe_distances has 2 entries"):
        missions.replace(mission, "obstacles.centers", [[250, 200]])


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("vehicle.weight", 3, r"vehicle\.weight: no such entry; .* vehicle\.mass, "),
        ("vehicle", 3, r"vehicle: no such entry; .* vehicle\.mass, "),
        ("name", "mine", r"name: no such entry; valid ones are vehicle\.mass, "),
        ("vehicle.mass", -1, r"vehicle\.mass=-1: give a finite number above 0 \[kg\]"),
        ("vehicle.mass", "heavy", r"vehicle\.mass='heavy': give a finite number"),
        ("vehicle.mass", None, r"vehicle\.mass=None: give a finite number"),
        ("vehicle.mass", True, r"vehicle\.mass=True: give a finite number"),
        (
            "vehicle.mass",
            [3.0],
            r"vehicle\.mass has shape \(1,\): give a finite number",
        ),
        ("vehicle.mass", {"kg": 3}, r"vehicle\.mass=\{'kg': 3\}: give a finite number"),
        ("vehicle.mass", np.nan, r"vehicle\.mass=nan: give a finite number"),
        ("vehicle.mass", 10**400, r"vehicle\.mass=1000.*: give a finite number"),
        ("vehicle.mass", 9, r"limits\.thrust=58\.86 N does not carry .* of 88\.29 N"),
        ("vehicle.inertia", [1, 0, 1], r"vehicle\.inertia\[1\]=0: give 3 finite"),
        ("vehicle.rotors.drag_ratio", 0, r"vehicle\.rotors\.drag_ratio=0: give"),
        ("start", [0, 0], r"start has shape \(2,\): give 3 finite numbers \[m\]"),
        ("start", [0, 0, np.inf], r"start\[2\]=inf: give 3 finite numbers"),
        ("start", [0, 0, 5], r"start\[2\]=5 m lies below altitude_floor=10 m: raise"),
        (
            "goal",
            [420, 424, 50],
            r"goal=\[420.0, 424.0, 50.0\] lies 24 m from obstacles\.centers\[1\]="
            r"\[420.0, 400.0\], within its safe distance of 40 m: move goal",
        ),
        ("obstacles.centers", [[1, 2], [3]], r"obstacles\.centers=\[\[1, 2\], \[3\]\]"),
        ("limits.torque", 1.0, r"limits\.torque has shape \(\): give 3 finite"),
        ("limits.tilt", 2.0, r"limits\.tilt=2: give .* above 0 and at most 1\.55"),
        (
            "data_required",
            -1,
            r"data_required=-1: give a finite number above 0 \[bit\]",
        ),
        ("final_time_range", [9, 8], r"final_time_range=\[9, 8\] s: give the shortest"),
    ],
)
def test_wrong_entries_are_one_line_that_says_what_to_give(path, value, message):
    with pytest.raises(ValueError, match=rf"^{message}") as caught:
        missions.replace(missions.get("urban-30MB"), path, value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", NAMES)
def test_guess_joins_both_ends_and_meets_the_requirements(name):
    mission = missions.get(name)
    problem, guess = mission.problem(), mission.guess()
    assert guess.states.shape == (100, 12)
    assert_allclose(guess.states[0], problem.initial_state.target)
    assert_allclose(guess.states[-1], problem.final_state.target)
    assert_allclose(guess.controls, np.tile([29.43, 0, 0, 0], (100, 1)))
    assert (np.asarray(guess.states[:, 2]) >= 10.0 - 1e-9).all()
    assert (np.diff(guess.fractions) > 0).all()
    if mission.data_required is None:
        # The straight line takes 25 s; the way around the buildings is a little longer.
        assert 24.9 < float(guess.final_time) < 26.0
        clearances = jax.vmap(mission.obstacles.clearance)(guess.states)
        assert (np.asarray(clearances) > 0).all()
        return
    sent = mission.channel.throughput(guess.times, guess.states[:, :3])
    assert float(sent) == pytest.approx(float(mission.data_required), rel=0.01)
    inside = mission.obstacles(jnp.zeros(()), guess.states[50], guess.controls[50])
    assert (np.asarray(inside) <= 0).all()


def test_guess_takes_the_shortest_way_between_buildings():
    """Both of the paper's buildings to the right: 8 m longer than the straight line."""
    guess = missions.get("urban-flight").guess(200)
    places = np.asarray(guess.states[:, :2])
    for center in ((190.0, 200.0), (420.0, 400.0)):
        nearest = places[np.argmin(np.linalg.norm(places - center, axis=1))]
        # The left of the way from the origin to (500, 500) is where y exceeds x.
        assert (nearest - center) @ [-1.0, 1.0] > 0


@pytest.mark.parametrize(
    ("name", "count"), [("free-flight", 1), ("urban-flight", 4), ("urban-30MB-60dB", 1)]
)
def test_a_guess_for_each_way_past_the_buildings(name, count):
    mission = missions.get(name)
    guesses = mission.guesses()
    assert len(guesses) == count
    assert eqx.tree_equal(guesses[0], mission.guess())
    ways = set()
    for guess in guesses:
        assert_allclose(guess.fractions, guesses[0].fractions, rtol=0)
        places = np.asarray(guess.states[:, :2])
        sides = []
        for center in np.asarray(mission.obstacles.centers):
            nearest = places[np.argmin(np.linalg.norm(places - center, axis=1))]
            # To the right of the way from the origin to (500, 500).
            sides.append(bool((nearest - center) @ [1.0, -1.0] > 0))
        ways.add(tuple(sides))
    assert len(ways) == count
    times = [float(guess.final_time) for guess in guesses]
    assert times == sorted(times)


def test_a_traced_mission_has_its_shortest_guess():
    mission, found = missions.get("urban-flight"), []

    def guessed(start):
        moved = eqx.tree_at(lambda mission: mission.start, mission, start)
        found.extend(moved.guesses())
        return found[0].final_time

    jax.eval_shape(guessed, mission.start)
    assert len(found) == 1


def test_missions_are_solved_from_all_their_guesses(monkeypatch):
    mission, given = missions.get("urban-flight"), []

    def ask(problem, guess, *settings, **options):
        given.extend(guess)
        raise InterruptedError

    monkeypatch.setattr(missions, "solve_problem", ask)
    with pytest.raises(InterruptedError):
        missions.solve(mission)
    assert eqx.tree_equal(tuple(given), mission.guesses())


def test_guess_follows_the_mission():
    mission = missions.replace_many(
        missions.get("free-space-30MB-60dB"),
        {"channel.ground_station": [100.0, 50.0, 5.0], "data_required": 5e8},
    )
    guess = mission.guess(60)
    away = np.linalg.norm(np.asarray(guess.states[:, :3]) - [100.0, 50.0, 35.0], axis=1)
    assert (away < 1e-9).sum() > 20
    sent = mission.channel.throughput(guess.times, guess.states[:, :3])
    assert float(sent) == pytest.approx(5e8, rel=0.01)


def test_nodes_of_the_guess():
    mission = missions.get("free-space-30MB")
    assert_allclose(np.diff(mission.guess(100).fractions), 1 / 99)
    dense = missions.replace(mission, "plan.transit_share", 0.7)
    steps = np.diff(dense.guess(100).times)
    assert (steps < 1.0).sum() >= 65
    fractions = np.linspace(0, 1, 40) ** 2
    assert_allclose(mission.guess(fractions).fractions, fractions)


def test_a_free_grid_starts_with_more_nodes_outside_the_wait():
    mission = missions.get("free-space-30MB")
    steps = np.diff(missions.guesses(mission, 100, grid="free")[0].times)
    assert (steps < 2.0).sum() >= 18
    assert_allclose(
        missions.guesses(mission, 100)[0].fractions, mission.guess(100).fractions
    )
    own = missions.replace(mission, "plan.transit_share", 0.7)
    free = missions.guesses(own, 100, grid="free")[0]
    assert_allclose(free.fractions, own.guess(100).fractions)
    with pytest.raises(ValueError, match=r"grid='even': choose 'uniform' or 'free'\."):
        missions.solve(mission, grid="even")


def test_guess_with_too_little_to_send_for_a_wait():
    mission = missions.replace(missions.get("free-space-30MB"), "data_required", 10.0)
    guess = mission.guess()
    assert (np.diff(guess.fractions) > 0).all()
    assert float(guess.final_time) < 40.0


@pytest.mark.parametrize("length", [10.0, 100.0, 300.0, 1000.0])
def test_guess_is_not_faster_than_tilt_allows(length):
    """From rest to rest on the level: full tilt one way, then the other."""
    mission = missions.replace_many(
        missions.get("free-flight"), {"start": [0, 0, 50], "goal": [0, length, 50]}
    )
    # Roll and pitch both at their limit: together they lean more than one alone.
    lean = math.acos(math.cos(float(mission.limits.tilt)) ** 2)
    acceleration = float(mission.vehicle.gravity) * math.tan(lean)
    quickest = 2 * math.sqrt(length / acceleration)
    assert quickest < float(mission.guess().final_time) < 2 * quickest


def test_guess_keeps_the_range_of_flight_times():
    mission = missions.get("free-space-30MB")
    shorter = missions.replace(mission, "final_time_range", [5.0, 300.0])
    assert float(shorter.guess().final_time) == 300.0
    longer = missions.replace(missions.get("free-flight"), "final_time_range", [40, 50])
    assert float(longer.guess().final_time) == 40.0


def test_a_flight_to_where_it_starts_takes_the_least_time():
    here = {"start": [10.0, 20.0, 30.0], "goal": [10.0, 20.0, 30.0]}
    mission = missions.replace_many(missions.get("free-flight"), here)
    guess = mission.guess(5)
    assert guess.final_time == mission.final_time_range[0]
    np.testing.assert_array_equal(guess.states[:, :3], [here["start"]] * 5)
    check_guess(mission.problem(), guess)


def test_new_numbers_leave_the_structure_alone():
    traces: list[None] = []

    @eqx.filter_jit
    def rate_of_change(problem, state, control):
        traces.append(None)
        time = jnp.zeros(())
        return (
            problem.dynamics(time, state, control),
            problem.running_cost(time, state, control),
            problem.path_constraints["buildings"](time, state, control),
            problem.integrals["data"].integrand(time, state, control),
        )

    mission = missions.get("urban-30MB")
    for changes in (
        {},
        {"vehicle.mass": 2.5},
        {"channel.snr_constant": 1e6, "data_required": 1e8},
        {"obstacles.centers": [[100, 90], [300, 210]], "limits.tilt": 0.5},
        {"plan.transit_share": None, "start": [1, 2, 30]},
    ):
        problem = missions.replace_many(mission, changes).problem()
        rate_of_change(problem, jnp.ones(12), jnp.ones(4))
    rate_of_change(missions.get("urban-30MB-60dB").problem(), jnp.ones(12), jnp.ones(4))
    assert len(traces) == 1


def test_gradients_reach_every_number_of_a_mission():
    def total(mission):
        problem = mission.problem()
        time, state = jnp.zeros(()), jnp.arange(1.0, 13.0) / 5
        control = jnp.array([30.0, 0.1, 0.2, 0.3])
        integral = problem.integrals["data"]
        limits = (problem.control.upper, problem.state.upper[6:8])
        ends = (problem.initial_state.target, problem.final_state.target)
        return (
            jnp.sum(problem.dynamics(time, state, control))
            + jnp.sum(problem.path_constraints["buildings"](time, state, control))
            + integral.integrand(time, state, control)
            + integral.bounds.lower
            + problem.state.lower[2]
            + sum(jnp.sum(part) for part in (*limits, *ends))
        )

    gradient = eqx.filter_grad(total)(missions.get("urban-30MB"))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    assert float(gradient.data_required) == 1.0
    assert float(gradient.altitude_floor) == 1.0
    assert float(gradient.limits.thrust) == 1.0
    assert_allclose(gradient.start, np.ones(3))
    for part in (gradient.vehicle.mass, gradient.vehicle.inertia, gradient.channel):
        leaves = jax.tree.leaves(part)
        assert all((np.asarray(leaf) != 0).any() for leaf in leaves)
    assert_allclose(gradient.obstacles.safe_distances, [1.0, 1.0])


def test_gradients_are_finite_where_the_guess_does_not_move():
    def total(mission):
        problem = mission.problem()
        return jnp.sum(problem.initial_state.target) + problem.final_time.scale

    station = {"channel.ground_station": [0.0, 0.0, 0.0]}
    mission = missions.replace_many(missions.get("free-space-30MB"), station)
    gradient = eqx.filter_grad(total)(mission)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def test_the_problem_can_be_built_of_traced_numbers():
    @eqx.filter_jit
    def fixed(mission):
        problem = mission.problem()
        assert problem.initial_state.is_fixed.all()
        assert not problem.state.is_fixed.any()
        return problem.initial_state.target

    mission = missions.get("urban-30MB")
    assert_allclose(fixed(mission)[:3], mission.start)
