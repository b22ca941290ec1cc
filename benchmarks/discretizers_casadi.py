"""The flow over every interval by CasADi."""

import functools
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import casadi as ca
import numpy as np

from .discretizer_case import COLUMNS, CONTROLS, Case, Prepared
from .second_model import runge_kutta


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
    y, u, T = ca.SX.sym("y", case.size), ca.SX.sym("u", CONTROLS), ca.SX.sym("T")
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
    outputs = [np.zeros(n * count), np.zeros(n * COLUMNS * count)]
    for index, array in enumerate(inputs):
        buffer.set_arg(index, memoryview(array))
    for index, array in enumerate(outputs):
        buffer.set_res(index, memoryview(array))

    def arranged(_):
        columns = outputs[1].reshape(count, COLUMNS, n)
        return outputs[0].reshape(count, n), np.swapaxes(columns, 1, 2)

    # What the buffer points to must live as long as the call.
    alive = (buffer, function, inputs, outputs)
    return Prepared(functools.partial(_after, alive, call), arranged, seconds)


def _after(_, call: Callable[[], None]) -> None:
    call()
