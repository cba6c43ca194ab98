"""The deviations are those of leaving out one group at a time, and never less than independent errors'."""

import numpy as np

from calibration.deviations import covariance

RNG = np.random.default_rng(0)


def test_it_is_the_jackknife() -> None:
    """Of a linear problem the first order is exact: refits without each group give the same."""
    groups = [RNG.normal(size=(6, 3)) for _ in range(9)]
    y = [g @ [1.0, 2.0, 3.0] + 5.0 * RNG.normal() + 0.01 * RNG.normal(size=6) for g in groups]
    whole = np.linalg.lstsq(np.concatenate(groups), np.concatenate(y), rcond=None)[0]
    residuals = [b - g @ whole for g, b in zip(groups, y, strict=True)]
    refits = []
    for left in range(9):
        rest = [i for i in range(9) if i != left]
        A, b = (np.concatenate([part[i] for i in rest]) for part in (groups, y))
        refits.append(np.linalg.lstsq(A, b, rcond=None)[0] - whole)
    expected = 8 / 9 * np.einsum("gi,gj->ij", refits, refits)
    found = covariance(groups, residuals, np.ones(3), np.zeros((0, 3)), 1e-6)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_it_is_no_less_than_independent_errors_give() -> None:
    groups = [RNG.normal(size=(6, 3)) for _ in range(9)]
    A = np.concatenate(groups)
    found = covariance(groups, [np.zeros(6)] * 9, np.ones(3), np.zeros((0, 3)), 0.1)
    np.testing.assert_allclose(np.diag(found), 0.01 * np.diag(np.linalg.inv(A.T @ A)))


def test_what_is_not_determined_is_very_uncertain() -> None:
    groups = [RNG.normal(size=(6, 3)) * [1, 1, 0] for _ in range(9)]
    std = np.sqrt(np.diag(covariance(groups, [RNG.normal(size=6) for _ in groups], np.ones(3), np.zeros((0, 3)), 1.0)))
    assert std[2] > 1e9 and std[:2].max() < 1
    # A prior determines it.
    prior = np.array([[0.0, 0.0, 2.0]])
    std = np.sqrt(np.diag(covariance(groups, [np.zeros(6)] * 9, np.ones(3), prior, 1.0)))
    np.testing.assert_allclose(std[2], 0.5, rtol=1e-6)
