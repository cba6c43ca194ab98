"""Verdicts on the paper's claims: from rows, by their intervals, and never where nothing was measured."""

import pytest

from benchmarks.harness.intervals import PairedInterval, paired_interval
from benchmarks.harness.results import Line
from benchmarks.measures.renderer_acceptance import QUADRATURE
from benchmarks.paper.annealing import ANNEALING
from benchmarks.paper.claims import BACK, CAVEAT, FUNCTA, NOT, REPRODUCED, UNMEASURED, claims, paired, tables, verdict
from benchmarks.paper.decoders import COST, DECODER
from benchmarks.paper.methods import FIXED, HMC, HMC_DELTA, SHORT, VI
from benchmarks.paper.prior_samples import COUNTS, IN_INCEPTION, condition_of
from benchmarks.paper.renderers import RENDERERS
from benchmarks.paper.rival_answers import TRAINING


def answers(method: str, metric: str, values: list[float], condition: str = BACK) -> list[Line]:
    return [
        {"method": method, "condition": condition, "object": i, metric: v, "settings": {}} for i, v in enumerate(values)
    ]


def of(lines: list[Line], words: str) -> str:
    (found,) = [claim.verdict for claim in claims(lines) if words in claim.text]
    return found


@pytest.mark.parametrize(
    ("values", "least", "expected"),
    [
        ([1.0, 1.1, 0.9], 0.0, REPRODUCED),
        ([-1.0, -1.1, -0.9], 0.0, NOT),
        ([1.0, -1.1, 0.2], 0.0, f"{CAVEAT}: the interval holds 0"),
        ([-0.1, -0.1, -0.11], -0.5, REPRODUCED),
        ([4.0], 0.0, f"{CAVEAT}: one object"),
        ([], 0.0, UNMEASURED),
    ],
)
def test_a_verdict_is_where_the_interval_lies(values: list[float], least: float, expected: str) -> None:
    assert verdict(paired_interval(values, [0.0] * len(values)), least) == expected


def test_differences_are_paired_over_objects_that_both_answered() -> None:
    lines = answers("a", "psnr_given", [3.0, 5.0, 9.0]) + answers("b", "psnr_given", [1.0, 2.0])
    found = paired(lines, BACK, "psnr_given", "a", "b")
    assert (found.mean, found.n) == (2.5, 2)
    assert isinstance(found, PairedInterval) and paired(lines, "elsewhere", "psnr_given", "a", "b").n == 0


def test_nothing_measured_says_so() -> None:
    assert {claim.verdict.split(":")[0] for claim in claims([])} == {UNMEASURED}


def test_each_claim_follows_its_rows() -> None:
    up, down = [20.0, 21.0, 22.0], [18.0, 19.1, 20.0]
    delta = "delta raises the given view's quality (cars, back)"
    lines = answers(HMC_DELTA.name, "psnr_given", up) + answers(HMC.name, "psnr_given", down)
    assert of(lines, delta) == REPRODUCED
    lines = answers(HMC_DELTA.name, "psnr_given", down) + answers(HMC.name, "psnr_given", up)
    assert of(lines, delta) == NOT
    lines = answers(HMC_DELTA.name, "psnr_heldout", down) + answers(HMC.name, "psnr_heldout", up)
    assert of(lines, "delta does no harm to held-out") == f"{NOT}: perhaps as its kept states are still tempered"
    lines += answers(HMC_DELTA.name, "psnr_heldout_of_mean", up) + answers(HMC.name, "psnr_heldout_of_mean", up)
    (ours,) = [claim.ours for claim in claims(lines) if "no harm to held-out" in claim.text]
    assert ours.startswith("-2.0 (") and ours.endswith("n 3; the mean picture's +0.0 (+0.0 to +0.0) dB")
    lines = answers(HMC_DELTA.name, "psnr_given", up) + answers(FUNCTA, "psnr_given", down)
    assert of(lines, "Functa's MAP on the given view (cars, back)").startswith(CAVEAT)  # a smaller model
    ill = answers(FUNCTA, "psnr_given_learnt", [17.04], f"cars, {TRAINING}")
    assert of(lines + ill, "Functa's MAP on the given view (cars, back)").startswith(f"{UNMEASURED}: Functa is not")
    assert "17.0 dB" in of(lines + ill, "Functa's MAP on the given view (cars, back)")
    lines = answers(HMC.name, "pixel_sd", [0.5, 0.6]) + answers(VI.name, "pixel_sd", [0.1, 0.2])
    assert "tempered" in of(lines, "hmc is more diverse than vi on held-out views (cars, back)")

    chains = [20.0, 19.0, 18.0, 18.0, 17.0, 17.0, 17.0, 16.5]
    spread = [{**x, "chains": chains} for x in answers(FIXED.name, "x", [0, 0, 0], ANNEALING)]
    close = [{**x, "chains": [21.0 + 0.1 * x["object"]] * 8} for x in answers(HMC.name, "x", [0, 0, 0], ANNEALING)]

    def accepting(lines: list[Line], share: float) -> list[Line]:
        return [{**line, "acceptance": share} for line in lines]

    one, lines = "than one temperature", accepting(close, 0.8) + accepting(spread, 0.75)
    assert of(lines, f"{one}: the worst") == of(lines, f"{one}: its spread") == REPRODUCED
    assert of(lines, f"{one} with a tuned step: the worst") == UNMEASURED
    lines = accepting(close, 0.7) + accepting(spread, 0.98)  # its chains went nowhere: no equal start
    assert of(lines, f"{one}: the worst") == f"{CAVEAT}: its step is small: acceptance 0.98, annealed 0.70"

    for low, expected in ((0.1, f"{CAVEAT}: 32 pixels"), (0.5, f"{CAVEAT}: neither"), (0.9, f"{NOT}: 32 pixels")):
        found = answers(QUADRATURE, "x", [0.0], f"cars, {RENDERERS}")
        lines = [{**x, "settings": {"steps": [0.1, 0.001]}, "acceptance": [0.0, low]} for x in found]
        assert of(lines, "quadrature's acceptance").startswith(expected)
        assert of(lines, "quadrature's acceptance").endswith(", one draw of the prior")

    condition = condition_of("cars", max(COUNTS))
    lines = answers("ProbNeRF", "distance", [3.0], condition) + answers(FUNCTA, "distance", [5.0], condition)
    assert of(lines, "prior samples of ProbNeRF are nearer than Functa's").startswith(CAVEAT)
    lines = answers("ProbNeRF", "distance", [6.0], condition) + answers(FUNCTA, "distance", [5.0], condition)
    assert of(lines, "prior samples of ProbNeRF are nearer than Functa's").startswith(NOT)

    lines += answers(f"ProbNeRF{IN_INCEPTION}", "distance", [80.0], condition)
    lines += answers(f"{FUNCTA}{IN_INCEPTION}", "distance", [150.0], condition)
    assert "other features" not in of(lines, "prior samples of ProbNeRF are nearer than Functa's")

    lines = answers(f"NeRF-VAE, own sizes{DECODER}", "ratio", [9.0, 9.1], f"cars, {COST}")
    assert of(lines, "a picture is cheaper").startswith(CAVEAT)
    lines = answers(f"NeRF-VAE, own sizes{DECODER}", "ratio", [0.5, 0.51], f"cars, {COST}")
    assert of(lines, "a picture is cheaper") == NOT
    lines = answers(f"ProbNeRF{DECODER}", "operations", [20_000], f"cars, {COST}")
    assert of(lines, "an evaluation of its field").startswith(CAVEAT)


def test_published_results_are_said_to_be_of_other_data() -> None:
    first, second = tables([], SHORT)
    assert "40 x 25" in first.title and "not comparable" in second.title
    assert ["pixelNeRF", "23.2", "", ""] in [list(line) for line in second.lines]
