"""What the paper claims, its number beside ours, and whether ours says the same. Verdicts are computed from rows.

The paper gives numbers for prior samples alone; its other claims are curves and bars, so that their numbers here are
words. A claim is *reproduced* where the 95% interval of its paired difference lies on the claim's side, *not
reproduced here* where it lies on the other side, and comes *with a caveat* where it holds both, or where one object, a
ratio without an interval, or an experiment that is not the paper's says it. Beside a rival that is not healthy alone
nothing is claimed. All verdicts are of this project's prior, cars and schedule, which are smaller than the paper's:
what fails here does not refute the paper.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.harness.intervals import PairedInterval, paired_interval
from benchmarks.harness.results import Line
from benchmarks.harness.tables import Table, ranged
from benchmarks.measures.renderer_acceptance import FOAM, QUADRATURE
from benchmarks.paper.annealing import accepted, by_chain
from benchmarks.paper.conditioned import PLACES
from benchmarks.paper.decoders import COST, DECODER, FUNCTA_PUBLISHED
from benchmarks.paper.methods import ENCODER, FIXED, FIXED_TUNED, HMC, HMC_DELTA, VI, VI_DELTA, Effort
from benchmarks.paper.prior_samples import COUNTS, IN_INCEPTION, OTHERS, PAPER, condition_of, sampled
from benchmarks.paper.renderers import RAYS, by_step
from benchmarks.paper.rival_answers import unhealthy
from benchmarks.rivals.registry import RIVALS

REPRODUCED, NOT, CAVEAT, UNMEASURED = "reproduced", "not reproduced here", "with a caveat", "not measured"
BACK, TELLING = (f"cars, {place.name}" for place in PLACES["cars"])
FUNCTA = RIVALS["functa"].label
NO_WORSE = -0.5  # dB that count as no negative effect
HIGH, LOW = 0.65, 0.3  # acceptance that is high, and that is low
SAME = 0.1  # difference of two acceptances that count as equal
UNASKED = (  # claims of the paper that no experiment of these asks, and why
    ("hmc's and vi's pictures are more realistic than Functa's: FID", "lower", "no Inception features of answers"),
    ("delta makes pictures of the given view more realistic: FID", "lower", "no Inception features of answers"),
    ("delta does no harm to samples of the prior", "no harm", "samples are drawn without it"),
    ("hmc is more diverse than vi on people, from the left half of a picture", "higher", "no prior of people is kept"),
    ("delta raises the given view's quality less on people than on cars", "less", "no prior of people is kept"),
)
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
            i = paired(lines, condition, metric, HMC_DELTA.name, FUNCTA)  # the paper's whole model
            text = f"{HMC_DELTA.name} is more accurate than Functa's MAP on {words} ({condition})"
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
    found += _held_out(lines)
    for condition in (BACK, TELLING):
        i = paired(lines, condition, "psnr_given", HMC.name, ENCODER.name)
        text = f"the encoder alone fails to reconstruct new objects ({condition}): hmc above it"
        found.append(_difference(text, "poor", i, " dB", 1))
    found += _cost(lines)
    return [*found, *(Claim(text, said, "", f"{UNMEASURED}: {why}") for text, said, why in UNASKED)]


def _held_out(lines: Sequence[Line]) -> list[Claim]:
    """Of delta. Draws that differ more have a lower psnr each, so that of their mean picture stands beside it."""
    found = []
    for condition, text, said, least in (
        (BACK, f"delta does no harm to held-out views (uninformative): {-NO_WORSE:g} dB or less", "no worse", NO_WORSE),
        (TELLING, "delta improves held-out views (informative)", "higher", 0.0),
    ):
        of_draws, of_mean = (
            paired(lines, condition, metric, HMC_DELTA.name, HMC.name)
            for metric in ("psnr_heldout", "psnr_heldout_of_mean")
        )
        claim = _difference(text, said, of_draws, " dB", 1, least)
        if of_mean.n:
            claim = replace(claim, ours=f"{claim.ours}; the mean picture's {ranged(of_mean, 1, '+')} dB")
        if claim.verdict == NOT:
            claim = replace(claim, verdict=f"{NOT}: perhaps as its kept states are still tempered")
        found.append(claim)
    return found


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
        wrong = right.replace(CAVEAT, NOT)
        found.append(Claim(text, said, ours, right if a < b else wrong))
    return found


def _renderers(lines: Sequence[Line]) -> list[Claim]:
    """The paper's experiment has a whole picture, and a prior that was trained with the renderer that is asked."""
    other = f"{RAYS} pixels of a picture, one prior for both renderers"
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
        if LOW <= value <= HIGH:
            words = f"{CAVEAT}: neither high nor low"
        elif (value > HIGH) == (name == FOAM):
            words = f"{CAVEAT}: {other}"
        else:
            words = f"{NOT}: {other}"
        words += ", one draw of the prior" * (n == 1)
        found.append(Claim(text, said, f"{value:.2f} at a step of {step:g}, n {n}", words))
    return found


def _annealing(lines: Sequence[Line]) -> list[Claim]:
    """Beside one temperature with the paper's step, and with a step of the annealed chains' acceptance."""
    annealed, found = by_chain(lines, HMC.name), []
    for other, words, said in (
        (FIXED, "one temperature", "better"),
        (FIXED_TUNED, "one temperature with a tuned step", "not asked"),
    ):
        fixed = by_chain(lines, other.name)
        both = [thing for thing in annealed if thing in fixed]
        a, b = accepted(lines, HMC.name), accepted(lines, other.name)
        also = f"its step is {'small' if b > a else 'large'}: acceptance {b:.2f}, annealed {a:.2f}"
        for name, text, sign in (
            ("worst", "more faithful than {}: the worst chain's picture", 1.0),
            ("best", "more faithful than {}: the best chain's picture", 1.0),
            ("spread", "more consistent than {}: its spread above annealing's", -1.0),
        ):
            i = paired_interval(*([sign * x[thing][name] for thing in both] for x in (annealed, fixed)))
            text = f"annealing is {text.format(words)}"
            found.append(_difference(text, said, i, " dB", 1, also=also if abs(a - b) > SAME else ""))
    return found


def _cost(lines: Sequence[Line]) -> list[Claim]:
    own = [x for x in lines if x["condition"].endswith(COST)]
    text = "an evaluation of its field is cheaper than one of Functa's 15 x 512"
    said, counted = "more than 100 times", [x["operations"] for x in own if x["method"] == f"ProbNeRF{DECODER}"]
    times = FUNCTA_PUBLISHED / counted[0] if counted else float("nan")
    ours = f"{times:.0f} times the operations, counted" if counted else ""
    words = (f"{CAVEAT}: equal quality is not shown" if times > 100 else NOT) if counted else UNMEASURED
    found = [Claim(text, said, ours, words)]
    text = "a picture is cheaper than of a field that is told the latent at each point (NeRF-VAE, own sizes)"
    ratios = [x["ratio"] for x in own if x["method"] == f"NeRF-VAE, own sizes{DECODER}"]
    if not ratios:
        return [*found, Claim(text, "large savings", "", UNMEASURED)]
    i = paired_interval(ratios, np.ones(len(ratios)))
    ours, words = f"{1.0 + i.mean:.1f} times the pixels a second, n {i.n}", verdict(i)
    also = f"{CAVEAT}: both are small, equal quality is not shown"
    return [*found, Claim(text, "large savings", ours, also if words == REPRODUCED else words)]


def tables(lines: Sequence[Line], effort: Effort) -> list[Table]:
    """The claims, and published single-view results."""
    cells = [[c.text, c.paper, c.ours, c.verdict] for c in claims(lines)]
    title = (
        f"The paper's claims: annealed HMC of {effort.iterations} x {effort.leapfrog_steps} (paper: 100 x 100) and"
        f" VI of {effort.vi_steps} steps (1500) beside its own figures"
    )
    first = Table(title, ("claim", "the paper", "measured", "verdict"), cells)
    pixel, ill = RIVALS["pixel_nerf"].label, unhealthy(lines)
    shown = [[name, psnr, "", ""] for name, psnr in PUBLISHED]
    for name in (HMC.name, HMC_DELTA.name, pixel):
        own = [x for x in lines if x["condition"] == TELLING and x["method"] == name]
        if own:
            each = [f"{np.mean([x[m] for x in own]):.1f}" for m in ("psnr_heldout", "psnr_heldout_of_mean")]
            words = f"{name}, this project's {TELLING}{' (not healthy alone)' * (name in ill)}"
            shown.append([words, *each, str(len(own))])
    title = (
        "Published psnr of one view of SRN Cars, dB, from their papers. Other cars, 128 x 128 pixels and 250 views of"
        " each: not comparable with this project's, which stand below, as a mean over draws and of the mean picture"
    )
    return [first, Table(title, ("method", "psnr, dB", "of the mean picture", "n"), shown)]
