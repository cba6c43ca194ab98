"""A smooth map that knows no shapes: a Bayesian Hilbert map of one object on a table, as V-PRISM makes it.

Wright, Zhi, Johnson-Roberson and Hermans, "V-PRISM: Probabilistic Mapping of Unknown Tabletop Scenes", IROS 2024
(arXiv 2403.08106), after Senanayake and Ramos, "Bayesian Hilbert Maps for Dynamic Continuous Occupancy Mapping", CoRL
2017. Written from the papers' equations. All numbers of `HilbertMapConfig` are those that the authors' program
(github.com/Herb-Wright/v-prism) ran its evaluation with; none was chosen here.

The points of the object's pixels are occupied. Free are points that are drawn along the rays of all pixels, one in
each interval of `ray_step` ("stratified"), in a ball about the object and before the measured depth; and points drawn
in the ball under the table, for the object does not reach there. Each sort is thinned to one point, the mean, a cell.
A point's features are phi_i(x) = exp(-gamma |x - h_i|^2) of the hinge points h_i, and a constant.

V-PRISM has a class a thing, with weights of their own and a softmax. With one object beside the background that is the
logistic regression p(y = 1 | x, w) = sigmoid(w . phi(x)) of the difference of the two classes' weights, whose prior
variance is twice theirs; and EM then ascends the bound of Jaakkola and Jordan (2000).

Whole shapes are drawn from it (`HilbertMap.shapes`; theirs are points alone): where the prior's shapes do not explain a
view, they stand beside them (`perception.inference.publish`).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.special import expit, logit

from perception.observation.object_frame import ObjectFrame
from perception.observation.segmentation import Segment, backproject
from perception.observation.support_plane import heights
from perception.sources.frame import Frame


@dataclass(frozen=True)
class HilbertMapConfig:
    """As published."""

    hinge_step: float = 0.05  # m between the hinge points of a grid,
    hinge_reach: float = 0.15  # m from the middle of the object's points, and within the grid's box about them
    surface_hinges: int = 32  # more hinge points, drawn from the object's points
    gamma: float = 1000.0  # 1/m^2
    ray_step: float = 0.1  # m
    radius: float = 0.25  # m of the ball about that middle in which there are free points
    below: int = 1000  # points drawn in the cube about the ball; those in the ball and under the table are kept
    cell_occupied: float = 0.01  # m
    cell_free: float = 0.015  # m
    variance: float = 2e4  # of each weight's prior: 1e4 for each class
    iterations: int = 3  # of EM


@dataclass(frozen=True, eq=False)
class HilbertMap:
    """The normal posterior of the weights of hinge points, the constant's last."""

    hinges: Float[np.ndarray, "m 3"]
    mean: Float[np.ndarray, "m+1"]
    precision: Float[np.ndarray, "m+1 m+1"]
    gamma: float

    def p_occupied(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """E[sigmoid(w . phi)] ~ sigmoid(mu . phi / sqrt(1 + pi phi' Sigma phi / 8)) (MacKay 1992; Bishop 2006, eq.
        4.153), which is V-PRISM's prediction with two classes."""
        phi = features(points, self.hinges, self.gamma)
        variance = np.einsum("nm,mn->n", phi, cho_solve(cho_factor(self.precision), phi.T))
        return expit(phi @ self.mean / np.sqrt(1.0 + np.pi / 8.0 * variance))

    def shapes(self, cube: ObjectFrame, grid: int, count: int, seed: int) -> Bool[np.ndarray, "count grid grid grid"]:
        """Drawn solids {x : w . phi(x) > logit u}, w of the posterior and u uniform, on the voxels of a cube in the
        map's frame. Over them, P(solid at x) = E[sigmoid(w . phi(x))]. The u are stratified.
        """
        rng = np.random.default_rng([seed, 73])
        lower, _ = cho_factor(self.precision, lower=True)
        noise = rng.standard_normal((len(self.mean), count))
        weights = (self.mean[:, None] + solve_triangular(lower, noise, lower=True, trans="T")).T.astype(np.float32)
        least = logit((rng.permutation(count) + rng.random(count)) / count)
        # a Gaussian about a hinge point is the product of one along each axis of the cube
        axis = -1.0 + (np.arange(grid) + 0.5) * 2.0 / grid
        square = np.square(axis - cube.to_cube(self.hinges)[..., None])  # of each hinge, axis and voxel
        along = np.exp(-self.gamma * cube.half_extent**2 * square).astype(np.float32)
        faces = np.einsum("mj,mk->mjk", along[:, 1], along[:, 2]).reshape(len(along), -1)
        made = np.empty((count, grid, grid, grid), bool)
        for shape, w, level in zip(made, weights, least, strict=True):
            value = (along[:, 0] * w[:-1, None]).T @ faces + w[-1]
            shape[...] = (value > level).reshape(shape.shape)
        return made


def features(
    points: Float[np.ndarray, "n 3"], hinges: Float[np.ndarray, "m 3"], gamma: float
) -> Float[np.ndarray, "n m+1"]:
    """exp(-gamma |x - h_i|^2) of each hinge point, and 1."""
    square = np.square(points[:, None, :] - hinges).sum(axis=-1)
    return np.concatenate([np.exp(-gamma * square), np.ones((len(points), 1))], axis=1)


def fit(
    points: Float[np.ndarray, "n 3"],
    occupied: Bool[np.ndarray, "n"],
    hinges: Float[np.ndarray, "m 3"],
    config: HilbertMapConfig,
) -> HilbertMap:
    """The posterior of points that are known occupied or free, by EM from xi = 1.

    Jaakkola and Jordan, "Bayesian parameter estimation via variational methods", 2000; Bishop, "Pattern Recognition and
    Machine Learning", 2006, eq. 10.156 to 10.163. With lambda(xi) = tanh(xi / 2) / (4 xi): Sigma^-1 = I / variance +
    2 sum_n lambda(xi_n) phi_n phi_n', mu = Sigma sum_n (y_n - 1/2) phi_n, and then xi_n^2 = phi_n' (Sigma + mu mu')
    phi_n.
    """
    phi = features(points, hinges, config.gamma)
    right = phi.T @ (occupied - 0.5)
    xi = np.ones(len(points))
    for _ in range(config.iterations):
        weights = np.tanh(0.5 * xi) / (4.0 * xi)
        precision = np.eye(phi.shape[1]) / config.variance + 2.0 * (phi.T * weights) @ phi
        factor = cho_factor(precision)
        mean = cho_solve(factor, right)
        xi = np.sqrt(np.einsum("nm,mn->n", phi, cho_solve(factor, phi.T)) + np.square(phi @ mean))
    return HilbertMap(hinges, mean, precision, config.gamma)


def hilbert_map(frame: Frame, segment: Segment, config: HilbertMapConfig | None = None, seed: int = 0) -> HilbertMap:
    """The map (camera frame, m) of one object of a frame with depth, on the plane that perception measured."""
    config, rng = config or HilbertMapConfig(), np.random.default_rng([seed, 71])
    every = backproject(frame)
    measured = np.isfinite(every[..., 2])
    own = every[segment.mask & measured]
    middle = 0.5 * (own.min(axis=0) + own.max(axis=0))
    free = [_before(every[measured], middle, config, rng), _below(segment.plane, middle, config, rng)]
    occupied, empty = thinned(own, config.cell_occupied), thinned(np.concatenate(free), config.cell_free)
    known = np.repeat([True, False], [len(occupied), len(empty)])
    hinges = _hinges(own, middle, config, rng)
    return fit(np.concatenate([occupied, empty]), known, hinges, config)


def thinned(points: Float[np.ndarray, "n 3"], cell: float) -> Float[np.ndarray, "k 3"]:
    """The mean of the points in each cubic cell that holds some."""
    cells = np.floor(points / cell).astype(np.int64)
    cells -= cells.min(axis=0)
    number = np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1))  # unique rows would take much longer
    _, index, count = np.unique(number, return_inverse=True, return_counts=True)
    return np.column_stack([np.bincount(index, points[:, axis]) for axis in range(3)]) / count[:, None]


def _hinges(
    own: Float[np.ndarray, "n 3"], middle: Float[np.ndarray, "3"], config: HilbertMapConfig, rng: np.random.Generator
) -> Float[np.ndarray, "m 3"]:
    """A grid within reach of the object's middle, and some of its points."""
    step, reach = config.hinge_step, config.hinge_reach
    low, high = own.min(axis=0) - reach, own.max(axis=0) + reach + step
    axes = [np.arange(a, b, step) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = grid[np.linalg.norm(grid - middle, axis=1) <= reach]
    return np.concatenate([grid, rng.permutation(own)[: config.surface_hinges]])


def _before(
    seen: Float[np.ndarray, "n 3"], middle: Float[np.ndarray, "3"], config: HilbertMapConfig, rng: np.random.Generator
) -> Float[np.ndarray, "k 3"]:
    """Points in the ball on the rays from the camera (at the origin) to what was seen, before it."""
    length = np.linalg.norm(seen, axis=1, keepdims=True)
    start, end = np.linalg.norm(middle) - config.radius, np.linalg.norm(middle) + config.radius
    steps = np.arange(start, end, config.ray_step)
    distance = steps + config.ray_step * rng.random((len(seen), len(steps)))
    meets = np.linalg.norm(np.cross(seen, middle), axis=1) <= 1.001 * config.radius * length[:, 0]  # most rays do not
    seen, length, distance = seen[meets], length[meets], distance[meets]
    points = distance[..., None] * (seen / length)[:, None]
    return points[(distance < length) & (np.linalg.norm(points - middle, axis=-1) <= config.radius)]


def _below(
    plane: Float[np.ndarray, "4"], middle: Float[np.ndarray, "3"], config: HilbertMapConfig, rng: np.random.Generator
) -> Float[np.ndarray, "k 3"]:
    """Points in the ball under the table."""
    points = rng.uniform(-1.0, 1.0, (config.below, 3))
    points = middle + config.radius * points[np.linalg.norm(points, axis=1) <= 1.0]
    return points[heights(points, plane) < 0.0]
