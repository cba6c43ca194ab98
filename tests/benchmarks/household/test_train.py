"""Training by the clock: any part of the jobs is balanced, rates follow the time, room that is left is never drawn."""

import itertools
from collections import Counter
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("embreex")

from benchmarks.household import network
from benchmarks.household.objects import Job, Made, load_things, make
from benchmarks.household.train import CALL, Options, at_step, by_the_clock, jobs_of, padded
from perception.simulation.training_pictures import PicturePart
from probnerf.prior.checkpoint import load_prior, recognition_path, save_prior, save_recognition
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.training import elbo, on_device
from probnerf.training.learnt_objects import TABLETOP, LearntObject
from probnerf.training.mesh_shapes import PAINTS
from probnerf.training.settings import PosteriorTrainConfig, TrainConfig
from probnerf.training.shape_set import ShapeSet, batch_of, load_shapes

CONFIG = TrainConfig(steps=100, solid_steps=100)


def test_any_first_part_of_the_jobs_has_all_families() -> None:
    jobs = jobs_of(Options(meshes=Path("a"), infinigen=Path("b")))
    half = Counter[str]()
    for job in jobs[: len(jobs) // 2]:
        half[job.family] += job.count
    for family, count in zip(("household", "meshes", "infinigen", "tabletop"), Options.counts, strict=True):
        assert half[family] == pytest.approx(count / 2, rel=0.1)
    assert len({(job.family, job.first) for job in jobs}) == len(jobs)
    assert {job.family for job in jobs_of(Options(meshes=Path("a")))} == {"household", "meshes", "tabletop"}


def test_setting_the_step_sets_the_optimisers_rate() -> None:
    state = elbo.initial_state(ProbNeRF(PRESETS["tiny"], jax.random.key(0)), CONFIG)
    moved = at_step(state, 60)
    assert int(moved.step) == 60
    counts = [int(leaf) for leaf in jax.tree.leaves(moved.optimiser) if jnp.issubdtype(leaf.dtype, jnp.integer)]
    assert counts and set(counts) == {60}
    for a, b in zip(jax.tree.leaves(moved.model), jax.tree.leaves(state.model), strict=True):
        np.testing.assert_array_equal(a, b)


def test_steps_follow_the_clock_and_a_loss_that_is_not_finite_ends_it(tmp_path: Path) -> None:
    state = elbo.initial_state(ProbNeRF(PRESETS["tiny"], jax.random.key(0)), CONFIG)
    seen: list[int] = []
    ticks = itertools.count()

    def clock() -> float:
        return float(next(ticks))

    def call(state: elbo.TrainState) -> tuple[elbo.TrainState, dict]:
        seen.append(int(state.step))
        return state, {"loss": jnp.ones(2)}

    last = list(by_the_clock(call, state, 1000, clock, 40.0, tmp_path / "h.jsonl", every=0.0))[-1]
    assert seen == sorted(seen) and seen[0] < 60 and seen[-1] > 850
    assert last[1] == CALL * len(seen) and len((tmp_path / "h.jsonl").read_text().splitlines()) == len(seen)
    with pytest.raises(FloatingPointError, match="loss is nan"):
        list(by_the_clock(lambda s: (s, {"loss": jnp.array([jnp.nan])}), state, 9, clock, 1e6, tmp_path / "n.jsonl"))


@pytest.mark.nightly
def test_a_job_leaves_shapes_pictures_and_objects_and_is_not_repeated(tmp_path: Path) -> None:
    made = make(Job("household", None, 0, 2), tmp_path)
    assert isinstance(made, Made) and 1 <= made.count <= 2
    shapes, plain = load_shapes(made.shapes), PicturePart.load(made.plain)
    assert len(shapes) == made.count == len(plain.description) and len(plain.rgb) > made.count
    stamp = made.things.stat().st_mtime_ns
    assert make(Job("household", None, 0, 2), tmp_path) == made and made.things.stat().st_mtime_ns == stamp
    device = padded([(shapes, 1.0)], 5)
    assert len(device.cumulative) == 5
    batch = on_device.drawn_shapes(device, jax.random.key(0), 64, 16, 4)
    rows = [np.flatnonzero((shapes.distance.astype(np.float32) / 0.25 == d).all(axis=1)) for d in batch.distance]
    assert all(len(row) for row in rows)
    nothing = make(Job("meshes", tmp_path / "none", 0, 2), tmp_path)
    assert isinstance(nothing, str) and "FileNotFound" in nothing


@pytest.mark.nightly
def test_objects_read_back(tmp_path: Path) -> None:
    for job in (Job("household", None, 4, 1), Job("tabletop", None, 0, 8)):
        made = make(job, tmp_path)
        assert isinstance(made, Made)
        thing, again = load_things(made.things)[0], load_things(made.things)[0]
        points = thing.vertices[:20].astype(np.float64)
        normals = np.tile([0.0, 0.0, 1.0], (20, 1))
        np.testing.assert_array_equal(thing.colours(points, normals), again.colours(points, normals))
        assert thing.faces.max() < len(thing.vertices) and thing.half_extent > 0.01
        told = recognition_input(load_shapes(made.shapes), thing)
        np.testing.assert_allclose(thing.description, told, atol=2e-3)


def recognition_input(shapes: ShapeSet, thing: LearntObject) -> np.ndarray:
    """The description of the object's own row in its own paint."""
    paint = 0 if thing.family == TABLETOP else thing.seed % PAINTS
    batch = batch_of(shapes, np.random.default_rng(0), np.array([0]), 4, 1, np.array([paint]))
    return np.asarray(batch.description[0])


@pytest.mark.nightly
def test_a_network_learns_objects_and_the_models_own_shapes_until_its_time_is_over(tmp_path: Path) -> None:
    weights, work = tmp_path / "prior.safetensors", tmp_path / "work"
    work.mkdir()
    state = elbo.initial_state(ProbNeRF(PRESETS["tiny"], jax.random.key(0)), CONFIG)
    save_prior(weights, state.model, {})
    save_recognition(recognition_path(weights), state.recognition, load_prior(weights).hash)
    assert isinstance(make(Job("household", None, 0, 2), work), Made)
    recipe = PosteriorTrainConfig(steps=1000, warmup=20, batch=16)
    options = network.Options(weights, work, tmp_path, draws=4, seconds=5.0, processes=1, recipe=recipe)
    network.main(options)
    prior = load_prior(weights)
    assert prior.network is not None and prior.network.sizes.latent == prior.model.latent
    (part,) = work.glob("model_*.npz")
    gathered = network.gathered(prior, weights, work, [part, part], held_out=0.0)
    with np.load(part) as file:
        count = len(file["mean"])
        np.testing.assert_array_equal(gathered.pictures.mean[-count:], file["mean"])
    assert len(gathered.sorts["model"]) > count and not gathered.pictures.sd[-2 * count :].any()
    assert len(gathered.pictures) > 2 * count and len(gathered.sorts["scenes"]) == 0
