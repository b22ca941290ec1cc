"""The flow over every interval by NumPy and SciPy, node after node, and to 1e-13."""

import numpy as np
from scipy.integrate import solve_ivp

from .discretizer_case import COLUMNS, CONTROLS, Case, Prepared
from .second_model import runge_kutta

# Of the complex step, whose square vanishes.
_TINY = 1e-30


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
    step = 1j * _TINY * np.eye(COLUMNS)
    y = case.starts[index][:, None] + np.zeros(COLUMNS, complex)
    y[:12] += step[:12]
    u = case.controls[index][:, None] + step[12 : 12 + CONTROLS]
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
    shape = (case.size, 1 + COLUMNS)

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
