"""One mission's discretization, by jaxscp and by others: values and Jacobians of the flow
over every interval, under a zero-order hold.

The Jacobian's columns are state (12), control (4) and flight time; its rows the state
and, if integrals are gathered, the data sent and the running cost. Each discretizer is
given the trajectory once and returns a call that does all the work again, and what it
took to prepare. A state of the others is one with the integrals as further entries.
"""

import functools
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from jaxscp import Discretization, OptimalControlProblem, Quadrature
from jaxscp._compiler import compiler_options
from jaxscp._flow import Flow
from jaxscp._intervals import linearize

from .second_model import dynamics, integrands, runge_kutta

_CONTROLS, _COLUMNS = 4, 17
# Of the complex step, whose square vanishes.
_TINY = 1e-30


class Case(NamedTuple):
    """What is discretized, in numbers, and for jaxscp as a problem.

    - `mission`: as its JSON. `gathers`: whether integrals are.
    - `states` (N, 12), `controls` (N, 4), `final_time` [s]; nodes at even distances.
    """

    problem: OptimalControlProblem
    mission: dict
    gathers: bool
    states: np.ndarray
    controls: np.ndarray
    final_time: float

    @property
    def intervals(self) -> int:
        return len(self.states) - 1

    def rates(self, module, y, u) -> list:
        """Of the state and, if they are gathered, of the integrals."""
        sums = integrands(module, self.mission, y, u) if self.gathers else []
        return dynamics(module, self.mission["vehicle"], y, u) + sums

    @property
    def size(self) -> int:
        """Entries of the state with the integrals."""
        sums = 1 + (self.mission["data_required"] is not None)
        return 12 + (sums if self.gathers else 0)

    @property
    def starts(self) -> np.ndarray:
        """The state at every left node, (I, size): integrals begin at zero."""
        return np.pad(self.states[:-1], ((0, 0), (0, self.size - 12)))


class Prepared(NamedTuple):
    """A call that discretizes, and what makes `(values, Jacobian)` of its result, shapes
    (I, size) and (I, size, 17). `seconds`: to compile.
    """

    call: Callable[[], Any]
    arranged: Callable[[Any], tuple[np.ndarray, np.ndarray]]
    seconds: float


def jaxscp(case: Case, substeps: int, batch: int | None = None) -> Prepared:
    """Of one trajectory, or of a batch of such, all alike: that is only to be timed."""
    rule = Quadrature.FLOW if case.gathers else Quadrature.TRAPEZOID
    fractions = jnp.linspace(0.0, 1.0, len(case.states))
    grid = (fractions[:-1], jnp.diff(fractions))

    def discretized(states, controls, time, steps):
        flow = Flow(case.problem, Discretization(quadrature=rule), steps)
        values, jacobians = linearize(flow, grid, states, controls, time)
        if not case.gathers:
            return [(values.next_state, jacobians.next_state)]
        return [
            (values.next_state, jacobians.next_state),
            (values.increments, jacobians.increments),
        ]

    def arranged(found):
        if case.gathers and case.mission["data_required"] is not None:
            found[1] = jax.tree.map(of_required, found[1])
        blocks = [(j.left_state, j.left_control, j.time[:, :, None]) for _, j in found]
        rows = [np.concatenate(block, axis=2) for block in blocks]
        values = np.concatenate([value for value, _ in found], axis=1)
        return values, np.concatenate(rows, axis=1)

    def of_required(block):
        # The others count the data in shares of those required.
        return block.at[:, 0].divide(case.mission["data_required"])

    if batch is None:
        return _compiled(
            discretized, case, arranged, jnp.asarray(substeps), options=compiler_options()
        )

    together = jax.vmap(discretized, in_axes=(0, None, None, None))
    many = case._replace(states=np.tile(case.states, (batch, 1, 1)))
    return _compiled(together, many, arranged, jnp.asarray(substeps))


def with_diffrax(case: Case, substeps: int) -> Prepared:
    """Tsit5 with fixed steps, `jacfwd` through them, intervals by `vmap`."""

    def interval(y, u, time):
        width = time / case.intervals
        term = diffrax.ODETerm(lambda t, y, u: jnp.stack(case.rates(jnp, y, u)))
        found = diffrax.diffeqsolve(
            term,
            diffrax.Tsit5(),
            0.0,
            width,
            width / substeps,
            y,
            u,
            adjoint=diffrax.ForwardMode(),
            max_steps=substeps + 2,
        )
        return found.ys[0]

    def discretized(states, controls, time):
        y = jnp.pad(states[:-1], ((0, 0), (0, case.size - 12)))

        def columns(y, u):
            def ends(v):
                own = jnp.concatenate([v[:12], y[12:]])
                return interval(own, v[12:-1], v[-1])

            v = jnp.concatenate([y[:12], u, time[None]])
            return ends(v), jax.jacfwd(ends)(v)

        return jax.vmap(columns)(y, controls[:-1])

    return _compiled(discretized, case, lambda found: tuple(map(np.asarray, found)))


def _compiled(function, case: Case, arranged, *others, options=None) -> Prepared:
    arguments = (
        jnp.asarray(case.states),
        jnp.asarray(case.controls),
        jnp.asarray(case.final_time),
        *others,
    )
    begun = time.perf_counter()
    program = jax.jit(function, compiler_options=options).lower(*arguments).compile()
    return Prepared(lambda: program(*arguments), arranged, time.perf_counter() - begun)


def numpy_loop(case: Case, substeps: int) -> Prepared:
    """Node after node, columns together, by complex steps: exact to rounding."""

    def call():
        return [_interval(case, index, substeps) for index in range(case.intervals)]

    return Prepared(call, _of_complex, 0.0)


def _interval(case: Case, index: int, substeps: int) -> np.ndarray:
    y, u, seconds = _columns(case, index)
    return runge_kutta(lambda y: np.array(case.rates(np, y, u)), y, seconds, substeps)


def _columns(case: Case, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """State, control and seconds of an interval, each column a step apart."""
    step = 1j * _TINY * np.eye(_COLUMNS)
    y = case.starts[index][:, None] + np.zeros(_COLUMNS, complex)
    y[:12] += step[:12]
    u = case.controls[index][:, None] + step[12 : 12 + _CONTROLS]
    return y, u, (case.final_time + step[-1]) / case.intervals


def _of_complex(found: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    ends = np.stack(found)
    return ends[:, :, 0].real, ends.imag / _TINY


def with_scipy(case: Case, substeps: int, method: str = "RK45") -> Prepared:
    """`solve_ivp` of state and columns together; its tolerance falls as an error of
    fourth order would, from 1e-2 for one substep to 1e-7 for sixteen.
    """
    tolerance = 1e-2 * substeps**-4.0

    def call():
        return [
            _variational(case, index, tolerance, method)
            for index in range(case.intervals)
        ]

    return Prepared(call, _of_real, 0.0)


def reference(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """To 1e-13, by DOP853."""
    tight = [
        _variational(case, index, 1e-13, "DOP853") for index in range(case.intervals)
    ]
    return _of_real(tight)


def _variational(case: Case, index: int, tolerance: float, method: str) -> np.ndarray:
    """Of the interval's normalized time, value and columns as one real vector."""
    y, u, seconds = _columns(case, index)
    shape = (case.size, 1 + _COLUMNS)

    def rates(_, flat):
        both = flat.reshape(shape)
        at = both[:, :1] + 1j * _TINY * both[:, 1:]
        slopes = seconds * np.array(case.rates(np, at, u))
        return np.column_stack([slopes[:, 0].real, slopes.imag / _TINY]).ravel()

    start = np.column_stack([y[:, 0].real, y.imag / _TINY]).ravel()
    found = solve_ivp(rates, (0.0, 1.0), start, method, rtol=tolerance, atol=tolerance)
    return found.y[:, -1].reshape(shape)


def _of_real(found: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    ends = np.stack(found)
    return ends[:, :, 0], ends[:, :, 1:]


def casadi_interpreted(case: Case, substeps: int) -> Prepared:
    """One interval's function, mapped, in CasADi's virtual machine."""
    begun = time.perf_counter()
    function = _casadi(case, substeps)
    return _buffered(case, function, time.perf_counter() - begun)


def casadi_compiled(case: Case, substeps: int) -> Prepared:
    """The same as generated C: gcc -O3 -march=native."""
    begun = time.perf_counter()
    function = _casadi(case, substeps)
    folder = Path(tempfile.mkdtemp())
    generator = ca.CodeGenerator("flow.c")
    generator.add(function)
    generator.generate(f"{folder}/")
    flags = ["-O3", "-march=native", "-fPIC", "-shared"]
    library = folder / "flow.so"
    subprocess.run(["gcc", *flags, folder / "flow.c", "-o", library], check=True)
    loaded = ca.external(function.name(), str(library))
    return _buffered(case, loaded, time.perf_counter() - begun)


def _casadi(case: Case, substeps: int) -> ca.Function:
    y, u, T = ca.SX.sym("y", case.size), ca.SX.sym("u", _CONTROLS), ca.SX.sym("T")
    seconds = T / case.intervals
    end = runge_kutta(lambda y: ca.vertcat(*case.rates(ca, y, u)), y, seconds, substeps)
    by = ca.densify(ca.jacobian(end, ca.vertcat(y[:12], u, T)))
    return ca.Function("flow", [y, u, T], [end, by]).map(case.intervals)


def _buffered(case: Case, function: ca.Function, seconds: float) -> Prepared:
    """Without a copy between CasADi and NumPy."""
    buffer, call = function.buffer()
    n, count = case.size, case.intervals
    inputs = [
        case.starts.ravel(),
        np.ascontiguousarray(case.controls[:-1]).ravel(),
        np.full(count, case.final_time),
    ]
    outputs = [np.zeros(n * count), np.zeros(n * _COLUMNS * count)]
    for index, array in enumerate(inputs):
        buffer.set_arg(index, memoryview(array))
    for index, array in enumerate(outputs):
        buffer.set_res(index, memoryview(array))

    def arranged(_):
        columns = outputs[1].reshape(count, _COLUMNS, n)
        return outputs[0].reshape(count, n), np.swapaxes(columns, 1, 2)

    # What the buffer points to must live as long as the call.
    alive = (buffer, function, inputs, outputs)
    return Prepared(functools.partial(_after, alive, call), arranged, seconds)


def _after(_, call: Callable[[], None]) -> None:
    call()


DISCRETIZERS: dict[str, Callable[[Case, int], Prepared]] = {
    "jaxscp": jaxscp,
    "CasADi, C at -O3": casadi_compiled,
    "CasADi, virtual machine": casadi_interpreted,
    "diffrax, Tsit5": with_diffrax,
    "NumPy, node by node": numpy_loop,
    "SciPy, RK45": with_scipy,
}
