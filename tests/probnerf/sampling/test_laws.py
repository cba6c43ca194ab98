"""Every sampler obeys its laws, and a careless edit of it does not: the laws are sharp enough to tell."""

from collections.abc import Callable
from types import ModuleType

import pytest

from probnerf.sampling import annealed_hmc, gaussian_mixture, hmc, mean_field, populations, resampling, tempered_smc
from tests.probnerf import laws

LAWS = [
    (laws.hmc_leaves_its_target_alone, hmc),
    (laws.smc_finds_evidence_and_moments, tempered_smc),
    (laws.resampling_gives_each_its_due, resampling),
    (laws.smc_takes_proposals_for_what_they_are, tempered_smc),
    (laws.smc_finds_the_same_from_any_reference, tempered_smc),
    (laws.smc_moves_each_half_by_what_the_other_says, tempered_smc),
    (laws.hmc_leaves_a_target_between_reference_and_posterior_alone, hmc),
    (laws.a_cut_run_goes_on_from_the_density_that_it_reached, populations),
    (laws.a_mixture_has_the_density_that_it_draws_from, gaussian_mixture),
    (laws.annealing_keeps_draws_of_its_last_temperatures, annealed_hmc),
    (laws.vi_s_bound_is_the_evidence_at_the_posterior, mean_field),
]


@pytest.mark.parametrize(("law", "module"), LAWS, ids=[law.__name__ for law, _ in LAWS])
def test_the_law_holds(law: Callable, module: ModuleType) -> None:
    law(module)


def smc_with(edited: ModuleType) -> ModuleType:
    """Tempered SMC that draws its names from an edited module."""
    made = laws.mutant("probnerf.sampling.tempered_smc")
    for name in ("choose", "next_beta"):
        if hasattr(edited, name):
            setattr(made, name, getattr(edited, name))
    return made


def hmc_edited(*edits: tuple[str, str]) -> Callable[[], ModuleType]:
    return lambda: laws.mutant("probnerf.sampling.hmc", *edits)


def smc_edited(*edits: tuple[str, str]) -> Callable[[], ModuleType]:
    return lambda: laws.mutant("probnerf.sampling.tempered_smc", *edits)


def resampling_edited(*edits: tuple[str, str]) -> Callable[[], ModuleType]:
    return lambda: smc_with(laws.mutant("probnerf.sampling.resampling", *edits))


MUTATIONS = {
    "an accept test without the momentum": (
        laws.hmc_leaves_its_target_alone,
        hmc_edited(("(end.position + start.position) + (v1 - v0) * (v1 + v0)", "(end.position + start.position)")),
    ),
    "an accept test at another temperature": (
        laws.hmc_leaves_its_target_alone,
        hmc_edited(("beta * (end.log_likelihood - start.log_likelihood)", "end.log_likelihood - start.log_likelihood")),
    ),
    "every proposal accepted": (
        laws.hmc_leaves_its_target_alone,
        hmc_edited(("accepted = uniform[1] < acceptance", "accepted = ~divergent")),
    ),
    "a momentum that is the position's": (
        laws.hmc_leaves_its_target_alone,
        hmc_edited(("jax.random.normal(momentum_key, state.position.shape)", "0.7 * state.position")),
    ),
    "a turn without the sine's sign": (
        laws.hmc_leaves_its_target_alone,
        hmc_edited(("return cosine * q + sine * v, cosine * v - sine * q", "return cosine * q + sine * v, cosine * v")),
    ),
    "an un-annealed chain": (
        laws.annealing_keeps_draws_of_its_last_temperatures,
        lambda: laws.mutant(
            "probnerf.sampling.annealed_hmc",
            ("(config.s_end / scale) ** 2, base * scale", "(config.s_end / config.s_start) ** 2, base * scale"),
        ),
    ),
    "resampling off by one": (
        laws.resampling_gives_each_its_due,
        lambda: laws.mutant("probnerf.sampling.resampling", ('u, side="right")', 'u, side="right") + 1')),
    ),
    "resampling with one number for all": (
        laws.resampling_gives_each_its_due,
        lambda: laws.mutant(
            "probnerf.sampling.resampling",
            ("(jnp.arange(count) + jax.random.uniform(key)) / count", "jnp.full(count, jax.random.uniform(key))"),
        ),
    ),
    "an un-annealed importance step": (
        laws.smc_finds_evidence_and_moments,
        resampling_edited(("return new, weights(new - beta), sizes[index]", "return new, weights(new), sizes[index]")),
    ),
    "an evidence without its normaliser": (
        laws.smc_finds_evidence_and_moments,
        smc_edited(("logsumexp(log_w, axis=1) - np.log(size), state", "logsumexp(log_w, axis=1), state")),
    ),
    "moves at the temperature of the next stage's weights": (
        laws.smc_finds_evidence_and_moments,
        smc_edited(
            (
                "args, state.beta[:, None], state.metric, reference)",
                "args, jnp.ones_like(state.beta)[:, None], state.metric, reference)",
            )
        ),
    ),
    "step sizes that follow the particles they move": (
        laws.smc_moves_each_half_by_what_the_other_says,
        smc_edited(("(chain, tuned[:, ::-1])", "(chain, tuned)")),
    ),
    "starts weighed as if the prior had drawn them": (
        laws.smc_takes_proposals_for_what_they_are,
        smc_edited(("return q0, log_prior(q0) - log_q0", "return q0, jnp.zeros_like(log_q0)")),
    ),
    "a bound without the width of q": (
        laws.vi_s_bound_is_the_evidence_at_the_posterior,
        lambda: laws.mutant("probnerf.sampling.mean_field", ("** 2 + fixed.log_std, axis", "** 2, axis")),
    ),
    "an accept test without the reference": (
        laws.hmc_leaves_a_target_between_reference_and_posterior_alone,
        hmc_edited((" - (1.0 - beta) * (end.over_prior - start.over_prior)", "")),
    ),
    "weights of the likelihood alone": (
        laws.smc_finds_the_same_from_any_reference,
        smc_edited(("pool.log_ratio", "pool.log_likelihood")),
    ),
    "a start that forgets what drew it": (
        laws.smc_finds_the_same_from_any_reference,
        smc_edited(("value = value - reference.over_prior", "value = value - 0.0 * reference.over_prior")),
    ),
    "a cut run that forgets where it began": (
        laws.a_cut_run_goes_on_from_the_density_that_it_reached,
        lambda: laws.mutant(
            "probnerf.sampling.populations", ("f = (1.0 - beta[:, None]) * over + ", "f = 0.0 * over + ")
        ),
    ),
    "a mixture without its determinants": (
        laws.a_mixture_has_the_density_that_it_draws_from,
        lambda: laws.mutant(
            "probnerf.sampling.gaussian_mixture", ("self.log_weight + log_det + each", "self.log_weight + each")
        ),
    ),
    "draws by the root where its transpose belongs": (
        laws.a_mixture_has_the_density_that_it_draws_from,
        lambda: laws.mutant("probnerf.sampling.gaussian_mixture", ("transpose_a=True", "transpose_a=False")),
    ),
}


@pytest.mark.parametrize("name", MUTATIONS)
def test_a_careless_edit_breaks_a_law(name: str) -> None:
    law, edited = MUTATIONS[name]
    module = edited()  # fails here where the source has moved on
    with pytest.raises(AssertionError):
        law(module)
