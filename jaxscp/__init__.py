"""Sequential convex programming for trajectory optimization, in JAX."""

import importlib
from typing import TYPE_CHECKING, Any

from ._attempt import Attempt as Attempt
from ._bounds import Bounds as Bounds
from ._cache import keep_programs as keep_programs
from ._discretization import Discretization as Discretization, Quadrature as Quadrature
from ._hold import (
    AbstractHold as AbstractHold,
    FirstOrderHold as FirstOrderHold,
    ZeroOrderHold as ZeroOrderHold,
)
from ._intervals import (
    IntervalJacobians as IntervalJacobians,
    Intervals as Intervals,
    Jacobian as Jacobian,
)
from ._problem import (
    Integral as Integral,
    OptimalControlProblem as OptimalControlProblem,
)
from ._proximal import ProximalSCP as ProximalSCP
from ._qp import PIQP as PIQP
from ._scp import AbstractSCP as AbstractSCP
from ._solution import (
    Multipliers as Multipliers,
    Solution as Solution,
    Statistics as Statistics,
)
from ._solve import SolveError as SolveError, solve as solve
from ._state import History as History
from ._status import Status as Status
from ._trajectory import (
    Trajectory as Trajectory,
    straight_line as straight_line,
    through_waypoints as through_waypoints,
)
from ._verification import Verification as Verification, Violation as Violation
from ._version import __version__ as __version__
from .verify import verify as verify

if TYPE_CHECKING:
    from . import (
        missions as missions,
        models as models,
        plot as plot,
        textbook as textbook,
    )
    from ._audit import (
        Audit as Audit,
        Audited as Audited,
        audit_gradient as audit_gradient,
    )
    from ._continuation import continuation as continuation
    from ._linearization import linearize as linearize
    from ._paper import PaperSCP as PaperSCP
    from ._reproduction import Reproduction as Reproduction, reproduce as reproduce
    from ._sensitivity_report import (
        SensitivityReport as SensitivityReport,
        sensitivity_report as sensitivity_report,
    )
    from ._shadow_prices import (
        ShadowPrice as ShadowPrice,
        ShadowPrices as ShadowPrices,
        shadow_prices as shadow_prices,
    )
    from ._sweep import Sweep as Sweep, sweep as sweep

# What a problem and its solve do without is imported when it is first asked for, which
# saves an eighth of the time that `import jaxscp` takes: modules, and names from others.
_MODULES = ("missions", "models", "plot", "textbook")
_NAMES = {
    "_audit": ("Audit", "Audited", "audit_gradient"),
    "_continuation": ("continuation",),
    "_linearization": ("linearize",),
    "_paper": ("PaperSCP",),
    "_reproduction": ("Reproduction", "reproduce"),
    "_sensitivity_report": ("SensitivityReport", "sensitivity_report"),
    "_shadow_prices": ("ShadowPrice", "ShadowPrices", "shadow_prices"),
    "_sweep": ("Sweep", "sweep"),
}
_HOMES = {name: home for home, names in _NAMES.items() for name in names}

# What `from jaxscp import *` brings is all of it.
__all__ = sorted(
    {*_MODULES, *_HOMES, *(name for name in globals() if not name.startswith("_"))}
    - {"Any", "TYPE_CHECKING", "importlib"}
)


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return importlib.import_module(f".{name}", __name__)
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(importlib.import_module(f".{_HOMES[name]}", __name__), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
