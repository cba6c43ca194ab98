"""Settings of segmentation and observation. Standard library only, for the command line reads them without OpenCV."""

import math
from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class PlaneConfig:
    """Lengths in metres; those marked * hold up to 1 m from the camera and grow with `noise_growth` beyond."""

    tolerance: float = 0.008  # * half thickness of the slab that counts as the plane
    lowest: float = 0.016  # * what stands on a plane has points higher than this
    highest: float = 0.5  # and lower than this
    triplets: int = 1000  # planes tried
    seed: int = 0


@dataclass(frozen=True)
class PlaneGuess:
    """The plane that things stand on where no depth measures it: from the camera's height and tilt, or its pose."""

    camera_height: float | None = None  # m over the table; with `tilt`, and then the camera's pose is not read
    tilt: float | None = None  # degrees of the optical axis below the horizon; the picture's rows are level
    table: float = 0.0  # m; the table's height in the world frame, where the camera's pose in it is known
    height_sigma: float = 0.01  # m; standard deviation of the camera's height over the table
    tilt_sigma: float = 1.0  # degrees; of its tilt

    def __post_init__(self) -> None:
        if (self.camera_height is None) != (self.tilt is None):
            missing = "tilt" if self.tilt is None else "camera_height"
            raise ValueError(f"{missing} is missing; give both, camera_height in metres and tilt in degrees")
        if self.camera_height is not None and not 0 < self.camera_height < math.inf:
            raise ValueError(f"camera_height is {self.camera_height:g} m; give metres above the table, more than 0")
        if self.tilt is not None and not -90 <= self.tilt <= 90:
            raise ValueError(f"tilt is {self.tilt:g}; give degrees of the optical axis below the horizon, -90 to 90")
        for name in ("height_sigma", "tilt_sigma"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} is {getattr(self, name):g}; give a standard deviation, 0 or more")


@dataclass(frozen=True)
class MaskConfig:
    """Where objects' pixels come from without depth: the box, else the background, else the frame's label map."""

    box_px: tuple[int, int, int, int] | None = None  # x0 y0 x1 y1 about one whole object, the last two beyond it
    before: tuple[tuple[int, int, int, int], ...] = ()  # boxes of things that may stand before what is in the box
    background: Path | None = None  # PNG of the same scene from the same place without the objects
    difference: float = 8.0  # of CIELAB colours (lightness counts half: shadows) beyond which a pixel has changed
    margin: float = 0.5  # of the box's sides: how much around it shows what is behind
    iterations: int = 5  # of GrabCut
    band: int = 3  # px each side of the outline that say nothing
    least: int = 200  # px of what is an object


@dataclass(frozen=True)
class SegmentConfig:
    """Lengths in metres; heights are above the support plane."""

    plane: PlaneConfig = field(default_factory=PlaneConfig)
    above: float = 0.008  # points higher than this stand on the plane (within 1 m; see `noise_growth`)
    base: float = 0.003  # lower pixels next to an object belong to it down to here (likewise)
    max_height: float = 0.5  # higher points are not on a tabletop
    voxel: float = 0.006  # points up to two voxels apart are one object
    depth_step: float = 0.02  # pixels whose 3x3 neighbours on objects span more depth are on an outline
    lifted: float = 0.02  # an object that ends higher than this may stand on another object
    min_height: float = 0.02  # of what is found without a label map
    min_pixels: int = 50  # a smaller mask says nothing about a shape
    min_cluster_pixels: int = 200
    rim: int = 2  # px each side of a mask's outline that say nothing: mixed pixels, misregistered depth
    mask: MaskConfig = field(default_factory=MaskConfig)  # without depth
    guess: PlaneGuess = field(default_factory=PlaneGuess)  # without depth

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, float | int) and not 0 <= value < math.inf:
                raise ValueError(f"{name} is {value:g}; give 0 or more")


@dataclass(frozen=True)
class ObjectFrameConfig:
    """How a cube is put about an object, and how well its place and size count as known."""

    xy_sigma: float = 0.08  # cube units; prior width of the body's axis about the guess
    log_scale_sigma: float = 0.06
    hidden_sigma: float = 0.3  # added to all widths, times the share of the outline that is hidden or cut off
    side_sigma: float = 0.08  # added to all widths where the camera does not look down on the top
    rim_reach: float = 0.02  # m; a rim pixel this near its neighbour inside the outline is of the object
    outline_px: int = 5  # px from the outline within which something nearer hides what goes on
    min_height: float = 0.02  # m; the tabletop's range of sizes
    max_side: float = 0.40  # m


@dataclass(frozen=True)
class ObserveConfig(ObjectFrameConfig):
    """How a segment becomes an Observation. Ray counts are fixed, so that no frame compiles anew."""

    colour_rays: int = 32  # OBJECT pixels
    free_rays: int = 26  # FREE pixels, half of them near the outline
    occluder_rays: int = 6  # UNKNOWN pixels that see something nearer
    range_sigma_a: float = 1.0e-3  # m; sigma of a range d: a + b d^2
    range_sigma_b: float = 2.0e-3  # 1/m
    cube: float = 1.2  # half side (cube units) of the box that a ray must meet to be worth asking
    outline_band: float = 0.25  # cube units either side of the mask that count as near its outline
    range_offset_sigma: float = 0.005  # m; bias that all ranges of a view share
    plane_sigma: float = 0.005  # m; of the plane's height, which a sensor measures at a grazing angle
