"""Chains are told apart, and the spread of draws is that of their volumes."""

from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.harness.results import Results
from benchmarks.rivals.methods import VI, settings_of
from benchmarks.studies import chains
from benchmarks.studies.chains import (
    ANNEALED,
    COMPARED,
    CONDITION,
    FIXED,
    SMC,
    Options,
    main,
    relative_spread,
    unexplained,
)
from perception.inference.settings import ControllerConfig
from probnerf.prior.checkpoint import load_prior


def test_spread_is_the_weighted_deviation_over_the_mean() -> None:
    assert relative_spread(np.full(5, 3.0), np.ones(5)) == 0.0
    assert relative_spread(np.zeros(5), np.ones(5)) == 0.0
    assert relative_spread(np.array([1.0, 3.0]), np.ones(2)) == pytest.approx(0.5)
    assert relative_spread(np.array([1.0, 3.0]), np.array([1.0, 0.0])) == 0.0


def test_a_chain_counts_by_its_own_samples_and_their_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chains, "without_sizes", lambda likelihood: likelihood)
    monkeypatch.setattr(chains, "explained", lambda *_: jnp.array([1.0, 0.5, 0.8, 0.9, 0.5, 0.7]))
    posterior = SimpleNamespace(
        positions=None,
        log_weights=jnp.log(jnp.array([0.3, 0.1, 0.6, 1e-9, 0.0, 0.0])),
        population=jnp.array([0, 0, 2, 2, 3, 3]),  # the last one failed
    )
    sampled = SimpleNamespace(posterior=posterior, likelihood=None, observation=None)
    question = SimpleNamespace(prior=SimpleNamespace(model=None))
    np.testing.assert_allclose(unexplained(question, sampled), [0.125, 0.2, 0.4], atol=1e-6)


def test_the_file_is_summed_up(tmp_path: Path) -> None:
    """A stuck chain and draws that agree show in the rows."""
    prior, config = load_prior().identity, ControllerConfig()
    told = zip(COMPARED, ([0.02, 0.02], [0.02, 0.04], [0.02, 0.6], [0.02]), (0.3, 0.3, 0.5, 0.1), strict=True)
    results = Results(tmp_path / "chains.jsonl")
    for method, missed, spread in told:
        for view in (1, 2):
            line = {"prior": prior, "condition": CONDITION, "object": view, "seed": 0, "method": method.name}
            found = {"unexplained": missed, "volume_sd": spread, "rounding": 0.001 * view}
            results.add({**line, "settings": settings_of(method, config), **found})
    with pytest.raises(ValueError, match="omit --only-chart"):
        main(Options(tmp_path, results=tmp_path / "none.jsonl", only_chart=True))
    summary = main(Options(tmp_path, n=2, results=results.path, only_chart=True))
    value = {(r.method, r.metric): r.value for r in summary.rows}
    assert value[FIXED.name, "unexplained_worst"] == 0.6 and value[ANNEALED.name, "unexplained_worst"] == 0.04
    assert value[FIXED.name, "unexplained_sd"] == pytest.approx(0.29)
    assert value[VI.name, "volume_sd_above_smc"] == pytest.approx(-0.2)
    assert value[SMC.name, "rounding"] == pytest.approx(0.0015)
    assert summary.picture().axes


@pytest.mark.slow
def test_rounding_says_nothing_of_a_view(tmp_path: Path) -> None:
    value = {r.metric: r.value for r in main(Options(tmp_path, quick=True)).rows}
    assert value["rounding"] < 0.05  # nats, of differences that decide from a tenth on
    assert value["unexplained_worst"] < 0.1
    kept = (tmp_path / "chains.jsonl").read_text()
    main(Options(tmp_path, quick=True))
    assert (tmp_path / "chains.jsonl").read_text() == kept  # not made again
