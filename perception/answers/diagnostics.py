"""How good an answer is: the numbers that travel with hypotheses, by name, in files and messages."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields

NAN = float("nan")


@dataclass(frozen=True)
class AnswerDiagnostics:
    """The sampler's diagnostics, how well its shapes explain the view, and the expected error.

    NaN: not measured, or not defined. Counts are whole numbers.
    """

    acceptance: float = NAN  # mean Metropolis acceptance over the last stage, 0 to 1
    divergences: float = NAN  # count of trajectories whose energy error was too large (`hmc.MAX_ENERGY_ERROR`)
    r_hat: float = NAN  # split R-hat of the log-likelihood over populations; 1: they agree
    ess: float = NAN  # effective sample size of the sampler's weights
    ancestors: float = NAN  # count of initial particles that the samples descend from
    beta: float = NAN  # least inverse temperature of a population; 1: the posterior
    log_evidence: float = NAN  # nats; mean over populations
    log_evidence_se: float = NAN  # nats; its standard error
    explained: float = NAN  # share of the informative pixels that the shapes explain on average, 0 to 1
    failed_populations: float = NAN  # count; they never left a poor mode and are left out
    power: float = NAN  # of the likelihood: pixels that one ray counts for
    point_gradients: float = NAN  # count of field evaluations with gradient, in all runs
    evidence_power: float = NAN  # a population's weight is its evidence estimate to this power
    expected_loss: float = NAN  # nats per voxel of unseen space, from having few populations (`publish.expected_loss`)

    @classmethod
    def from_mapping(cls, values: Mapping[str, float]) -> "AnswerDiagnostics":
        """From numbers by name, as in files and messages. A missing name gives NaN, an unknown one (of another version)
        is ignored. Raises ValueError if a value is not a number.
        """
        known = {}
        for name in (field.name for field in fields(cls)):
            value = values.get(name, NAN)
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                raise ValueError(f"the diagnostic {name} is {value!r}; it must be a number")
            known[name] = float(value)
        return cls(**known)

    def as_mapping(self) -> dict[str, float]:
        """All numbers by name, in the order of the fields; the inverse of `from_mapping`."""
        return asdict(self)
