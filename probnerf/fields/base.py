"""The interfaces of a radiance field and of a prior over fields."""

from typing import Protocol

from jaxtyping import Array, Float


class Field(Protocol):
    """The interface for the renderer and the occupancy operator; parameters are one object's, points in its frame."""

    def density(self, weights: Float[Array, "d"], points: Float[Array, "... 3"]) -> Float[Array, "..."]:
        """Density sigma >= 0 per point; a lattice face there has optical depth scale * sigma / G."""
        ...

    def colour(
        self,
        weights: Float[Array, "d"],
        points: Float[Array, "... 3"],
        directions: Float[Array, "... 3"],
        sigma: Float[Array, "..."],
    ) -> Float[Array, "... 3"]:
        """Colour in [0, 1] per point."""
        ...


class Model(Protocol):
    """A prior over fields: the trained ProbNeRF or an analytic one."""

    @property
    def field(self) -> Field: ...
    @property
    def latent(self) -> int: ...
    def decode(self, z_tilde: Float[Array, "k"]) -> Float[Array, "d"]: ...
