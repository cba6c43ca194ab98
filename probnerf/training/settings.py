"""The training recipe. Standard library only, because the command line reads it without JAX."""

from dataclasses import dataclass


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
    frozen_steps: int = 0  # first steps with a frozen decoder, to adapt recognition to an already trained one
    kl_warmup: int = 2_000
    seed: int = 0
    checkpoint_every: int = 500
    log_every: int = 50
    map_batch: int | None = None  # objects per vectorised chunk of the field (None: one by one, best on a CPU)
