"""The SRN layout: what is written is read back exactly, strangers' files are understood, broken ones are named."""

from dataclasses import replace
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest

from probnerf.geometry import look_at
from probnerf.likelihood.settings import Likelihood
from probnerf.objects.ray_tracer import render_views
from probnerf.objects.tabletop import sample_objects
from probnerf.prior.encoder_input import ENCODER_RADIUS
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.rendering import foam
from probnerf.training.batches import draw_batch, strata_of
from probnerf.training.elbo import train
from probnerf.training.settings import TrainConfig
from probnerf.training.srn_dataset import NO_RANGE, Instance, find_instances, read_instance, read_views, write_instance

SIZE = 16  # of the tiny preset
DISTANCE = 4.0  # cube units


def pictured(seed: int, views: int = 6, size: int = SIZE, scale: float = 1.0) -> Instance:
    """A tabletop object seen from all around, in a world whose unit is `scale` cubes."""
    turns = 2 * np.pi * np.arange(views) / views
    places = DISTANCE * np.stack([0.8 * np.cos(turns), 0.8 * np.sin(turns), np.full(views, 0.6)], axis=-1)
    T = np.stack([look_at(place, np.zeros(3)) for place in places])
    focal = 0.5 * size * DISTANCE / ENCODER_RADIUS
    seen = render_views(sample_objects([seed] * views, slack=0.0), T, focal, size)
    rgb, mask = np.rint(255 * np.asarray(seen.rgb)).astype(np.uint8), np.asarray(seen.mask)
    barycentre = (0.1, -0.2, 0.3)
    T[:, :3, 3] = 0.5 * scale * T[:, :3, 3] + barycentre
    return Instance(f"object_{seed}", focal, (0.5 * size, 0.5 * size), barycentre, scale, rgb, mask, T)


def test_reading_what_was_written_is_exact(tmp_path: Path) -> None:
    x = pictured(3, scale=0.37)
    assert 0.05 < x.mask.mean() < 0.6
    folder = write_instance(tmp_path, x)
    y = read_instance(folder)
    assert (y.name, y.focal, y.centre, y.barycentre, y.scale) == (x.name, x.focal, x.centre, x.barycentre, x.scale)
    for name in ("rgb", "mask", "T_world_camera"):
        np.testing.assert_array_equal(getattr(y, name), getattr(x, name))
    again = write_instance(tmp_path / "again", y)
    for path in sorted(folder.rglob("*.*")):
        assert (again / path.relative_to(folder)).read_bytes() == path.read_bytes()


def test_views_are_the_pictures_in_the_unit_cube(tmp_path: Path) -> None:
    """The world's unit and origin do not matter: cameras stand where they were put, hits have no range, misses 0."""
    for seed, scale in ((3, 0.37), (4, 1.0)):
        write_instance(tmp_path, pictured(seed, scale=scale))
    views, x = read_views(tmp_path, SIZE), pictured(3)
    assert views.rgb.shape == (2, 6, SIZE, SIZE, 3) and views.tan_half_fov[0] == pytest.approx(
        ENCODER_RADIUS / DISTANCE
    )
    np.testing.assert_array_equal(views.rgb[0], x.rgb)
    np.testing.assert_array_equal(views.range[0], np.where(x.mask, NO_RANGE, 0.0))
    np.testing.assert_allclose(np.linalg.norm(views.T_object_camera[:, :, :3, 3], axis=-1), DISTANCE, rtol=1e-6)
    np.testing.assert_allclose(views.T_object_camera[0], x.T_cube_camera, atol=1e-6)
    some = read_views(tmp_path, SIZE, 3)
    np.testing.assert_array_equal(some.rgb, views.rgb[:, ::2])
    more = read_views(tmp_path, SIZE, 8)
    np.testing.assert_array_equal(more.rgb, views.rgb[:, [0, 1, 2, 3, 4, 5, 0, 1]])


def test_other_cameras_are_turned_to_the_cube_and_resized(tmp_path: Path) -> None:
    """A large picture, off centre and rolled, shows the same after it was seen anew as a render at the small size."""
    want, size = pictured(3), 9 * SIZE
    roll = look_at(np.array([0.0, 0.0, 1.0]), np.array([0.12, 0.05, 2.0]))[:3, :3]  # a turn of about pi about z, tilted
    T = want.T_cube_camera
    T[:, :3, :3] = T[:, :3, :3] @ roll
    focal, centre = 1.6 * size, (0.47 * size, 0.55 * size)
    shift = np.array([[focal, 0, centre[0] - 0.5], [0, focal, centre[1] - 0.5], [0, 0, 1]])
    large = pictured(3, size=size)
    K = np.array([[large.focal, 0, 0.5 * size - 0.5], [0, large.focal, 0.5 * size - 0.5], [0, 0, 1]])
    H = shift @ roll.T @ np.linalg.inv(K)
    rgb, mask = (
        np.stack([cv2.warpPerspective(a, H, (size, size), borderValue=fill) for a in stack])
        for stack, fill in ((large.rgb, (255, 255, 255)), (large.mask.astype(np.uint8), 0))
    )
    moved = Instance("moved", focal, centre, (0.0, 0.0, 0.0), 2.0, rgb, mask > 0, T)
    write_instance(tmp_path, moved)
    got = read_views(tmp_path, SIZE)
    shown = got.range[0] < 0
    assert np.logical_xor(shown, want.mask).mean() < 0.03
    blocks = np.concatenate([large.rgb * large.mask[..., None], large.mask[..., None]], axis=-1, dtype=float)
    mean = blocks.reshape(-1, SIZE, 9, SIZE, 9, 4).mean(axis=(2, 4))
    whole = shown & (mean[..., 3] > 0.99)
    assert whole.mean() > 0.04 and np.abs(got.rgb[0] - mean[..., :3])[whole].mean() < 2.0
    np.testing.assert_allclose(got.T_object_camera[0], want.T_cube_camera, atol=1e-6)


def test_white_is_background_where_there_is_no_alpha(tmp_path: Path) -> None:
    x = pictured(3)
    folder = write_instance(tmp_path, x)
    for i, path in enumerate(sorted((folder / "rgb").glob("*.png"))):
        cv2.imwrite(str(path), x.rgb[i][..., ::-1])
    y = read_instance(folder)
    np.testing.assert_array_equal(y.rgb, x.rgb)
    np.testing.assert_array_equal(y.mask, x.mask & (x.rgb < 250).any(axis=-1))


def test_inverted_poses_are_understood(tmp_path: Path) -> None:
    x = pictured(3)
    folder = write_instance(tmp_path, replace(x, T_world_camera=np.linalg.inv(x.T_world_camera)))
    with (folder / "intrinsics.txt").open("a") as file:
        file.write("1\n")
    np.testing.assert_allclose(read_instance(folder).T_world_camera, x.T_world_camera, atol=1e-12)


def test_a_data_set_of_others_is_read(shared_data: Path) -> None:
    [folder] = find_instances(shared_data / "srn_layout")
    x = read_instance(folder)
    assert x.rgb.shape == (16, 128, 128, 3) and (x.focal, x.centre, x.scale) == (131.25, (64.0, 64.0), 1.0)
    np.testing.assert_allclose(np.linalg.norm(x.T_world_camera[:, :3, 3], axis=-1), 1.2, atol=1e-5)
    forward = np.einsum("vij,j->vi", x.T_world_camera[:, :3, :3], [0.0, 0.0, 1.2])
    np.testing.assert_allclose(x.T_world_camera[:, :3, 3] + forward, 0.0, atol=1e-5)
    views = read_views(shared_data / "srn_layout", 32)
    assert views.rgb.shape == (1, 16, 32, 32, 3)


def _cut(path: Path, keep: int) -> None:
    path.write_bytes(path.read_bytes()[:keep])


@pytest.mark.parametrize(
    ("name", "content", "error", "said"),
    [
        ("intrinsics.txt", "131.25 64. 64. 0.\n0. 0. 0.\n", ValueError, r"intrinsics\.txt is cut .*line 3 \(scale\)"),
        ("intrinsics.txt", "", ValueError, r"is cut short: line 1 \(f cx cy 0\)"),
        ("intrinsics.txt", "12 8 8 0\n0 0 0\n1\n16\n", ValueError, r"intrinsics\.txt, line 4 holds 1 numbers.*has 2"),
        ("intrinsics.txt", "12 8 x 0\n0 0 0\n1\n16 16\n", ValueError, r"line 1: '12 8 x 0' is not f cx cy 0"),
        ("intrinsics.txt", "12 8 8 0\n0 0 0\n0\n16 16\n", ValueError, r"line 3: scale is 0; it must be positive"),
        ("intrinsics.txt", "12 8 8 0\n0 0 0\n1\n8 8\n", ValueError, r"000000\.png is 16x16 px but .* says 8x8"),
        ("intrinsics.txt", "12 8 8 0\n0 0 0\n1\n16.5 16\n", ValueError, r"line 4: 16.5x16 px are no whole numbers"),
        ("pose/000002.txt", "1 0 0 1e300 0 1 0 0 0 0 1 0 0 0 0 1", ValueError, r"view 2 is 2e\+300 cube units .* pose"),
        ("intrinsics.txt", "12 8 8 0\n0 0 0\n1\n90000 90000\n", ValueError, r"line 4: 90000x90000 px are more than"),
        ("pose/000002.txt", "1 0 0 0 0 1 0 0 0 0 2 0 0 0 0 1", ValueError, r"000002\.txt is no rigid transform"),
        ("pose/000002.txt", "1 0 0 0 0 1 0 0 0 0 -1 0 0 0 0 1", ValueError, r"000002\.txt is no rigid transform"),
        ("pose/000002.txt", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 1 1", ValueError, r"000002\.txt is no rigid transform"),
        ("pose/000002.txt", "1 0 0 0 0 1", ValueError, r"000002\.txt holds 6 numbers.*16"),
        ("pose/000002.txt", "1 0 0 0 0 1 0 0 0 0 1 nan 0 0 0 1", ValueError, r"000002\.txt holds .* not finite"),
        ("pose/000009.txt", "1", ValueError, r"000009\.txt has no rgb/000009\.png"),
        ("rgb/000001.png", "no picture", ValueError, r"000001\.png cannot be read \(it is no PNG"),
    ],
)  # fmt: skip
def test_a_broken_file_is_named(tmp_path: Path, name: str, content: str, error: type[Exception], said: str) -> None:
    folder = write_instance(tmp_path, pictured(3))
    (folder / name).write_text(content)
    with pytest.raises(error, match=said) as caught:
        read_views(tmp_path, SIZE)
    assert "\n" not in str(caught.value)


def test_pictures_that_cannot_be_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere does not exist; give a folder of NAME/intrinsics"):
        read_views(tmp_path / "nowhere", SIZE)
    with pytest.raises(FileNotFoundError, match="holds no views; give a folder of"):
        read_views(tmp_path, SIZE)
    folder = write_instance(tmp_path, pictured(3))
    png = folder / "rgb" / "000000.png"
    whole = png.read_bytes()
    _cut(png, len(whole) // 2)
    with pytest.raises(ValueError, match=r"000000\.png cannot be read \(it is cut short"):
        read_instance(folder)
    cv2.imwrite(str(png), np.zeros((16, 16), np.uint16))
    with pytest.raises(ValueError, match=r"000000\.png is uint16\[16, 16\]; save it as RGB"):
        read_instance(folder)
    png.unlink()
    with pytest.raises(ValueError, match=r"pose/000000\.txt has no rgb/000000\.png"):
        read_instance(folder)
    near = pictured(3)
    near.T_world_camera[:, :3, 3] = near.barycentre
    write_instance(tmp_path / "near", replace(near, centre=(7.0, 8.0)))
    with pytest.raises(ValueError, match=r"view 0 is 0 cube units from the cube's centre"):
        read_views(tmp_path / "near", SIZE)
    write_instance(tmp_path / "white", replace(near, mask=np.zeros_like(near.mask)))
    with pytest.raises(ValueError, match="no picture shows an object"):
        read_views(tmp_path / "white", SIZE)
    for path in (tmp_path / "white").glob("*/pose/*"):
        path.unlink()
    with pytest.raises(FileNotFoundError, match="object_3 holds no views; it needs"):
        read_views(tmp_path / "white", SIZE)


def test_object_rays_are_those_of_the_mask(tmp_path: Path) -> None:
    write_instance(tmp_path, pictured(3))
    views = read_views(tmp_path, SIZE)
    batch = draw_batch(views, strata_of(views), TrainConfig(views=2, object_rays=40), 0, 4)  # more than there are
    ranges = np.asarray(batch.ray_range)
    assert np.all(ranges[:, :40] == NO_RANGE) and np.all(ranges[:, 40:] == 0.0)
    share = np.asarray(batch.ray_weight)[:, :40].sum(axis=1)
    np.testing.assert_allclose(share, (views.range < 0).mean(), rtol=1e-5)


CONFIG = TrainConfig(
    steps=120, solid_steps=0, batch=4, ray_batch=4, views=2, object_rays=24, near_rays=12, far_rays=4, warmup=10,
    effective_rays=300.0, learning_rate=1e-2, ray_learning_rate=1e-2, log_every=1, checkpoint_every=1000,
)  # fmt: skip


@pytest.mark.slow
def test_pictures_alone_teach_shapes(tmp_path: Path) -> None:
    """The paper's way: the loss of a tiny model falls, by rays alone, and both encoder and decoder have moved."""
    for seed in (3, 4, 7):
        write_instance(tmp_path / "data", pictured(seed))
    model = ProbNeRF(PRESETS["tiny"], jax.random.key(0))
    likelihood = Likelihood(lattice=foam.Lattice(8, 1.0))
    views = read_views(tmp_path / "data", SIZE)
    fits, losses, state = [], [], None
    for state, metrics in train(model, None, views, likelihood, CONFIG, tmp_path / "run"):  # noqa: B007
        fits.append(metrics["fit"])
        losses.append(metrics["loss"])
    assert state is not None
    assert np.isfinite(losses).all()
    assert np.mean(fits[-20:]) > np.mean(fits[:10]) + 100.0  # nats per object
    assert np.mean(losses[-20:]) < np.mean(losses[:10]) - 100.0
    for part in ("encoder", "hyper", "flow"):
        before, after = (jax.tree.leaves(getattr(m, part)) for m in (model, state.model))
        assert any(np.any(np.asarray(a) != np.asarray(b)) for a, b in zip(before, after, strict=True))
    with pytest.raises(ValueError, match="solid_steps is 1; it must be 0"):
        next(train(model, None, views, likelihood, replace(CONFIG, solid_steps=1), tmp_path / "other"))
    with pytest.raises(ValueError, match="--views is 7 but objects have 6 pictures"):
        next(train(model, None, views, likelihood, replace(CONFIG, views=7), tmp_path / "other"))
