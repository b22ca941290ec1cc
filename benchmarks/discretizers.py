"""One mission's discretization, by jaxscp and by others: values and Jacobians of the flow
over every interval, under a zero-order hold.

Each discretizer is given the trajectory once and returns a call that does all the work
again, and what it took to prepare.
"""

from collections.abc import Callable

from .discretizer_case import Case, Prepared
from .discretizers_casadi import casadi_compiled, casadi_interpreted
from .discretizers_jax import jaxscp, with_diffrax
from .discretizers_numpy import numpy_loop, with_scipy

DISCRETIZERS: dict[str, Callable[[Case, int], Prepared]] = {
    "jaxscp": jaxscp,
    "CasADi, C at -O3": casadi_compiled,
    "CasADi, virtual machine": casadi_interpreted,
    "diffrax, Tsit5": with_diffrax,
    "NumPy, node by node": numpy_loop,
    "SciPy, RK45": with_scipy,
}
