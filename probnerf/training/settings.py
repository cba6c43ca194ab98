"""The recipe of training. Standard library only, for the command line reads it without JAX."""

from dataclasses import dataclass


@dataclass(frozen=True)
class TrainConfig:
    """The recipe. Steps count optimiser updates; every number travels with the weights."""

    steps: int = 48_500
    solid_steps: int = 44_000  # of these, the first so many are the solid phase
    batch: int = 64  # objects per step in the solid phase
    ray_batch: int = 16  # objects per step afterwards
    views: int = 3  # encoder views per object; a random number of them is used
    object_rays: int = 48
    near_rays: int = 24  # free pixels within 2 pixels of the object
    far_rays: int = 8
    points: int = 512  # solid samples per object
    colours: int = 192  # surface colours per object
    finer: float = 2.0  # solid samples are opaque on a lattice finer by this
    grazing: float = 1.0  # empty ones are transparent to a ray that meets so many faces there
    effective_rays: float = 1500.0  # N_rays: independent residuals per object
    effective_points: float = 10_000.0  # N_points
    effective_colours: float = 800.0  # N_colours
    learning_rate: float = 2e-3
    ray_learning_rate: float = 3e-4  # of all but the encoder, in the ray phase
    final_learning_rate: float = 2e-5
    warmup: int = 500
    frozen_steps: int = 0  # the decoder stands still so long: where it is trained already, recognition comes to it
    kl_warmup: int = 2_000
    seed: int = 0
    checkpoint_every: int = 500
    log_every: int = 50
    map_batch: int | None = None  # objects per vectorised chunk of the field (None: one by one, best on a CPU)
