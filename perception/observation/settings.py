"""Settings of segmentation and observation. Standard library only: the command line reads them without OpenCV."""

import math
from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class PlaneConfig:
    """Lengths in metres; those marked * hold up to 1 m from the camera and grow with `noise_growth` beyond."""

    given: tuple[float, float, float, float] | None = None  # a b c d: a x + b y + c z + d = 0 in the camera frame
    tolerance: float = 0.008  # * half thickness of the slab that counts as the plane
    highest: float = 0.5  # objects on the plane have points lower than this
    least: float = 0.02  # share of the points with depth that makes a plane
    most: int = 7  # planes that are looked for
    also: float = 0.25  # another plane is a support, too, if it carries this share of what the first carries
    triplets: int = 1000  # triplets tried for each
    seed: int = 0

    def __post_init__(self) -> None:
        if self.given is not None and not 0.0 < math.hypot(*self.given[:3]) < math.inf:
            raise ValueError(f"plane is {self.given}; give a b c d with a x + b y + c z + d = 0, (a, b, c) not zero")


@dataclass(frozen=True)
class PlaneGuess:
    """The support plane without depth: from the camera's height and tilt, or from its pose."""

    camera_height: float | None = None  # m above the table; needs `tilt`; replaces the camera's pose
    tilt: float | None = None  # degrees of the optical axis below the horizon; no roll
    table: float = 0.0  # m; the table's height in the world frame, used with the camera's pose
    height_sigma: float = 0.01  # m; standard deviation of the camera's height above the table
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

    box_px: tuple[int, int, int, int] | None = None  # x0 y0 x1 y1 around one whole object; x1 and y1 are exclusive
    before: tuple[tuple[int, int, int, int], ...] = ()  # boxes of things that may occlude the object
    background: Path | None = None  # PNG of the scene without the objects, by the same camera in the same place
    difference: float = 8.0  # of CIELAB colours above which a pixel has changed; lightness counts half, for shadows
    margin: float = 0.5  # of the box's sides: width of the surroundings that show the background
    iterations: int = 5  # of GrabCut
    band: int = 3  # px on each side of the outline that are UNKNOWN
    least: int = 200  # px of the smallest object


@dataclass(frozen=True)
class SegmentConfig:
    """Lengths in metres; heights are above the support plane."""

    plane: PlaneConfig = field(default_factory=PlaneConfig)
    above: float = 0.008  # points higher than this belong to objects (within 1 m; see `noise_growth`)
    base: float = 0.003  # lower pixels next to an object belong to it down to here (likewise)
    max_height: float = 0.5  # higher points are not on a tabletop
    voxel: float = 0.006  # points up to two voxels apart are one object
    depth_step: float = 0.02  # a pixel is on an outline where its 3x3 neighbours on objects span more depth
    lifted: float = 0.02  # an object whose lowest points are higher may stand on another object
    min_height: float = 0.02  # of an object found without a label map
    min_pixels: int = 50  # of the smallest usable mask
    min_cluster_pixels: int = 200  # of the smallest thing found without a label map
    max_side: float = 0.40  # and of the widest
    cut_off: float = 0.1  # of its longer side in the picture: how much of the border its pixels may take
    rim: int = 2  # px on each side of a mask's outline that are UNKNOWN: mixed pixels, misregistered depth
    mask: MaskConfig = field(default_factory=MaskConfig)  # without depth
    guess: PlaneGuess = field(default_factory=PlaneGuess)  # without depth
    whole: bool = True  # the picture is the camera's whole one: its principal point lies within

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, float | int) and not 0 <= value < math.inf:
                raise ValueError(f"{name} is {value:g}; give 0 or more")


@dataclass(frozen=True)
class ObjectFrameConfig:
    """How a cube is placed around an object, and how uncertain its place and size are."""

    xy_sigma: float = 0.08  # cube units; standard deviation of the body's axis around the estimate
    log_scale_sigma: float = 0.06
    hidden_sigma: float = 0.3  # added to all standard deviations, times the share of the outline hidden or cut off
    side_sigma: float = 0.08  # added to all standard deviations where the camera does not look down on the top
    depth_scale_sigma: float = 0.0  # relative error of depth's scale, which no view shows: place and size get it, too
    rim_reach: float = 0.02  # m; a rim pixel this near its neighbour inside the outline belongs to the object
    outline_px: int = 5  # px from the outline within which a nearer object may hide more of this one
    min_height: float = 0.02  # m; the prior's range of sizes
    max_side: float = 0.40  # m

    def __post_init__(self) -> None:
        if not 0 <= self.depth_scale_sigma < 0.5:
            raise ValueError(
                f"depth_scale_sigma is {self.depth_scale_sigma:g}; give a relative error, 0.05 for 5%, below 0.5"
            )


@dataclass(frozen=True)
class ObserveConfig(ObjectFrameConfig):
    """How a segment becomes Observations. Ray counts are fixed, so that no frame needs a new compilation."""

    choices: int = 8  # of pixels: each population of the sampler compares its own (`probnerf.inference.infer`)
    colour_rays: int = 32  # OBJECT pixels
    free_rays: int = 26  # FREE pixels, half of them near the outline
    occluder_rays: int = 6  # UNKNOWN pixels that see something nearer
    range_sigma_a: float = 1.0e-3  # m; sigma of a range d: a + b d^2
    range_sigma_b: float = 2.0e-3  # 1/m
    cube: float = 1.2  # half side (cube units) of the box that a used ray must meet
    outline_band: float = 0.25  # cube units on either side of the mask that count as near its outline
    range_offset_sigma: float = 0.005  # m; bias shared by all ranges of a view
    plane_sigma: float = 0.005  # m; of the plane's height, measured at a grazing angle

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.choices < 1:
            raise ValueError(f"choices is {self.choices}; give 1 or more")
