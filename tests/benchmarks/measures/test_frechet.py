"""The Fréchet distance of features: of the same set, of two Gaussians in closed form, and its bias with n."""

import numpy as np
import pytest

from benchmarks.measures.frechet import frechet_distance


def test_of_the_same_set_it_is_zero_and_it_is_symmetric() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(60, 7)), 2.0 + rng.normal(size=(90, 7)) @ rng.normal(size=(7, 7))
    assert frechet_distance(a, a) == pytest.approx(0.0, abs=1e-9)
    assert frechet_distance(a, b) > 1.0 and frechet_distance(a, b) == pytest.approx(frechet_distance(b, a), rel=1e-9)
    turn, _ = np.linalg.qr(rng.normal(size=(7, 7)))
    assert frechet_distance(a @ turn, b @ turn) == pytest.approx(frechet_distance(a, b), rel=1e-6)


def test_of_two_gaussians_it_is_the_closed_form() -> None:
    """Diagonal covariances: sum (mu - nu)^2 + (s - t)^2."""
    rng = np.random.default_rng(1)
    noise = rng.normal(size=(4000, 3))
    noise = (noise - noise.mean(axis=0)) @ np.linalg.inv(np.linalg.cholesky(np.cov(noise, rowvar=False)).T)
    mu, nu, s, t = np.array([[0.0, 1.0, 2.0], [1.0, 1.0, -1.0], [1.0, 2.0, 0.5], [3.0, 2.0, 0.1]])
    expected = np.sum((mu - nu) ** 2 + (s - t) ** 2)
    assert frechet_distance(mu + s * noise, nu + t * noise) == pytest.approx(expected, rel=1e-9)
    one = frechet_distance(noise[:, :1], 3.0 + noise[:, :1])
    assert one == pytest.approx(9.0)


def test_a_set_in_a_plane_has_a_distance() -> None:
    rng = np.random.default_rng(2)
    flat = rng.normal(size=(20, 2)) @ rng.normal(size=(2, 12))  # fewer directions than features
    assert np.isfinite(frechet_distance(flat, flat + 1.0)) and frechet_distance(flat, flat + 1.0) == pytest.approx(12.0)


def test_sets_of_one_distribution_are_apart_by_about_a_constant_over_n() -> None:
    rng = np.random.default_rng(3)
    apart = {n: np.mean([frechet_distance(*rng.normal(size=(2, n, 8))) for _ in range(40)]) for n in (50, 200)}
    assert apart[200] > 0.0 and 3.0 < apart[50] / apart[200] < 6.0


def test_one_picture_has_no_covariance() -> None:
    with pytest.raises(ValueError, match="2 pictures or more"):
        frechet_distance(np.zeros((1, 3)), np.zeros((5, 3)))
