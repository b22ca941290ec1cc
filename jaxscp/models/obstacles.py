"""`Cylinders`: buildings to keep away from."""

import equinox as eqx

from .._types import Array, Float, Scalar
from ._parameters import Numbers, parameter
from ._smooth import smooth_norm


class Cylinders(eqx.Module):
    """Vertical cylinders without top, each with a distance to keep (paper, eq. 5j).

    Called as `cylinders(t, x, u)`, it is a path constraint g <= 0, one entry a cylinder
    [m], for the position in the first entries of the state.

    **Arguments:**

    - `centers`: of the cylinders' axes, shape (k, 2) [m]; k may be zero.
    - `safe_distances`: to keep from each axis, shape (k,) [m].

    **Raises:** `ValueError` on wrong shapes and negative distances.
    """

    centers: Float[Array, "k 2"]
    safe_distances: Float[Array, " k"]

    def __init__(self, centers: Numbers = (), safe_distances: Numbers = ()):
        self.centers = parameter("Cylinders.centers", centers, shape=(None, 2), unit="m")
        self.safe_distances = parameter(
            "Cylinders.safe_distances",
            safe_distances,
            shape=(None,),
            at_least=0.0,
            unit="m",
        )
        if self.centers.shape[0] != self.safe_distances.shape[0]:
            raise ValueError(
                f"Cylinders.safe_distances has {self.safe_distances.shape[0]} entries "
                f"for {self.centers.shape[0]} centers: give one distance for each."
            )

    @property
    def count(self) -> int:
        """How many there are."""
        return self.centers.shape[0]

    def clearance(self, position: Float[Array, " _"]) -> Float[Array, " k"]:
        """Distance to each axis beyond the safe one [m]; negative within it.

        **Arguments:**

        - `position`: shape (2,) or longer, of which the first two entries count [m].
        """
        # Distance, not its square, for two reasons. It is in metres, so a message can
        # say by how much a building is cut. And its tangent in SCP is the half-plane
        # that just touches the circle, wherever it is taken; that of the square, taken
        # far away, cuts off much of the free space as well. The norm is rounded off, so
        # that it is smooth at the axis, and both terms alike, so that zero stays zero
        # exactly at the safe distance.
        distances = smooth_norm(
            position[0] - self.centers[:, 0], position[1] - self.centers[:, 1]
        )
        return distances - smooth_norm(self.safe_distances)

    def __call__(self, t: Scalar, x: Float[Array, " n"], u: Array) -> Float[Array, " k"]:
        """How far the position x[:2] is within each safe distance [m]."""
        del t, u
        return -self.clearance(x)
