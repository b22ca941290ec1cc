"""Figures with Matplotlib: Axes in, Axes out.

Nothing here touches `matplotlib.pyplot` or a display: [`mission`][] makes its own
`Figure` and [`animate`][] a file, every other function draws on Axes it is given.
"""

from ._animation import animate as animate
from ._ellipses import ellipses as ellipses
from ._energy import energy as energy
from ._gradient_map import gradient_map as gradient_map
from ._isometric import isometric as isometric
from ._link import link as link
from ._mission import mission as mission
from ._multipliers import (
    active_limits as active_limits,
    costates as costates,
    multipliers as multipliers,
)
from ._pareto import pareto as pareto
from ._profile import profile as profile
from ._reproduction import reproduction as reproduction
from ._series import (
    controls as controls,
    convergence as convergence,
    states as states,
)
from ._top_view import top_view as top_view
