"""Posed pictures of many objects in the layout of Scene Representation Networks (Sitzmann et al. 2019).

    DIR/NAME/intrinsics.txt   `f cx cy 0` (px), barycentre, scale, `height width`; a fifth line 1: poses are inverted
    DIR/NAME/rgb/000000.png   RGBA, where alpha marks the object, or RGB, where pixels that are not white are the object
    DIR/NAME/pose/000000.txt  16 numbers: T_world_camera, OpenCV axes (x right, y down, z forward)

Transform to the unit cube: p_cube = 2 (p_world - barycentre) / scale, z up. So the scale is the cube's side. SRN's own
files have barycentre 0 and scale 1: their objects fill a ball of radius 0.5, which becomes the unit ball. To match the
tabletop family, put an object's base 0.375 scale below the barycentre and make its largest side 0.7 scale. Pixel
centres are at +0.5.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from foundation.png import PNG_MAGIC, check_png
from foundation.whole_file import write_whole
from probnerf.environment import MOST_PIXELS
from probnerf.geometry import look_at, rigid
from probnerf.prior.encoder_input import ENCODER_RADIUS
from probnerf.training.pictures import ViewSet

NO_RANGE = -1.0  # in a ViewSet: an object pixel whose distance is unknown
_WHITE = 250  # without alpha, a pixel is background if all its samples are at least this
_FARTHEST = 1e4  # cube units
_MOST_SAMPLES = 8  # per pixel and axis, when a picture is reduced
_LINES = ("f cx cy 0", "barycentre", "scale", "height width")


@dataclass(frozen=True, eq=False)
class Instance:
    """One object's V pictures of H x W pixels, as in the files. Raises ValueError if a value is invalid."""

    name: str
    focal: float  # px
    centre: tuple[float, float]  # cx, cy; px
    barycentre: tuple[float, float, float]  # world units
    scale: float  # world units: the cube's side
    rgb: UInt8[np.ndarray, "v h w 3"]  # set to white outside the object
    mask: Bool[np.ndarray, "v h w"]
    T_world_camera: Float[np.ndarray, "v 4 4"]

    def __post_init__(self) -> None:
        if not (self.focal > 0 and self.scale > 0):
            raise ValueError(f"{self.name}: focal length {self.focal} and scale {self.scale} must be positive")
        object.__setattr__(self, "rgb", np.where(self.mask[..., None], self.rgb, np.uint8(255)))

    @property
    def T_cube_camera(self) -> Float[np.ndarray, "v 4 4"]:
        """p_cube = T_cube_camera @ p_camera, cube units."""
        T = np.array(self.T_world_camera, np.float64)
        T[:, :3, 3] = 2.0 * (T[:, :3, 3] - self.barycentre) / self.scale
        return T


# ----------------------------------------------------------------------------------------------------- writing


def write_intrinsics(
    folder: Path,
    focal: float,
    centre: tuple[float, float],
    barycentre: tuple[float, float, float],
    scale: float,
    size: tuple[int, int],
) -> None:
    """intrinsics.txt of one instance (see `Instance`); `size` is (height, width). Replaces the file as a whole."""
    rows = ((focal, *centre, 0.0), barycentre, (scale,))
    lines = [" ".join(repr(float(x)) for x in row) for row in rows] + [f"{size[0]} {size[1]}"]
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / "intrinsics.txt", "\n".join(lines) + "\n")


def write_view(
    folder: Path,
    index: int,
    rgb: UInt8[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    T_world_camera: Float[np.ndarray, "4 4"],
) -> None:
    """Write one picture, then its pose. So a view is complete if its pose exists."""
    for name in ("rgb", "pose"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    white = np.where(mask[..., None], rgb, np.uint8(255))
    bgra = np.dstack([white[..., ::-1], np.where(mask, 255, 0).astype(np.uint8)])
    write_whole(folder / "rgb" / f"{index:06d}.png", cv2.imencode(".png", bgra)[1].tobytes())
    text = " ".join(repr(float(x)) for x in np.asarray(T_world_camera, np.float64).ravel())
    write_whole(folder / "pose" / f"{index:06d}.txt", text + "\n")


def write_instance(root: Path, instance: Instance) -> Path:
    """Write one instance under `root` and return its folder. Reading it gives bit-identical numbers."""
    folder, size = root / instance.name, instance.mask.shape[1:]
    write_intrinsics(folder, instance.focal, instance.centre, instance.barycentre, instance.scale, (size[0], size[1]))
    for index, view in enumerate(zip(instance.rgb, instance.mask, instance.T_world_camera, strict=True)):
        write_view(folder, index, *view)
    return folder


# ----------------------------------------------------------------------------------------------------- reading


def find_instances(root: Path) -> list[Path]:
    """Folders of the instances in `root`, which may be one itself. Raises FileNotFoundError if there is none."""
    root = Path(root)
    if (root / "intrinsics.txt").is_file():
        return [root]
    found = sorted(path.parent for path in root.glob("*/intrinsics.txt"))
    if not found:
        missing = "holds no views" if root.is_dir() else "does not exist"
        raise FileNotFoundError(f"{root} {missing}; give a folder of NAME/intrinsics.txt, NAME/rgb/ and NAME/pose/")
    return found


def read_instance(folder: Path) -> Instance:
    """All views of one instance. Raises FileNotFoundError or ValueError with the file (and line) and a remedy."""
    focal, centre, barycentre, scale, size, inverted = _read_intrinsics(folder / "intrinsics.txt")
    pictures = {path.stem for path in (folder / "rgb").glob("*.png")}
    poses = {path.stem for path in (folder / "pose").glob("*.txt")}
    if not pictures & poses:
        raise FileNotFoundError(f"{folder} holds no views; it needs rgb/000000.png with pose/000000.txt, and so on")
    for stem in sorted(pictures ^ poses):
        have, lacks = ("rgb/{}.png", "pose/{}.txt") if stem in pictures else ("pose/{}.txt", "rgb/{}.png")
        raise ValueError(f"{folder / have.format(stem)} has no {lacks.format(stem)}; add it, or delete the first")
    rgb, mask, transforms = [], [], []
    for stem in sorted(poses):
        picture, shown = _read_picture(folder / "rgb" / f"{stem}.png", size)
        rgb.append(picture)
        mask.append(shown)
        T = _read_pose(folder / "pose" / f"{stem}.txt")
        transforms.append(np.linalg.inv(T) if inverted else T)
    if not np.any(mask):
        raise ValueError(f"{folder}: no picture shows an object; save them with alpha, or on a white background")
    return Instance(folder.name, focal, centre, barycentre, scale, np.stack(rgb), np.stack(mask), np.stack(transforms))


def read_views(
    root: Path, size: int, pictures: int | None = None, progress: Callable[[int, int], None] | None = None
) -> ViewSet:
    """Every instance in `root` in the form that training needs: `pictures` of each (None: all), `size` pixels a side.

    If an instance has more pictures, they are spread evenly. If it has fewer, some repeat. A picture of another size,
    or with an off-centre principal point, is warped to a camera at the same position that looks at the cube's centre.
    Object pixels have range NO_RANGE. Raises the same errors as `read_instance`.
    """
    folders = find_instances(root)
    if pictures is not None and pictures < 1:
        raise ValueError(f"{pictures} pictures of each object were asked for; give 1 or more")
    if pictures is None:
        pictures = max(len(list((folder / "pose").glob("*.txt"))) for folder in folders)
    parts = []
    for done, folder in enumerate(folders):
        instance = read_instance(folder)
        count = len(instance.mask)
        rows = np.floor(np.arange(pictures) * count / pictures).astype(int) if pictures <= count else None
        rows = np.arange(pictures) % count if rows is None else rows
        seen = [_square(instance, int(row), size) for row in np.unique(rows)]
        parts.append([seen[i] for i in np.searchsorted(np.unique(rows), rows)])
        if progress is not None:
            progress(done + 1, len(folders))
    rgb, mask, T, tangent = (np.stack([np.stack([view[i] for view in views]) for views in parts]) for i in range(4))
    return ViewSet(
        seeds=np.arange(len(parts)),
        rgb=rgb,
        range=np.where(mask, np.float32(NO_RANGE), np.float32(0.0)),
        T_object_camera=T.astype(np.float32),
        tan_half_fov=tangent.astype(np.float32),
    )


def _square(instance: Instance, view: int, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """rgb, mask, T_cube_camera and tangent of the half field of view of one view, at `size` pixels a side."""
    rgb, mask, T = instance.rgb[view], instance.mask[view], instance.T_cube_camera[view]
    distance = math.hypot(*T[:3, 3])
    where = f"{instance.name}: view {view} is {distance:.3g} cube units from the cube's centre"
    if not distance <= _FARTHEST:
        raise ValueError(f"{where}, where no object is seen; check its pose, and the scale in intrinsics.txt")
    if mask.shape == (size, size) and instance.centre == (0.5 * size, 0.5 * size):
        return rgb, mask, T, 0.5 * size / instance.focal
    if distance < 1.1 * ENCODER_RADIUS:
        raise ValueError(f"{where}, in the object's midst; check the barycentre and the scale in intrinsics.txt")
    tangent = ENCODER_RADIUS / distance
    T_new = look_at(T[:3, 3], np.zeros(3))
    finer = int(np.clip(np.ceil(instance.focal * tangent / (0.5 * size)), 1, _MOST_SAMPLES))
    n = finer * size
    K = np.array(
        [[instance.focal, 0, instance.centre[0] - 0.5], [0, instance.focal, instance.centre[1] - 0.5], [0, 0, 1]]
    )
    K_new = np.array([[0.5 * n / tangent, 0, 0.5 * n - 0.5], [0, 0.5 * n / tangent, 0.5 * n - 0.5], [0, 0, 1]])
    source_of_new = K @ T[:3, :3].T @ T_new[:3, :3] @ np.linalg.inv(K_new)
    shown = np.dstack([np.where(mask[..., None], rgb, 0), mask]).astype(np.float32)  # black, so that no white bleeds in
    warped = cv2.warpPerspective(shown, source_of_new, (n, n), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    mean = warped.reshape(size, finer, size, finer, 4).mean(axis=(1, 3))
    inside: np.ndarray = mean[..., 3] >= 0.5
    colour = np.rint(mean[..., :3] / np.maximum(mean[..., 3:], 0.5)).clip(0, 255).astype(np.uint8)
    return np.where(inside[..., None], colour, np.uint8(255)), inside, T_new, tangent


def _numbers(path: Path, text: str, line: int | None, counts: tuple[int, ...], what: str) -> list[float]:
    where = f"{path}" if line is None else f"{path}, line {line}"
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        raise ValueError(f"{where}: {text.strip()!r} is not {what}; write numbers") from None
    if len(numbers) not in counts or not np.isfinite(numbers).all():
        wanted = " or ".join(map(str, counts))
        raise ValueError(f"{where} holds {len(numbers)} numbers, or one that is not finite; {what} has {wanted}")
    return numbers


def _read_intrinsics(
    path: Path,
) -> tuple[float, tuple[float, float], tuple[float, float, float], float, tuple[int, int], bool]:
    lines = _read_text(path).splitlines()
    while lines and not lines[-1].strip():
        lines.pop()
    if len(lines) < len(_LINES):
        raise ValueError(
            f"{path} is cut short: line {len(lines) + 1} ({_LINES[len(lines)]}) is missing; copy it again, or write it"
        )
    (f, cx, cy, *_), barycentre, (scale,), (height, width) = (
        _numbers(path, lines[i], i + 1, counts, _LINES[i]) for i, counts in enumerate(((3, 4), (3,), (1,), (2,)))
    )
    for line, name, value in ((1, "f", f), (3, "scale", scale), (4, "height", height), (4, "width", width)):
        if value <= 0:
            raise ValueError(f"{path}, line {line}: {name} is {value:g}; it must be positive")
    if height % 1 or width % 1:
        raise ValueError(f"{path}, line 4: {height:g}x{width:g} px are no whole numbers; write the pictures' size")
    if height * width > MOST_PIXELS:
        raise ValueError(f"{path}, line 4: {height:g}x{width:g} px are more than {MOST_PIXELS}; give smaller pictures")
    inverted = len(lines) > len(_LINES) and _numbers(path, lines[4], 5, (1,), "0 or 1")[0] == 1
    x, y, z = barycentre
    return f, (cx, cy), (x, y, z), scale, (int(height), int(width)), inverted


def _read_pose(path: Path) -> Float[np.ndarray, "4 4"]:
    T = np.reshape(_numbers(path, _read_text(path), None, (16,), "a 4x4 transform"), (4, 4))
    if not rigid(T):
        raise ValueError(f"{path} is no rigid transform (rotation, then 0 0 0 1 below); write T_world_camera")
    return T


def _read_picture(path: Path, size: tuple[int, int]) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    data = path.read_bytes()
    try:
        if not data.startswith(PNG_MAGIC):
            raise ValueError("it is no PNG")
        check_png(data, MOST_PIXELS)
    except ValueError as error:
        raise ValueError(f"{path} cannot be read ({error}); copy it again") from None
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError(f"{path} is damaged; copy it again")
    if image.dtype != np.uint8 or image.ndim != 3:
        raise ValueError(f"{path} is {image.dtype}{list(image.shape)}; save it as RGB or RGBA with 8 bits a channel")
    if image.shape[:2] != size:
        raise ValueError(
            f"{path} is {image.shape[1]}x{image.shape[0]} px but intrinsics.txt says {size[1]}x{size[0]}; correct one"
        )
    rgb = np.ascontiguousarray(image[..., 2::-1])
    if image.shape[2] == 4 and image[..., 3].min() < 255:  # an alpha channel that is opaque everywhere marks no object
        return rgb, image[..., 3] >= 128
    return rgb, np.asarray((rgb < _WHITE).any(axis=-1))


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii")
    except UnicodeDecodeError:
        raise ValueError(f"{path} is not a text of numbers; write it again") from None
