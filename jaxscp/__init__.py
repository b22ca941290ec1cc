"""Sequential convex programming for trajectory optimization, in JAX."""

from . import missions as missions, models as models, textbook as textbook
from ._attempt import Attempt as Attempt
from ._audit import Audit as Audit, Audited as Audited, audit_gradient as audit_gradient
from ._bounds import Bounds as Bounds
from ._cache import keep_programs as keep_programs
from ._continuation import continuation as continuation
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
from ._linearization import linearize as linearize
from ._paper import PaperSCP as PaperSCP
from ._problem import (
    Integral as Integral,
    OptimalControlProblem as OptimalControlProblem,
)
from ._proximal import ProximalSCP as ProximalSCP
from ._qp import PIQP as PIQP
from ._reproduction import Reproduction as Reproduction, reproduce as reproduce
from ._scp import AbstractSCP as AbstractSCP
from ._sensitivity_report import (
    SensitivityReport as SensitivityReport,
    sensitivity_report as sensitivity_report,
)
from ._shadow_prices import (
    ShadowPrice as ShadowPrice,
    ShadowPrices as ShadowPrices,
    shadow_prices as shadow_prices,
)
from ._solution import (
    Multipliers as Multipliers,
    Solution as Solution,
    Statistics as Statistics,
)
from ._solve import SolveError as SolveError, solve as solve
from ._state import History as History
from ._status import Status as Status
from ._sweep import Sweep as Sweep, sweep as sweep
from ._trajectory import (
    Trajectory as Trajectory,
    straight_line as straight_line,
    through_waypoints as through_waypoints,
)
from ._verification import Verification as Verification, Violation as Violation
from ._version import __version__ as __version__
from .verify import verify as verify
