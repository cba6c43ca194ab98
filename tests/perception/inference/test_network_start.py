"""Inference of a frame with a posterior network: its draws are published at once, and sampling begins there."""

import gc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from perception.answers.hypotheses import Hypotheses
from perception.inference.controller import Estimate, estimate
from perception.inference.limits import NO_LIMITS
from perception.inference.publish import HEDGE, ConditionedView
from perception.inference.settings import ControllerConfig
from perception.inference.tracker import Tracker
from perception.inference.view_sampler import ViewSampler
from perception.inference.warm_up import warm_up
from perception.observation.object_frame import ObjectFrame
from perception.observation.segmentation import segment
from perception.sources.frame import Frame
from probnerf import compile_cache
from probnerf.prior.checkpoint import Prior
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.settings import InferConfig, NetworkConfig, quick_smc
from tests.node.mugs import MUG
from tests.perception.inference.test_tracker import frame_from
from tests.probnerf.prior.small_networks import SIZES, shaken

TINY = PRESETS["tiny"]
CONFIG = ControllerConfig(
    infer=InferConfig(lattice=8, smc_from_network=quick_smc(2, 8), network=NetworkConfig(guess=32, chunk=64, most=128)),
    hypotheses=8,
    first_hypotheses=8,
    grid=16,
    runs=1,
)


@pytest.fixture(scope="module")
def prior() -> Prior:
    return Prior(ProbNeRF(TINY, jax.random.key(0)), {}, "x", shaken(replace(SIZES, latent=TINY.latent)), "n")


@pytest.fixture(autouse=True)
def no_encoder(monkeypatch: pytest.MonkeyPatch) -> None:
    def asked(_: ViewSampler) -> None:
        raise AssertionError("nothing may climb, whatever is seen")

    monkeypatch.setattr(ViewSampler, "climb", asked)


def inferred(
    frame: Frame, prior: Prior, config: ControllerConfig, known: ObjectFrame | None = None
) -> tuple[Estimate, list[Hypotheses]]:
    answers = list[Hypotheses]()
    found = estimate(
        frame, segment(frame)[0], prior, config, seed=1, stages=2, known=known, on_answer=answers.append
    )  # fmt: skip
    return found, answers


@pytest.mark.slow
def test_the_guess_is_the_first_answer_and_tempering_begins_at_the_network(prior: Prior) -> None:
    found, answers = inferred(frame_from(0.0), prior, CONFIG)
    guess = answers[0]
    assert guess.stage == 0 and guess.result == "underway" and guess.diagnostics.beta == 0.0
    np.testing.assert_allclose(guess.weights, 1 / 8)
    assert len(np.unique(guess.population)) == 8 and np.isfinite(guess.diagnostics.expected_loss)
    assert np.isnan(guess.diagnostics.log_evidence) and guess.prior_hash == "x+n"
    assert found.start == "the network's draws" and found.log[0].startswith("64 draws of the network: ESS ")
    assert found.log[0].endswith("-> tempering from there") and found.hypotheses.stage > 0
    assert "network" in found.parts and len(np.unique(found.posterior.population)) == 2
    unexplained = 1.0 - found.hypotheses.diagnostics.explained  # the model knows no object
    assert HEDGE * unexplained > 1.0 and len(found.hypotheses.weights) == 8
    two, draws, smooth = np.split(found.hypotheses.weights, [2, 5])  # a shape of each population, and what is mixed in
    np.testing.assert_allclose(smooth, unexplained / 3)
    np.testing.assert_allclose(draws, (1.0 - unexplained) * (1.0 - 1.0 / 5) / 3)
    np.testing.assert_allclose(two.sum(), (1.0 - unexplained) / 5)
    # what goes on from there does not begin at the network, and keeps what it says
    h = found.hypotheses
    view = ConditionedView(frame_from(0.0), segment(frame_from(0.0))[0], (found.observation,), h.object_frame, h.seen)
    goes_on = ViewSampler(view, prior, CONFIG.infer, 1, NO_LIMITS, before=found.posterior)
    assert goes_on.kinds == h.kinds != {} and not goes_on.asks_network
    assert goes_on.start == "the samples of an earlier run"


def _without_depth(frame: Frame) -> Frame:
    return replace(frame, depth=None)


@pytest.mark.slow
@pytest.mark.parametrize("change", [None, _without_depth])
@pytest.mark.parametrize("pose_known", [False, True])
def test_it_begins_there_with_and_without_depth_and_with_a_known_pose(
    prior: Prior, change: Callable[[Frame], Frame] | None, pose_known: bool
) -> None:
    frame = frame_from(0.0)
    assert frame.T_world_camera is not None
    T_camera_object = np.linalg.inv(frame.T_world_camera) @ MUG.T_world_object
    plane = segment(frame)[0].plane
    known = ObjectFrame(T_camera_object, MUG.half_extent, plane, 0.0, 0.0) if pose_known else None
    found, answers = inferred(frame if change is None else change(frame), prior, CONFIG, known)
    assert found.start == "the network's draws" and answers[0].stage == 0 and len(answers) > 1


@pytest.mark.slow
def test_weights_that_suffice_end_it(prior: Prior) -> None:
    """A likelihood of next to no power makes the mixture's weights those of the prior over it, which are good."""
    infer = replace(
        CONFIG.infer, power=1e-6, network=replace(CONFIG.infer.network, prior_share=0.9, chunk=1_024, most=2_048)
    )
    found, answers = inferred(frame_from(0.0), prior, replace(CONFIG, infer=infer))
    assert found.log[0].endswith("no tempering is needed") and len(found.log) == 1
    h = found.hypotheses
    assert h is answers[-1] and len(answers) == 2 and h.stage == 0 and h.result == "converged"
    assert h.diagnostics.ess >= 200.0 and h.diagnostics.beta == 1.0 and np.isfinite(h.diagnostics.log_evidence)
    assert len(np.unique(h.population)) == 8 and h.failed == 0


@pytest.mark.slow
def test_a_rehearsal_leaves_nothing_to_compile_for_the_first_frame(
    prior: Prior, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its zeros are no good weights: tempering is rehearsed, too."""
    monkeypatch.setattr(compile_cache, "_folder", lambda: tmp_path)
    try:
        warm_up(Tracker(prior, CONFIG))
    finally:
        gc.unfreeze()
    kept = {path.name for path in tmp_path.iterdir()}
    assert {"_features", "_drawn", "_chunk", "_stage"} <= {name.rsplit("-", 1)[0] for name in kept}
    frame = frame_from(0.0)
    update = Tracker(prior, CONFIG).update(frame, segment(frame)[0], stages=2, on_answer=lambda _: None)
    assert update.hypotheses.stage > 0 and {path.name for path in tmp_path.iterdir()} == kept


@pytest.mark.slow
def test_without_its_network_a_prior_is_used_as_before(prior: Prior) -> None:
    """Switched off is as if the file were not there, bit for bit."""
    infer = replace(CONFIG.infer, smc_from_prior=quick_smc(2, 8), encoder_starts=False)
    off = replace(CONFIG, infer=replace(infer, network_starts=False))
    alone = replace(prior, network=None)
    one, _ = inferred(frame_from(0.0), prior, off)
    other, _ = inferred(frame_from(0.0), alone, replace(CONFIG, infer=infer))
    assert one.start == other.start == "the prior"
    np.testing.assert_array_equal(one.hypotheses.opacity, other.hypotheses.opacity)
