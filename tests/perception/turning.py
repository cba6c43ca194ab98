"""A block on a plate with a ChArUco board, seen by a camera that stands still while the plate turns: exact pictures."""

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from calibration.boards import parse_board
from calibration.camera import Camera
from perception.sources.frame import Frame
from probnerf.geometry import look_at

BOARD = parse_board("charuco:7x7:0.03:0.022:DICT_4X4_50")
LOW, HIGH = np.array([-0.02, -0.03, 0.0]), np.array([0.04, 0.01, 0.08])  # m, plate frame: the block
_PAINT = np.array([[200, 40, 40], [40, 160, 60], [40, 60, 200]], float)  # of its faces across x, y and z


@dataclass(frozen=True)
class Turning:
    """The set-up. `frame(angle)` is one picture; angles in degrees, counter-clockwise from above."""

    axis: tuple[float, float] = (0.006, -0.004)  # m, in the plate frame
    depth: bool = True
    ground: tuple[float, float, float] = (255.0, 255.0, 255.0)  # around the board
    block: bool = True
    noise: float = 2.0
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    model: str = "plumb_bob"
    light: float = 0.85
    hidden: frozenset[int] = frozenset()  # whole degrees at which a hand is before the camera

    @property
    def camera(self) -> Camera:
        K = np.array([[500.0, 0, 243.0], [0, 498.0, 176.0], [0, 0, 1]])
        return Camera(480, 360, K, np.array(self.distortion), self.model)

    def T_plate_camera(self, angle: float) -> np.ndarray:
        c, s = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
        T_world_plate = np.eye(4)
        T_world_plate[:2, :2] = [[c, -s], [s, c]]
        T_world_plate[:2, 3] = -T_world_plate[:2, :2] @ self.axis
        return np.linalg.inv(T_world_plate) @ look_at(np.array([0.33, 0.04, 0.34]), np.array([0.0, 0.0, 0.03]))

    def shoot(self, T: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Colour, depth along z (m) and whether it is the block, of every pixel."""
        camera = self.camera
        v, u = np.mgrid[: camera.height, : camera.width]
        rays = camera.rays(np.column_stack([u.ravel(), v.ravel()]))
        d, o = rays @ T[:3, :3].T, T[:3, 3]
        plane = -o[2] / np.minimum(d[:, 2], -1e-6)
        at = o + plane[:, None] * d
        per_m = 20 / BOARD.square
        x = ((at[:, 0] + 0.5 * BOARD.size[0]) * per_m - 0.5).astype(np.float32).reshape(u.shape)
        y = ((0.5 * BOARD.size[1] - at[:, 1]) * per_m - 0.5).astype(np.float32).reshape(u.shape)
        printed = cv2.remap(BOARD.picture(20), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).ravel()
        on = (np.abs(at[:, :2]) < 0.5 * np.array(BOARD.size)).all(axis=1)
        rgb = np.where(on[:, None], 25.0 + printed[:, None] * 0.9, np.array(self.ground))
        with np.errstate(divide="ignore"):
            near, far = np.sort(np.stack([(LOW - o) / d, (HIGH - o) / d]), axis=0)
        enter = near.max(axis=1)
        hit = (enter < far.min(axis=1)) & (enter > 0) & self.block
        rgb = np.where(hit[:, None], _PAINT[near.argmax(axis=1)], rgb) * self.light
        z = np.where(hit, enter, plane) * rays[:, 2]
        return rgb.reshape(*u.shape, 3), z.reshape(u.shape), hit.reshape(u.shape)

    def frame(self, angle: float, stamp_ns: int = 0) -> Frame:
        return replace(_frame(self, round(angle, 3)), stamp_ns=stamp_ns)


@lru_cache(64)
def _frame(scene: Turning, angle: float) -> Frame:
    camera = scene.camera
    rgb, z, hit = scene.shoot(scene.T_plate_camera(angle))
    rng = np.random.default_rng(int(1000 * angle) % 2**32)
    rgb = rgb + scene.noise * rng.standard_normal(rgb.shape)
    if round(angle) in scene.hidden:
        rgb[:] = 120.0
    z = z + 0.001 * rng.standard_normal(z.shape)
    depth = np.where(rng.random(z.shape) < 0.01, np.nan, z).astype(np.float32) if scene.depth else None
    return Frame(np.clip(np.rint(rgb), 0, 255).astype(np.uint8), depth, camera, label=hit.astype(np.int32))
