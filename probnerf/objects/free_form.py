"""Free-form deformation of solid models (Sederberg & Parry 1986), at random: a mesh's relatives."""

import numpy as np
import trimesh
from jaxtyping import Float

DEGREE = 3  # of the Bernstein polynomials along each axis: 4 x 4 x 4 control points
BINOMIAL = np.array([1.0, 3.0, 3.0, 1.0])
LEAST_STRETCH = 0.25  # of a volume: less would be all but folded
_GRID = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 9)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)

Control = Float[np.ndarray, "4 4 4 3"]


def bent(mesh: trimesh.Trimesh, rng: np.random.Generator, size: float) -> trimesh.Trimesh:
    """The mesh, moved with the space in its box by random control points.

    Each control point moves by a normal of deviation `size` times the box's side along each axis. A draw that would
    fold space (see `least_volume`) is halved until it does not.
    """
    low, sides = mesh.bounds[0], np.maximum(mesh.extents, 1e-9)
    control = size * rng.standard_normal((DEGREE + 1,) * 3 + (3,))
    while least_volume(control) < LEAST_STRETCH:
        control *= 0.5
    inside = (mesh.vertices - low) / sides
    moved = mesh.copy()
    moved.vertices = low + sides * (inside + displacement(control, inside))
    return moved


def displacement(control: Control, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Displacement of points of the unit cube: the control points', weighted by Bernstein polynomials (their eq. 2)."""
    x, y, z = (_bernstein(points[:, axis]) for axis in range(3))
    return np.einsum("ni,nj,nk,ijkc->nc", x, y, z, control, optimize=True)


def least_volume(control: Control) -> float:
    """The least factor by which a small volume changes (the Jacobian's determinant), over a 9^3 grid of the cube."""
    b = [_bernstein(_GRID[:, axis]) for axis in range(3)]
    slope = [_bernstein_slope(_GRID[:, axis]) for axis in range(3)]
    columns = [
        np.einsum("ni,nj,nk,ijkc->nc", *[slope[a] if a == axis else b[a] for a in range(3)], control, optimize=True)
        for axis in range(3)
    ]
    return float(np.linalg.det(np.eye(3) + np.stack(columns, axis=-1)).min())


def _bernstein(t: np.ndarray) -> np.ndarray:
    powers = np.arange(DEGREE + 1)
    return BINOMIAL * t[:, None] ** powers * (1.0 - t[:, None]) ** (DEGREE - powers)


def _bernstein_slope(t: np.ndarray) -> np.ndarray:
    lower = np.stack([(1.0 - t) ** 2, 2.0 * t * (1.0 - t), t**2], axis=-1)
    padded = np.pad(lower, ((0, 0), (1, 1)))
    return DEGREE * (padded[:, :-1] - padded[:, 1:])
