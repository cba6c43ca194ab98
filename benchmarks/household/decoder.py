"""Go on training a prior on solid shapes: `python -m benchmarks.household.decoder`.

Decoder, recognition and flow learn on, on any machine; a run resumes in its folder. Figures of held-out objects tell
whether the decoder makes things in space that is certainly free (`ghosts`).
"""

from dataclasses import dataclass, field
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Float

from benchmarks.harness.machine import revision
from benchmarks.harness.progress import say
from probnerf.likelihood.dispatch import density_at
from probnerf.likelihood.settings import Likelihood
from probnerf.prior.checkpoint import (
    load_prior,
    load_recognition,
    network_path,
    recognition_path,
    save_posterior_network,
    save_prior,
    save_recognition,
)
from probnerf.prior.networks import ProbNeRF, Recognition
from probnerf.rendering import foam
from probnerf.training import elbo
from probnerf.training.picture_set import recognised
from probnerf.training.settings import TrainConfig
from probnerf.training.shape_set import GRID, ShapeSet, batch_of, centres, joined, load_shapes

FAMILIES = ("tabletop", "household", "meshes", "infinigen")
FREE = 0.1  # cube units from the object beyond which space must be free
VOXELS = 32  # per axis, where shapes are compared


@dataclass(frozen=True)
class Options:
    """Go on training a prior on solids."""

    prior: Path
    """Weights; the recognition must lie beside them."""
    work: Path
    """Folder with the shapes (*.shapes) that `objects.make` leaves."""
    out: Path = Path("runs/household-decoder")
    """Folder of the run, the prior and its recognition. With --train.same-latents the network is right for it, too, and
    is left there; else one must be trained anew."""
    shares: tuple[float, float, float, float] = (0.2, 0.3, 0.3, 0.2)
    """Of tabletop objects, the generator's, meshes and Infinigen's in a batch."""
    held_out: int = 128
    """Objects of each family that are never trained on, by which figures are told."""
    train: TrainConfig = field(
        default_factory=lambda: TrainConfig(
            steps=6000,
            solid_steps=6000,
            batch=64,
            points=256,
            colours=64,
            learning_rate=1e-3,
            final_learning_rate=1e-5,
            warmup=100,
            level=0.4,
            kl_warmup=1,
            seed=6,
            checkpoint_every=500,
            log_every=50,
        )
    )


@eqx.filter_jit  # here, so that it is compiled once for all checkpoints
def _densities(model: ProbNeRF, z: Float[Array, "b k"], points: Float[Array, "n 3"]) -> Float[Array, "b n"]:
    return jax.lax.map(lambda one: density_at(model.field, model.hyper(one), None, points), z)


def ghosts(model: ProbNeRF, recognition: Recognition, shapes: ShapeSet) -> dict[str, float]:
    """How well recognised objects are made: share of them with more than 1% of their own volume in space that is
    certainly free, the mean of that volume's share, and the share of what is certainly solid that is missing.
    """
    points = centres(VOXELS).astype(np.float32)
    batch = batch_of(shapes, np.random.default_rng(0), np.arange(len(shapes)), 4, 1)
    ((mean, _),) = recognised(recognition, [np.asarray(batch.description)])
    cell = np.floor((points + 1.0) * (GRID / 2.0)).astype(int)  # whose distance is known, and how far its centre is
    distance = shapes.distance.astype(np.float32)[:, np.ravel_multi_index(tuple(cell.T), (GRID,) * 3)]
    gap = np.linalg.norm(points - ((cell + 0.5) * (2.0 / GRID) - 1.0), axis=1)

    made = np.asarray(_densities(model, jnp.asarray(mean), jnp.asarray(points))) * (2.0 / VOXELS) > np.log(
        2.0
    )  # half of a voxel's light is stopped
    volume = np.maximum((distance < 0.0).sum(axis=1), 1)
    extra = (made & (distance > gap + FREE)).sum(axis=1) / volume
    lost = (~made & (distance < -gap)).sum() / volume.sum()
    return {"objects": float((extra > 0.01).mean()), "extra": float(np.minimum(extra, 1.0).mean()), "lost": float(lost)}


def main(options: Options) -> None:
    """Train, and write the prior and its recognition."""
    prior = load_prior(options.prior)
    recognition = load_recognition(recognition_path(options.prior), prior)
    sets, held = [], {}
    for family, share in zip(FAMILIES, options.shares, strict=True):
        if paths := sorted(options.work.glob(f"{family}-*.shapes")):
            shapes = joined([load_shapes(path) for path in paths])
            held[family] = shapes[slice(0, options.held_out)]
            sets.append((shapes[slice(options.held_out, None)], share))
            say(f"{family}: {len(sets[-1][0])} objects; held out: {ghosts(prior.model, recognition, held[family])}")
    if not sets:
        raise ValueError(f"{options.work} has no shapes (*.shapes); `benchmarks.household.objects.make` makes them")
    preset = prior.model.preset
    likelihood = Likelihood(lattice=foam.Lattice(preset.lattice, 1.0, 9 * preset.lattice // 4))
    config, path = options.train, options.out / "prior.safetensors"
    for state, told in elbo.train(prior.model, sets, None, likelihood, config, options.out / "run", recognition):
        say(str({name: round(value, 2) for name, value in told.items()}))
        if (step := int(told["step"])) % config.checkpoint_every == 0 or step == config.steps:
            for family, shapes in held.items():
                say(f"  {family}: {ghosts(state.model, state.recognition, shapes)}")
            story = {"decoder_trained_on": {"of": prior.hash, "steps": step, "revision": revision()}}
            network_path(path).unlink(missing_ok=True)  # it names the prior of the checkpoint before
            save_prior(path, state.model, prior.metadata | story, half=True)
            learnt = load_prior(path).hash
            save_recognition(recognition_path(path), state.recognition, learnt)
            if config.same_latents and prior.network is not None:
                save_posterior_network(network_path(path), prior.network, learnt, story)
    say(f"{path}: all {config.steps} steps are done")


if __name__ == "__main__":
    main(tyro.cli(Options))
