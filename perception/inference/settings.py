"""Settings of inference on frames, publishing and tracking. Standard library only: the command line reads them
without JAX."""

from dataclasses import dataclass, field

from perception.observation.settings import ObserveConfig
from probnerf.settings import InferConfig


@dataclass(frozen=True)
class PublishConfig:
    """How finely an answer is given."""

    hypotheses: int = 48  # shapes published
    grid: int = 64  # voxels per axis, G
    coarse: int = 1  # along each axis, shapes are evaluated at every so-many-th corner and interpolated between them
    out_of_model_below: float = 0.90  # mean share of informative pixels explained; validation objects: 0.91 and more

    def __post_init__(self) -> None:
        if self.hypotheses < 1:
            raise ValueError(f"hypotheses is {self.hypotheses}; give 1 or more")
        if not 1 <= self.grid <= 512:
            raise ValueError(f"grid is {self.grid}; give 1 to 512")
        if self.coarse < 1:
            raise ValueError(f"coarse is {self.coarse}; give 1 or more")


@dataclass(frozen=True)
class ControllerConfig(PublishConfig):
    """How much is inferred, and how finely results are published."""

    infer: InferConfig = field(default_factory=InferConfig)  # of one run
    observe: ObserveConfig = field(default_factory=ObserveConfig)
    first_hypotheses: int = 24  # published while better ones are under way; 48 score no better
    first_coarse: int = 2  # their `coarse`: 48 shapes at 2 cost less than 8 at 1
    runs: int = 1  # of the sampler; their populations answer together (`farside bench runs`: more bring nothing)

    def __post_init__(self) -> None:
        super().__post_init__()
        if min(self.first_hypotheses, self.first_coarse, self.runs) < 1:
            first = f"first_hypotheses {self.first_hypotheses}, first_coarse {self.first_coarse}"
            raise ValueError(f"{first} and runs {self.runs} must be 1 or more")


@dataclass(frozen=True)
class TrackConfig:
    """When a frame counts as a further view of an object, and when the object counts as moved."""

    views: int = 3  # kept of each object; a further one replaces the nearest
    apart: float = 15.0  # degrees between the directions of two views; a nearer view replaces the other
    adds: float = 0.08  # share of the unseen space above the plane that a frame must see first; noise sees 0.01 to 0.03
    checked: int = 32  # hypotheses that a frame is compared with; the best of them counts
    moved_below: float = 0.8  # share of informative pixels that the best one explains; below it the object moved
    reach: float = 0.6  # half extents; without a label map the object nearer than this is the same one
    plane_degrees: float = 2.0  # without T_world_camera: change of the plane's tilt up to which the camera is still
    plane_m: float = 0.01  # and change of its distance
    objects: int = 16  # kept in memory; beyond that, those inferred longest ago are dropped

    def __post_init__(self) -> None:
        if min(self.views, self.checked) < 1:
            raise ValueError(f"views {self.views} and checked {self.checked} must be 1 or more")
