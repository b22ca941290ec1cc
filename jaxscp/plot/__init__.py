"""Figures with Matplotlib: Axes in, Axes out.

Nothing here touches `matplotlib.pyplot` or a display: [`mission`][] makes its own
`Figure`, every other function draws on Axes it is given.
"""

from ._mission import mission as mission
from ._routes import isometric as isometric, top_view as top_view
from ._series import (
    controls as controls,
    convergence as convergence,
    states as states,
)
