"""How far a calibrated camera may miss, in pixels over the picture: by its covariance, and by halves of its views."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from calibration.calibrate import Calibration
from calibration.camera import Camera
from calibration.fit import FittedView, Model, fit

GRID = (9, 7)  # places over the picture's width and height, from edge to edge
_FEWEST = 6  # views that make two halves


@dataclass(frozen=True, eq=False)
class Projection:
    """Pixel errors at places of the picture, after the turn of the camera that hides most of them.

    A turn is no error of the lens: whoever measures where the camera looks measures it, too.
    """

    places: Float[np.ndarray, "7 9 2"]  # px (x, y)
    std: Float[np.ndarray, "7 9"]  # px, in the worst direction; NaN where no ray meets the place
    shift: Float[np.ndarray, "7 9 2"] | None  # px, from one half of the views to the other; None: too few views

    @property
    def difference(self) -> Float[np.ndarray, "7 9"] | None:
        """px, length of the shift."""
        return None if self.shift is None else np.linalg.norm(self.shift, axis=2)

    def words(self, values: Float[np.ndarray, "7 9"]) -> str:
        """The median and the worst of values over the picture, and where that is."""
        if np.isnan(values).all():
            return "not known"
        row, column = np.unravel_index(np.nanargmax(values), values.shape)
        x, y = self.places[row, column]
        says = f"{np.nanmedian(values):.2f} px, at worst {values[row, column]:.2f} px at ({x:.0f}, {y:.0f})"
        blind = int(np.isnan(values).sum())
        return f"{says}; no ray at {blind} of {values.size} places" if blind else says


def projection(result: Calibration) -> Projection:
    """The deviation of projection over the picture, and the difference between fits to every second view.

    The deviation is that of directions, as of far points (mrcal's uncertainty of projection with a fitted turn).
    """
    camera = result.camera
    x, y = (np.linspace(0.0, n - 1.0, k) for n, k in zip((camera.width, camera.height), GRID, strict=True))
    places = np.stack(np.meshgrid(x, y), axis=-1)
    pixels = places.reshape(-1, 2)
    std = _deviation(camera, result.covariance, pixels).reshape(places.shape[:2])
    shift = _shift(result.views, camera, pixels)
    return Projection(places, std, None if shift is None else shift.reshape(places.shape))


def _deviation(
    camera: Camera, covariance: Float[np.ndarray, "p p"], pixels: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n"]:
    rays = camera.rays(pixels)
    seen = np.isfinite(rays).all(axis=1)
    std = np.full(len(pixels), np.nan)
    if seen.sum() < 3:
        return std
    _, inner, outer = camera.project_posed(rays[seen], np.zeros(3), np.zeros(3))
    basis = np.linalg.qr(outer[:, :3])[0]
    moved = (inner - basis @ (basis.T @ inner)).reshape(-1, 2, inner.shape[1])
    std[seen] = np.sqrt(np.linalg.eigvalsh(moved @ covariance @ moved.transpose(0, 2, 1))[:, -1].clip(0.0))
    return std


def _shift(
    views: Sequence[FittedView], camera: Camera, pixels: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"] | None:
    if len(views) < _FEWEST:
        return None
    size, model = (camera.width, camera.height), _model(camera)
    try:
        a, b = (fit([f.view for f in half], size, model).camera for half in (views[::2], views[1::2]))
    except ValueError:  # no camera fits a half
        return None
    rays_a, rays_b = a.rays(pixels), b.rays(pixels)
    both = np.isfinite(rays_a + rays_b).all(axis=1)
    if both.sum() < 3:
        return None
    # the turn from a to b (Kabsch 1976)
    U, _, Vt = np.linalg.svd(rays_b[both].T @ rays_a[both])
    turn = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return b.project(rays_a @ turn.T) - pixels


def _model(camera: Camera) -> Model:
    models: tuple[Model, ...] = ("plumb_bob", "rational_polynomial", "equidistant")
    return next(model for model in models if model == camera.model)
