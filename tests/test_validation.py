"""Bad input: one line with field, value and fix, before anything compiles."""

import contextlib
import re
from collections.abc import Callable

import equinox as eqx
import jax
import jax.monitoring
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

import jaxscp
from jaxscp import Bounds, Integral, OptimalControlProblem, missions
from jaxscp._validation import check_guess, check_problem

# A size that no other test uses: what these checks compile is compiled here first. And
# long enough that NumPy would break a line of so many numbers.
SIZE = 25
SHARES = np.linspace(1.0, 2.0, SIZE) / 3


@contextlib.contextmanager
def compilations():
    """The compilations within the block, as a list that grows."""
    seen = []

    def note(event: str, duration: float, **details):
        if event == "/jax/core/compile/backend_compile_duration":
            seen.append(duration)

    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        yield seen
    finally:
        jax.monitoring.unregister_event_duration_listener(note)


def decay(t, x, u):
    return u[0] - x


def tanks(**changes) -> OptimalControlProblem:
    """A row of tanks that fill and drain together."""
    settings = {
        "state": Bounds(-np.ones(SIZE), 9.0),
        "control": Bounds(-np.ones(2), np.ones(2)),
        "initial_state": Bounds.exactly(np.zeros(SIZE)),
        "final_state": Bounds.exactly(SHARES),
        "final_time": Bounds(1.0, 5.0),
        "path_constraints": {"level": lambda t, x, u: x - 8.0},
        "integrals": {"flow": Integral(lambda t, x, u: u[0], Bounds(0.0, 4.0))},
        "control_names": ("pump", "valve"),
    }
    return OptimalControlProblem(decay, **(settings | changes))


def with_dynamics(dynamics) -> OptimalControlProblem:
    return eqx.tree_at(lambda problem: problem.dynamics, tanks(), dynamics)


def with_leaf(where, value) -> OptimalControlProblem:
    """New numbers in a problem that was built already: no constructor sees them."""
    return eqx.tree_at(where, tanks(), jnp.asarray(value, float))


def integral(integrand=lambda t, x, u: u[0], bounds=None) -> dict[str, Integral]:
    return {"flow": Integral(integrand, Bounds(0.0, 4.0) if bounds is None else bounds)}


def refuse(call, message, error=ValueError):
    with compilations() as compiled, pytest.raises(error, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)
    assert not compiled


def test_the_listener_hears_a_compilation():
    with compilations() as compiled:
        jax.jit(lambda x: x + 0.123)(jnp.zeros(SIZE))
    heard = len(compiled)
    assert heard > 0
    jax.jit(lambda x: x + 0.321)(jnp.zeros(SIZE))
    assert len(compiled) == heard


def test_a_good_problem_and_guess_pass_without_compiling():
    problem = tanks()
    guess = jaxscp.straight_line(problem, 4)
    with compilations() as compiled:
        check_problem(problem)
        check_guess(problem, guess)
    assert not compiled


SHAPES = {
    "state, scalar": (
        lambda: tanks(
            state=Bounds(0.0, 9.0),
            initial_state=Bounds.free(1),
            final_state=Bounds.free(1),
        ),
        r"state: bounds of shape \(\); give .*\(n,\)",
    ),
    "state, matrix": (
        lambda: tanks(state=Bounds(-np.ones((SIZE, 1)), 9.0)),
        r"state: bounds of shape \(25, 1\); give .*\(n,\)",
    ),
    "state, empty": (
        lambda: tanks(state=Bounds.free(0)),
        r"state: bounds of shape \(0,\); give one lower and one upper",
    ),
    "control": (
        lambda: tanks(control=Bounds(-np.ones((2, 2)), 1.0)),
        r"control: bounds of shape \(2, 2\); give",
    ),
    "initial_state": (
        lambda: tanks(initial_state=Bounds.exactly(np.zeros(3))),
        r"initial_state: bounds of shape \(3,\); the problem needs \(25,\)",
    ),
    "final_state": (
        lambda: tanks(final_state=Bounds.exactly(0.0)),
        r"final_state: bounds of shape \(\); the problem needs \(25,\)",
    ),
    "final_time": (
        lambda: tanks(final_time=Bounds(np.ones(1), 5.0)),
        r"final_time: bounds of shape \(1,\); the problem needs \(\)",
    ),
    "integral": (
        lambda: tanks(integrals=integral(bounds=Bounds(np.zeros(2), 4.0))),
        r"integrals\['flow'\]\.bounds: bounds of shape \(2,\); the problem needs \(\)",
    ),
    "state_names": (
        lambda: tanks(state_names=("a", "b")),
        r"state_names=\('a', 'b'\): give 25 names",
    ),
    "control_names": (
        lambda: tanks(control_names=("a", "b", "c")),
        r"control_names=\('a', 'b', 'c'\): give 2 names",
    ),
}

VALUES = {
    "NaN at the start": (
        lambda: with_leaf(
            lambda p: p.initial_state.lower, np.where(SHARES > 0.6, np.nan, 0.0)
        ),
        r"initial_state\[20\]=nan is fixed but not finite; give a number",
    ),
    "infinite start": (
        lambda: tanks(initial_state=Bounds.exactly(np.where(SHARES > 0.6, np.inf, 0.0))),
        r"initial_state\[20\]=inf is fixed but not finite; give a number",
    ),
    "infinite upper end": (
        lambda: with_leaf(lambda p: p.final_state.upper, np.full(SIZE, np.inf)),
        r"final_state\[0\]=inf is fixed but not finite; give a number",
    ),
    "infinite end": (
        lambda: tanks(final_state=Bounds.exactly(np.full(SIZE, -np.inf))),
        r"final_state\[0\]=-inf is fixed but not finite; give a number",
    ),
    "infinite control": (
        lambda: tanks(control=Bounds.exactly(np.array([0.0, np.inf]))),
        r"control\[1\]=inf is fixed but not finite; give a number",
    ),
    "infinite flight": (
        lambda: tanks(final_time=Bounds.exactly(np.inf)),
        r"final_time=inf is fixed but not finite; give a number",
    ),
    "infinite integral": (
        lambda: tanks(integrals=integral(bounds=Bounds.exactly(np.inf))),
        r"integrals\['flow'\]\.bounds=inf is fixed but not finite; give a number",
    ),
    "unseen limit": (
        lambda: tanks(
            state=Bounds(-np.ones(SIZE), 9.0, limited=((True,) * SIZE, (False,) * SIZE))
        ),
        r"state\[0\] is declared without a limit but has lower=-1 and upper=9; make it",
    ),
    "NaN limit": (
        lambda: with_leaf(lambda p: p.control.upper, [1.0, np.nan]),
        r"control\[1\]: lower=-1 .* upper=nan.*; swap or widen",
    ),
    "state upside down": (
        lambda: with_leaf(lambda p: p.state.lower, 10 * SHARES + 6),
        r"state\[0\]: lower=9\.33333 must not exceed upper=9.*; swap or widen",
    ),
    "integral upside down": (
        lambda: with_leaf(lambda p: p.integrals["flow"].bounds.lower, 4.5),
        r"integrals\['flow'\]\.bounds: lower=4\.5 must not exceed upper=4.*; swap or",
    ),
    "ends of a fixed entry apart": (
        lambda: with_leaf(lambda p: p.final_state.lower, SHARES - 0.125),
        r"final_state\[0\] .* lower=0\.208333 and upper=0\.333333; set both ends to",
    ),
    "start above the limits": (
        lambda: tanks(initial_state=Bounds.exactly(12 * SHARES + 1.5)),
        r"initial_state: x\[22\] between 9\.16\d* and 9\.16\d* lies outside .*"
        r"-1 to 9; move it inside, or widen",
    ),
    "end below the limits": (
        lambda: tanks(final_state=Bounds(np.full(SIZE, -3.0), -2.0)),
        r"final_state: x\[0\] between -3 and -2 lies outside .*-1 to 9; move it inside",
    ),
    "no time": (
        lambda: tanks(final_time=Bounds(0.0, 5.0)),
        r"final_time: lower=0 s must be positive; give",
    ),
    "negative time": (
        lambda: tanks(final_time=Bounds.exactly(-2.0)),
        r"final_time: lower=-2 s must be positive; give",
    ),
}

FUNCTIONS = {
    "dynamics, shape": (
        lambda: with_dynamics(lambda t, x, u: x[1:]),
        r"dynamics returns shape \(24,\); return shape \(25,\)",
    ),
    "dynamics, rank": (
        lambda: with_dynamics(lambda t, x, u: x[:, None]),
        r"dynamics returns shape \(25, 1\); return shape \(25,\)",
    ),
    "dynamics, integers": (
        lambda: with_dynamics(lambda t, x, u: jnp.zeros(SIZE, int)),
        r"dynamics returns int64; return floating-point numbers",
    ),
    "dynamics, truth values": (
        lambda: with_dynamics(lambda t, x, u: x > 0),
        r"dynamics returns bool; return floating-point numbers",
    ),
    "dynamics, complex": (
        lambda: with_dynamics(lambda t, x, u: x + 0j),
        r"dynamics returns complex128; return floating-point numbers",
    ),
    "dynamics, tuple": (
        lambda: with_dynamics(lambda t, x, u: tuple(x)),
        r"dynamics returns tuple; return one array",
    ),
    "dynamics, nothing": (
        lambda: with_dynamics(lambda t, x, u: None),
        r"dynamics returns NoneType; return one array",
    ),
    "running_cost": (
        lambda: tanks(running_cost=lambda t, x, u: u**2),
        r"running_cost returns shape \(2,\); return shape \(\)",
    ),
    "terminal_cost": (
        lambda: tanks(terminal_cost=lambda t_f, x_f: x_f[:1]),
        r"terminal_cost returns shape \(1,\); return shape \(\)",
    ),
    "path constraint, rank 2": (
        lambda: tanks(path_constraints={"level": lambda t, x, u: x[:, None] - 8.0}),
        r"path_constraints\['level'\] returns shape \(25, 1\); return shape \(25,\)",
    ),
    "path constraint, scalar": (
        lambda: tanks(path_constraints={"level": lambda t, x, u: x[0] - 8.0}),
        r"path_constraints\['level'\] returns shape \(\); return shape \(1,\)",
    ),
    "path constraint, integers": (
        lambda: tanks(path_constraints={"level": lambda t, x, u: jnp.zeros(3, int)}),
        r"path_constraints\['level'\] returns int64; return floating-point",
    ),
    "integrand": (
        lambda: tanks(integrals=integral(lambda t, x, u: u)),
        r"integrals\['flow'\]\.integrand returns shape \(2,\); return shape \(\)",
    ),
}


@pytest.mark.parametrize(
    ("problem", "message"),
    [
        pytest.param(*case, id=name)
        for name, case in (SHAPES | VALUES | FUNCTIONS).items()
    ],
)
def test_bad_problems(problem, message):
    problem = problem()
    refuse(lambda: jaxscp.solve(problem, nodes=4), rf"^{message}")


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        (
            (np.where(SHARES > 0.6, np.nan, 0.0), SHARES),
            "Bounds: .*(nan|NaN).*write an infinite limit where an entry is free",
        ),
        (
            (SHARES, np.where(SHARES > 0.6, 0.25, 1.0)),
            r"Bounds: lower\[24\]=0\.666667 exceeds upper\[24\]=0\.25; swap them",
        ),
    ],
)
def test_bad_limits(limits, message):
    refuse(lambda: Bounds(*limits), f"^{message}")


@pytest.mark.parametrize(
    ("nodes", "message"),
    [
        (1, "nodes=1: .*at least 2 nodes"),
        (-3, "nodes=-3: .*at least 2 nodes"),
        (np.zeros(1), r"nodes has shape \(1,\): give .*at least 2"),
        (np.eye(2), r"nodes has shape \(2, 2\): give .*vector"),
        (
            np.linspace(1.0, 0.0, 41),
            r"nodes\[1\]=0\.975 follows 1: fractions must rise strictly .*sort",
        ),
        (
            np.array([0, 0.5, 0.5, 1]),
            r"nodes\[2\]=0\.5 follows 0\.5: fractions must rise .*drop",
        ),
        (
            np.array([0, 0.5, 2]),
            "nodes run from 0 to 2: .*rise from 0 to 1; .*divide by the last",
        ),
        (
            np.array([0.25, 1]),
            "nodes run from 0.25 to 1: .*rise from 0 to 1; subtract the first",
        ),
        (np.array([0, np.nan, 1]), r"nodes\[1\]=nan follows 0: fractions must rise"),
    ],
)
def test_bad_nodes(nodes, message):
    # One tank more: no guess for so many has been made yet.
    problem = OptimalControlProblem(
        decay,
        state=Bounds.free(SIZE + 1),
        control=Bounds.free(1),
        final_time=Bounds(1.0, 5.0),
    )
    refuse(lambda: jaxscp.solve(problem, nodes=nodes), f"^{message}")


@pytest.mark.parametrize(
    ("leaf", "value", "message"),
    [
        ("states", np.zeros((4, 3)), r"states has shape \(4, 3\); give .*25 .*4 nodes"),
        ("states", np.zeros((5, SIZE)), r"states has shape \(5, 25\); give .*4 nodes"),
        ("controls", np.zeros((3, 2)), r"controls has shape \(3, 2\); give .*4 nodes"),
        ("controls", np.zeros(2), r"controls has shape \(2,\); give one row of 2"),
        ("states", np.full((4, SIZE), np.nan), "states .*NaN.*; give finite"),
        ("controls", np.full((4, 2), np.inf), "controls .*infinity; give finite"),
        ("final_time", np.nan, "final_time.*NaN.*; give finite"),
        ("final_time", -2.0, r"final_time=-2\.0: give one positive number of seconds"),
        ("final_time", np.ones(2), r"final_time=.*1.*: give one positive number"),
    ],
)
def test_bad_guesses(leaf, value, message):
    problem = tanks()
    guess = eqx.tree_at(
        lambda guess: getattr(guess, leaf),
        jaxscp.straight_line(problem, 4),
        jnp.asarray(value),
    )
    refuse(lambda: jaxscp.solve(problem, guess), rf"^guess\.{message}")


@pytest.mark.parametrize(
    ("leaf", "value", "message"),
    [
        ("states", np.ones((4, 2)), r"\.states has shape \(4, 2\); give one row of 25"),
        ("final_time", np.nan, r"\.final_time holds NaN or infinity"),
        ("fractions", np.array([0.0, 0.2, 0.7, 1.0]), r"\.fractions\[1\]=0\.2 is 0\.333"),
        ("fractions", np.linspace(0.0, 1.0, 5), " has 5 nodes and guess.0. has 4; give"),
    ],
)
def test_of_several_guesses_the_bad_one_is_named(leaf, value, message):
    problem = tanks()
    good = jaxscp.straight_line(problem, 4)
    bad = eqx.tree_at(lambda guess: getattr(guess, leaf), good, jnp.asarray(value))
    refuse(lambda: jaxscp.solve(problem, [good, bad]), rf"^guess\[1\]{message}")


def test_no_guess_at_all():
    refuse(lambda: jaxscp.solve(tanks(), []), r"^guess=\(\): give at least one")


@pytest.mark.parametrize("fractions", [[0.0, 0.7, 0.6, 1.0], [0.0, 0.5, 0.9, 0.9]])
def test_a_guess_on_a_bad_grid(fractions):
    problem = tanks()
    guess = eqx.tree_at(
        lambda guess: guess.fractions,
        jaxscp.straight_line(problem, 4),
        jnp.array(fractions),
    )
    refuse(lambda: jaxscp.solve(problem, guess), "fractions must rise strictly.*sort")


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("vehicle.mass", -3.0, r"\S*mass=-3: give a finite number above 0 \[kg\]"),
        (
            "start",
            [195.0, 200.0, 10.0],
            r"start=\[195\.0, 200\.0, 10\.0\] lies 5 m .*safe distance of 40 m: move",
        ),
        (
            "goal",
            [420.0, 400.0, 50.0],
            r"goal=\[420\.0, 400\.0, 50\.0\] lies 0 m from .*centers\[1\].*: move goal",
        ),
        ("limits.thrust", 20.0, r"limits\.thrust=20 N .*29\.43 N: raise it, or lower"),
    ],
)
def test_bad_missions(path, value, message):
    mission = missions.get("urban-flight")
    refuse(lambda: missions.replace(mission, path, value), f"^{message}")


def test_a_start_below_the_floor():
    mission = missions.get("urban-30MB-60dB")
    refuse(
        lambda: missions.replace(mission, "start", [0.0, 0.0, 9.0]),
        r"^start\[2\]=9 m lies below altitude_floor=10 m: raise start, or lower the",
    )


def test_32_bits():
    with jax.enable_x64(False):
        problem = tanks()
        refuse(
            lambda: jaxscp.solve(problem, nodes=4),
            r"32-bit mode; add jax\.config\.update\('jax_enable_x64', True\)",
            RuntimeError,
        )
    assert jax.config.jax_enable_x64
    assert jnp.zeros(1).dtype == jnp.float64


def test_under_a_transformation_shapes_are_checked_and_numbers_are_not():
    def checked(start):
        check_problem(tanks(initial_state=Bounds.exactly(start)))
        return start

    infinite = jnp.full(SIZE, jnp.inf)
    np.testing.assert_array_equal(jax.jit(checked)(infinite), infinite)
    message = re.escape("initial_state: bounds of shape (3,); the problem needs (25,)")
    with pytest.raises(ValueError, match=f"^{message}"):
        jax.jit(checked)(jnp.zeros(3))


@pytest.fixture
def unchecked():
    """Types as for a user, whose calls are not checked by beartype."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"state": ([0.0], [1.0])}, r"state is tuple; give Bounds\(lower, upper\)"),
        ({"control": None}, r"control is NoneType; give Bounds\(lower, upper\)"),
        ({"path_constraints": decay}, "path_constraints is function; give a dictionary"),
        ({"integrals": [decay]}, "integrals is list; give a dictionary"),
        (
            {"integrals": {"flow": (decay, Bounds(0.0, 4.0))}},
            r"integrals\['flow'\] is tuple; give Integral\(rate, bounds\)",
        ),
    ],
)
def test_parts_of_another_kind(changes, message, unchecked):
    refuse(lambda: tanks(**changes), message)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"units": {"pump": 3}}, r"units\['pump'\] is int; give text"),
        ({"control_names": ("pump", "pump")}, "'pump' names two quantities"),
        ({"control_names": ("pump", "level")}, "'level' names two quantities"),
    ],
)
def test_names_and_units_that_do_not_fit(changes, message, unchecked):
    refuse(lambda: check_problem(tanks(**changes)), message)


@pytest.mark.parametrize("scale", [0.0, -1.0, np.inf])
def test_scales_are_positive(scale):
    refuse(lambda: Bounds(0.0, [1.0, 2.0], scale=[1.0, scale]), r"Bounds: scale\[1\]=")


def method(**settings) -> Callable:
    return lambda: jaxscp.solve(tanks(), **{"nodes": 4} | settings)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (method(method="proximal"), r"method is str; give ProximalSCP\(\) or"),
        (method(method=jaxscp.PaperSCP), r"method is PaperSCP; give ProximalSCP\(\)"),
        (method(discretization=jaxscp.FirstOrderHold()), "is FirstOrderHold; give a Dis"),
        (method(progress=True), "progress is bool; give a function of a dictionary"),
        (method(guess=[1.0]), "guess is float; give a Trajectory"),
        (method(nodes=10.0), "nodes=10.0: give a whole number, or a vector"),
        (lambda: jaxscp.solve(decay), "problem is function; give an OptimalControlProb"),
        (
            lambda: jaxscp.Discretization(hold=jaxscp.FirstOrderHold),
            r"hold is FirstOrderHold; give ZeroOrderHold\(\) or FirstOrderHold\(\)",
        ),
        (lambda: jaxscp.Discretization(hold="foh"), "hold is str; give ZeroOrderHold"),
        (
            lambda: jaxscp.Discretization(quadrature="trapezoid"),
            "quadrature is str; give a member of jaxscp.Quadrature",
        ),
        (lambda: jaxscp.Discretization(between=1.5), "between is float; give a whole"),
        (lambda: jaxscp.Discretization(min_substeps=4.0), "min_substeps is float; give"),
    ],
)
def test_arguments_of_another_kind(call, message, unchecked):
    refuse(call, message)
