"""What the paper claims, its number beside ours, and whether ours says the same. Verdicts are computed from rows.

The paper gives numbers for prior samples alone; its other claims are curves and bars, so that their numbers here are
words. A claim is *reproduced* where the 95% interval of its paired difference lies on the claim's side, *not
reproduced* where it lies on the other side, and comes *with a caveat* where it holds both, or where one object, a
ratio without an interval, or smaller models say it. Beside a rival that is not healthy alone nothing is claimed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.harness.intervals import PairedInterval, paired_interval
from benchmarks.harness.results import Line
from benchmarks.harness.tables import Table, ranged
from benchmarks.measures.renderer_acceptance import FOAM, QUADRATURE
from benchmarks.paper.annealing import by_chain
from benchmarks.paper.conditioned import PLACES
from benchmarks.paper.decoders import COST, DECODER
from benchmarks.paper.methods import ENCODER, FIXED, HMC, HMC_DELTA, VI, VI_DELTA, Effort
from benchmarks.paper.prior_samples import COUNTS, IN_INCEPTION, OTHERS, PAPER, condition_of, sampled
from benchmarks.paper.renderers import by_step
from benchmarks.paper.rival_answers import unhealthy
from benchmarks.rivals.registry import RIVALS

REPRODUCED, NOT, CAVEAT, UNMEASURED = "reproduced", "not reproduced", "with a caveat", "not measured"
BACK, TELLING = (f"cars, {place.name}" for place in PLACES["cars"])
FUNCTA = RIVALS["functa"].label
NO_WORSE = -0.5  # dB that count as no negative effect
HIGH, LOW = 0.65, 0.3  # acceptance that is high, and that is low
PUBLISHED = (  # psnr of one view of SRN Cars, dB, from the papers themselves
    ("pixelNeRF", "23.2"), ("CodeNeRF", "22.7 to 23.8"), ("VisionNeRF", "22.9"), ("SSDNeRF", "23.5"),
    ("Splatter Image", "24.0"),
)  # fmt: skip


@dataclass(frozen=True)
class Claim:
    """One line of the table."""

    text: str
    paper: str
    ours: str
    verdict: str


def paired(lines: Sequence[Line], condition: str, metric: str, method: str, other: str) -> PairedInterval:
    """Of the difference method - other over the objects that both answered."""
    a, b = (
        {x["object"]: x[metric] for x in lines if x["condition"] == condition and x["method"] == m and metric in x}
        for m in (method, other)
    )
    both = [thing for thing in a if thing in b]
    return paired_interval([a[thing] for thing in both], [b[thing] for thing in both])


def verdict(i: PairedInterval, least: float = 0.0) -> str:
    """Whether a difference is said to lie above `least`."""
    if i.n == 0:
        return UNMEASURED
    if i.low > least:
        return REPRODUCED
    if i.high < least:
        return NOT
    return f"{CAVEAT}: {'one object' if i.n == 1 else f'the interval holds {least:g}'}"


def _difference(
    text: str, said: str, i: PairedInterval, unit: str, digits: int, least: float = 0.0, also: str = ""
) -> Claim:
    ours = "" if i.n == 0 else f"{i.mean:+.{digits}f}{unit}, n 1" if i.n == 1 else f"{ranged(i, digits, '+')}{unit}"
    ours += f", n {i.n}" if i.n > 1 else ""
    found = verdict(i, least)
    return Claim(text, said, ours, f"{CAVEAT}: {also}" if also and found == REPRODUCED else found)


def claims(lines: Sequence[Line]) -> list[Claim]:
    """All of the paper's, in its order."""
    found = []
    smaller = "Functa is smaller and learnt for minutes"
    for condition in (BACK, TELLING):
        for a, b in ((HMC, VI), (HMC_DELTA, VI_DELTA)):
            text = f"{a.name} is more diverse than {b.name} on held-out views ({condition}): pixel sd"
            also = "its kept states are still tempered"
            i = paired(lines, condition, "pixel_sd", a.name, b.name)
            found.append(_difference(text, "higher", i, "", 3, also=also))
    for condition in (BACK, TELLING):
        for metric, words in (("psnr_given", "the given view"), ("psnr_heldout", "held-out views")):
            i = paired(lines, condition, metric, HMC.name, FUNCTA)
            text = f"hmc is more accurate than Functa's MAP on {words} ({condition})"
            found.append(_difference(text, "higher", i, " dB", 1, also=smaller))
    found += _samples(lines)
    if FUNCTA in (ill := unhealthy(lines)):  # it would be a straw man
        words = f"{UNMEASURED}: {FUNCTA} is not healthy alone ({ill[FUNCTA]:.1f} dB of its own training set)"
        found = [replace(claim, verdict=words) if FUNCTA in claim.text else claim for claim in found]
    found += _renderers(lines)
    found += _annealing(lines)
    for condition in (BACK, TELLING):
        i = paired(lines, condition, "psnr_given", HMC_DELTA.name, HMC.name)
        found.append(_difference(f"delta raises the given view's quality ({condition})", "higher", i, " dB", 1))
    i = paired(lines, BACK, "psnr_heldout", HMC_DELTA.name, HMC.name)
    found.append(_difference("delta does no harm to held-out views (uninformative)", "no worse", i, " dB", 1, NO_WORSE))
    i = paired(lines, TELLING, "psnr_heldout", HMC_DELTA.name, HMC.name)
    found.append(_difference("delta improves held-out views (informative)", "higher", i, " dB", 1))
    for condition in (BACK, TELLING):
        i = paired(lines, condition, "psnr_given", HMC.name, ENCODER.name)
        text = f"the encoder alone fails to reconstruct new objects ({condition}): hmc above it"
        found.append(_difference(text, "poor", i, " dB", 1))
    return [*found, *_cost(lines)]


def _samples(lines: Sequence[Line]) -> list[Claim]:
    measured = {x["condition"] for x in lines}
    condition = next((c for n in sorted(COUNTS, reverse=True) if (c := condition_of("cars", n)) in measured), "")
    own = [x for x in lines if x["condition"] == condition]
    inception = any(x["method"].endswith(IN_INCEPTION) for x in own)
    value = {sampled(x["method"]): x["distance"] for x in own if x["method"].endswith(IN_INCEPTION) == inception}
    floor = value.get(OTHERS, float("nan"))
    found = []
    pairs = (("ProbNeRF", FUNCTA), ("Functa, diffusion", "ProbNeRF"), ("pi-GAN", "ProbNeRF"), ("pi-GAN", FUNCTA))
    for better, worse in pairs:
        text, said = f"prior samples of {better} are nearer than {worse}'s", f"{PAPER[better]:g} < {PAPER[worse]:g}"
        if better not in value or worse not in value:
            found.append(Claim(text, said, "", UNMEASURED))
            continue
        a, b = value[better], value[worse]
        ours = f"{a:.2f}, {b:.2f} (true pictures: {floor:.2f})"
        right = f"{CAVEAT}: {'' if inception else 'other features, '}smaller models, no interval"
        found.append(Claim(text, said, ours, right if a < b else NOT))
    return found


def _renderers(lines: Sequence[Line]) -> list[Claim]:
    found = []
    for name, text, said in (
        (FOAM, "the foam's acceptance is high at small steps", "high"),
        (QUADRATURE, "quadrature's acceptance is low even at tiny steps", "low"),
    ):
        steps = by_step(lines, name)
        if not steps:
            found.append(Claim(text, said, "", UNMEASURED))
            continue
        step = min(steps)
        value, n = float(np.mean(steps[step])), len(steps[step])
        right = value > HIGH if name == FOAM else value < LOW
        if not right and LOW <= value <= HIGH:
            words = f"{CAVEAT}: neither high nor low"
        elif right and name == QUADRATURE:
            words = f"{CAVEAT}: one prior for both renderers"
        elif right:
            words = REPRODUCED if n > 1 else f"{CAVEAT}: one draw of the prior"
        else:
            words = NOT
        found.append(Claim(text, said, f"{value:.2f} at a step of {step:g}, n {n}", words))
    return found


def _annealing(lines: Sequence[Line]) -> list[Claim]:
    annealed, fixed = by_chain(lines, HMC.name), by_chain(lines, FIXED.name)
    both = [thing for thing in annealed if thing in fixed]
    found = []
    for name, text, sign in (
        ("worst", "annealing is more faithful: the worst chain's picture", 1.0),
        ("best", "annealing is more faithful: the best chain's picture", 1.0),
        ("spread", "annealing is more consistent: fixed temperature's spread above it", -1.0),
    ):
        pair = ([sign * x[thing][name] for thing in both] for x in (annealed, fixed))
        found.append(_difference(text, "better", paired_interval(*pair), " dB", 1))
    return found


def _cost(lines: Sequence[Line]) -> list[Claim]:
    text = "the hypernetwork's field is cheaper than one that is told the latent at each point (NeRF-VAE, own sizes)"
    said = "more than 100 times an evaluation, of Functa's 15 x 512"
    ratios = [
        x["ratio"] for x in lines if x["condition"].endswith(COST) and x["method"] == f"NeRF-VAE, own sizes{DECODER}"
    ]
    if not ratios:
        return [Claim(text, said, "", UNMEASURED)]
    i = paired_interval(ratios, np.ones(len(ratios)))
    ours = f"{1.0 + i.mean:.1f} times the pixels a second, n {i.n}"
    found = verdict(i)
    also = "both are small, and not of equal quality"
    return [Claim(text, said, ours, f"{CAVEAT}: {also}" if found == REPRODUCED else found)]


def tables(lines: Sequence[Line], effort: Effort) -> list[Table]:
    """The claims, and published single-view results."""
    cells = [[c.text, c.paper, c.ours, c.verdict] for c in claims(lines)]
    title = (
        f"The paper's claims: annealed HMC of {effort.iterations} x {effort.leapfrog_steps} (paper: 100 x 100) and"
        f" VI of {effort.vi_steps} steps (1500) beside its own figures"
    )
    first = Table(title, ("claim", "the paper", "measured", "verdict"), cells)
    pixel = RIVALS["pixel_nerf"].label
    ours = {
        name: [x["psnr_heldout"] for x in lines if x["condition"] == TELLING and x["method"] == name]
        for name in (HMC.name, HMC_DELTA.name, pixel)
    }
    ill = unhealthy(lines)
    shown = [
        [
            f"{name}, this project's cars, {TELLING.split(', ')[1]}{' (not healthy alone)' if name in ill else ''}",
            f"{np.mean(v):.1f}",
        ]
        for name, v in ours.items()
        if v
    ]
    title = (
        "Published psnr of one view of SRN Cars, dB, from their papers. Other cars, 128 x 128 pixels and 250 views of"
        " each: not comparable with this project's, which stand below"
    )
    return [first, Table(title, ("method", "psnr, dB"), [*map(list, PUBLISHED), *shown])]
