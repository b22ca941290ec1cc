"""Sequential convex programming for trajectory optimization, in JAX."""

from . import missions as missions
from . import models as models
from . import textbook as textbook
from ._bounds import Bounds as Bounds
from ._discretization import Discretization as Discretization
from ._discretization import Quadrature as Quadrature
from ._hold import AbstractHold as AbstractHold
from ._hold import FirstOrderHold as FirstOrderHold
from ._hold import ZeroOrderHold as ZeroOrderHold
from ._iteration import History as History
from ._paper import PaperSCP as PaperSCP
from ._problem import Integral as Integral
from ._problem import OptimalControlProblem as OptimalControlProblem
from ._proximal import ProximalSCP as ProximalSCP
from ._qp import PIQP as PIQP
from ._scp import AbstractSCP as AbstractSCP
from ._solution import Multipliers as Multipliers
from ._solution import Solution as Solution
from ._solution import Statistics as Statistics
from ._solve import solve as solve
from ._solve import SolveError as SolveError
from ._status import Status as Status
from ._trajectory import straight_line as straight_line
from ._trajectory import through_waypoints as through_waypoints
from ._trajectory import Trajectory as Trajectory
from ._verification import Verification as Verification
from ._verification import Violation as Violation
from .verify import verify as verify

__version__ = "0.1.0"
