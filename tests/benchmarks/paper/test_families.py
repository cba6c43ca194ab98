"""The paper's families: closed solids in their frame, pictures that agree with them, and SRN folders that read back."""

import io
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from benchmarks.paper.bodies import draw_person
from benchmarks.paper.body_template import BONES, load_template, read_assets
from benchmarks.paper.cars import STYLES, draw_car
from benchmarks.paper.families import (
    BODIES,
    CARS,
    FAMILIES,
    SPLITS,
    Family,
    Options,
    main,
    render,
    shape_set,
    view_set,
    write_srn,
)
from node.commands.train import train
from node.commands.training_options import Training
from probnerf.geometry import pinhole_rays
from probnerf.prior.checkpoint import load_prior
from probnerf.training.settings import TrainConfig
from probnerf.training.shape_set import in_cube
from probnerf.training.srn_dataset import read_instance
from probnerf.types import BASE_Z, BODY_EXTENT


def _car(style: str):
    return next(car for car in map(draw_car, range(400)) if car.style == style)


@pytest.mark.parametrize("style", STYLES)
def test_a_car_is_one_closed_solid_on_its_wheels(style: str) -> None:
    car = _car(style)
    assert len(car.solid.decompose()) == 1 and car.solid.volume() > 2.0
    vertices = car.mesh.vertices
    assert vertices[:, 2].min() == pytest.approx(BASE_Z, abs=1e-3)
    assert np.ptp(vertices[:, 0]) == pytest.approx(BODY_EXTENT, rel=0.06)  # a wing may reach behind the body
    assert np.abs(vertices[:, 1].max() + vertices[:, 1].min()) < 1e-3  # mirrored in y
    for axle in car.axles:  # nothing else touches the road there
        low = vertices[vertices[:, 2] < BASE_Z + 0.01, 0] * car.half_extent
        assert np.abs(low - axle).min() < car.wheel


def test_a_seed_gives_the_same_car_and_seeds_differ() -> None:
    a, b, other = draw_car(7), draw_car(7), draw_car(8)
    np.testing.assert_array_equal(a.mesh.vertices, b.mesh.vertices)
    assert a.length != other.length


def test_headlamps_are_ahead_and_tail_lamps_behind() -> None:
    car = _car("saloon")
    seen = [render(car, CARS.camera(azimuth, 5.0)[None], 64).rgb[0] for azimuth in (0.0, 180.0)]
    red = [np.count_nonzero((p[..., 0] > 80) & (p[..., 1] < 30) & (p[..., 2] < 30)) for p in seen]
    paint_is_red = car.paint[0] > 0.5 and car.paint[1:].max() < 0.2
    assert not paint_is_red and red[1] > 4 and red[0] == 0


@pytest.mark.parametrize("family", FAMILIES.values(), ids=lambda f: f.name)
def test_pictures_agree_with_the_solid(family: Family) -> None:
    subject = family.draw(3)
    T = family.cameras(3, 2)
    seen = render(subject, T, 24)
    for v in range(2):
        origins, directions = (np.asarray(a, float) for a in pinhole_rays(T[v], 12.0 / (64.0 / 131.25), 24))
        t = np.linspace(0.3, 3.2, 400)
        points = (origins[:, None] + t[:, None] * directions[:, None]).reshape(-1, 3)
        # the solid thickens what is thinner than a voxel, so that it may only be hit too early or too much
        inside = (subject.mesh.signed_distance(points) < 0).reshape(len(origins), -1)
        mask, first = seen.mask[v].ravel(), seen.range[v].ravel()
        assert np.mean(inside.any(axis=1) | ~mask) > 0.99
        both = mask & inside.any(axis=1)
        late = t[np.argmax(inside, axis=1)][both] - first[both]
        assert np.mean(late < 0.02) > 0.97 and np.abs(np.median(late)) < 0.02


def test_shapes_to_learn_from_are_inside_where_the_solid_is() -> None:
    shapes = shape_set(CARS, [1, 2])
    for row, seed in enumerate([1, 2]):
        points = in_cube(shapes.points[row])[:300]
        distance = draw_car(seed).mesh.signed_distance(points)
        sure = np.abs(distance) > 1e-3
        np.testing.assert_array_equal(shapes.inside[row][:300][sure], distance[sure] < 0)
    assert shapes.appearance.any() and len(shapes) == 2


def test_srn_folders_read_back(tmp_path: Path) -> None:
    read = read_instance(write_srn(CARS, 5, tmp_path / "cars_train", views=3, size=32))
    views = view_set(CARS, [5], 3, 32)
    np.testing.assert_array_equal(read.mask, views.range[0] > 0)
    np.testing.assert_array_equal(read.rgb, views.rgb[0])
    about = read.T_cube_camera
    about[:, :3, 3] += CARS.middle
    np.testing.assert_allclose(about, views.T_object_camera[0], atol=1e-6)


@pytest.mark.nightly
def test_a_folder_of_a_family_is_completed_and_trains(tmp_path: Path) -> None:
    """The command of the paper's own experiment, on a small folder in the layout of SRN Cars."""
    options = Options(tmp_path / "cars_train", count=2, views=3, size=32)
    main(options)
    (first, second) = sorted(options.out.iterdir())
    before = (first / "rgb" / "000000.png").stat().st_mtime_ns
    (second / "pose" / "000002.txt").unlink()
    main(options)
    assert (second / "pose" / "000002.txt").is_file()
    assert (first / "rgb" / "000000.png").stat().st_mtime_ns == before
    recipe = TrainConfig(steps=2, ray_batch=2, views=2, object_rays=8, near_rays=4, far_rays=4)
    console = Console(file=io.StringIO())
    training = Training(out=tmp_path / "run", preset="tiny", data=options.out, recipe=recipe)
    assert train(training, console, console)
    assert load_prior(tmp_path / "run" / "prior.safetensors").model.preset.name == "tiny"


def test_splits_share_no_seed() -> None:
    seeds = list(SPLITS.values())
    assert all(set(a).isdisjoint(b) for i, a in enumerate(seeds) for b in seeds[:i])


def test_a_turned_bone_keeps_its_length() -> None:
    rest, person = load_template(), draw_person(11)
    still = type(person)(**{**person.__dict__, "turns": {}})
    for bone in ("LeftForeArm", "RightLeg", "Head", "LeftUpLeg"):
        (own,) = np.nonzero(rest.weights[:, rest[bone]] > 0.999)
        a, b = person.posed[own[::7]], still.posed[own[::7]]
        spans = [np.linalg.norm(p[:, None] - p[None], axis=-1) for p in (a, b)]
        np.testing.assert_allclose(spans[0], spans[1], atol=2e-5)
        assert np.abs(a - a.mean(0) - (b - b.mean(0))).max() > 1e-3  # and is turned


def test_a_person_stands_and_faces_ahead() -> None:
    person = draw_person(4)
    still = type(person)(**{**person.__dict__, "turns": {}})
    rest = load_template()
    assert still.posed[:, 2].min() == pytest.approx(BASE_Z)
    assert np.ptp(still.posed[:, 2]) == pytest.approx(BODY_EXTENT, abs=1e-6)
    toes = np.argmax(rest.weights[:, rest["LeftToeBase"]]), np.argmax(rest.weights[:, rest["LeftFoot"]])
    assert still.posed[toes[0], 0] > still.posed[toes[1], 0]  # toes ahead of the ankle
    assert still.posed[toes[0], 1] > 0  # the left foot to the left
    seen = render(still, BODIES.camera(0.0, 0.0)[None], 48)
    assert 0.03 < seen.mask.mean() < 0.4


def test_the_template_is_that_of_the_assets(shared_data: Path) -> None:
    made, kept = read_assets(shared_data / "meshes" / "human_cc0"), load_template()
    np.testing.assert_allclose(kept.vertices, made.vertices, atol=5e-4)
    np.testing.assert_array_equal(kept.faces, made.faces)
    lost = 1.0 - np.sort(made.weights, axis=1)[:, -BONES:].sum(axis=1)
    assert kept.names == made.names and lost.max() < 0.02
