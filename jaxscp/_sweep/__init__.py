"""Many missions at once: what is swept, by whom, and what comes of it."""

from ._result import Sweep as Sweep
from ._run import sweep as sweep
