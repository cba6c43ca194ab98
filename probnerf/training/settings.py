"""The training recipe. Standard library only, because the command line reads it without JAX."""

from dataclasses import dataclass, fields


@dataclass(frozen=True)
class TrainConfig:
    """The recipe. Steps count optimiser updates. All values are stored with the weights."""

    steps: int = 48_500
    solid_steps: int = 44_000  # the first steps, which form the solid phase
    batch: int = 64  # objects per step in the solid phase
    ray_batch: int = 16  # objects per step afterwards
    views: int = 3  # encoder views per object; a random number of them is used
    object_rays: int = 48
    near_rays: int = 24  # free pixels within 2 pixels of the object
    far_rays: int = 8
    points: int = 512  # solid samples per object
    points_of_others: int = 256  # solid samples per object at points of the batch's other objects
    colours: int = 192  # surface colours per object
    finer: float = 2.0  # solid samples must be opaque on a lattice that is finer by this factor
    grazing: float = 1.0  # empty samples must be transparent to a ray that crosses this many faces
    effective_rays: float = 1500.0  # N_rays: independent residuals per object
    effective_points: float = 10_000.0  # N_points
    effective_colours: float = 800.0  # N_colours
    learning_rate: float = 2e-3
    ray_learning_rate: float = 3e-4  # in the ray phase, of all networks except the encoder
    final_learning_rate: float = 2e-5
    warmup: int = 500
    level: float = 0.6  # share of a phase's steps after which its learning rate falls (by a half cosine)
    frozen_steps: int = 0  # first steps with a frozen decoder, to adapt recognition to an already trained one
    same_latents: bool = False  # recognition and flow stay, so that a posterior network stays right; not the decoder
    kl_warmup: int = 2_000
    seed: int = 0
    checkpoint_every: int = 500
    log_every: int = 50
    map_batch: int | None = None  # objects per vectorised chunk of the field (None: one by one, best on a CPU)

    def __post_init__(self) -> None:
        names = "solid_steps near_rays far_rays points_of_others frozen_steps kl_warmup warmup seed"
        least = dict.fromkeys(names.split(), 0)
        for field in fields(self):
            value, option = getattr(self, field.name), f"--{field.name.replace('_', '-')}"
            if isinstance(value, bool):
                continue
            if isinstance(value, int) and not (low := least.get(field.name, 1)) <= value < 1 << 32:
                raise ValueError(f"{option} is {value}; give {low} to {(1 << 32) - 1}")
            if isinstance(value, float) and not 0.0 < value <= 1e9:
                raise ValueError(f"{option} is {value:g}; give more than 0, and at most 1e9")
        for name in ("learning_rate", "ray_learning_rate", "final_learning_rate", "level"):
            if getattr(self, name) > 1.0:
                raise ValueError(f"--{name.replace('_', '-')} is {getattr(self, name):g}; give at most 1")


@dataclass(frozen=True)
class PosteriorTrainConfig:
    """The recipe of a posterior network. Shares are of the pictures in each step."""

    steps: int = 60_000
    batch: int = 128  # pictures per step
    learning_rate: float = 1e-3
    final_learning_rate: float = 1e-5
    warmup: int = 1_000
    clip: float = 20.0  # norm of the gradient, nats
    average: float = 0.999  # decay of the weights' moving average
    without_depth: float = 0.25  # share without any range
    known_pose: float = 0.15  # share with the pose given
    occluded: float = 0.5  # share behind a random occluder
    most_hidden: float = 0.8  # largest share of the object that it hides
    validation: float = 0.05  # share of the objects that are never trained on
    validation_pictures: int = 1_024
    validate_every: int = 1_000
    log_every: int = 50
    checkpoint_every: int = 500
    seed: int = 0

    def __post_init__(self) -> None:
        shares = ("without_depth", "known_pose", "occluded", "most_hidden", "validation")
        for name in shares:
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be between 0 and 1")
        if not 0.0 <= self.average < 1.0:
            raise ValueError(f"average is {self.average}; it must be at least 0 and below 1")
