"""The controller's loop with a stand-in for the sampler: which runs are made, answer together, and are left out."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import nan
from types import SimpleNamespace
from typing import Any

import pytest

from perception.answers.diagnostics import AnswerDiagnostics
from perception.answers.hypotheses import Hypotheses
from perception.inference.controller import infer_view
from perception.inference.limits import NO_LIMITS, Callbacks, Limits
from perception.inference.settings import ControllerConfig
from perception.inference.view_sampler import ViewSampler
from probnerf.sampling.hmc import StageInfo
from probnerf.types import StopReason
from tests.node.shapes import body_with_handle

STAGES = 2  # of each run
DRAWS, GUESS = -1, -2  # stand for the numbers of runs
WHOLE, CUT = StopReason.CONVERGED, StopReason.INTERRUPTED


@dataclass(frozen=True)
class Runs:
    """Stands for the posterior of several runs."""

    numbers: tuple[int, ...]
    result: StopReason

    @property
    def diagnostics(self) -> Any:
        return SimpleNamespace(stages=STAGES, point_gradients=1.0)


class Sampler:
    """Stands for the sampler and for what publishes its samples."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *results: StopReason) -> None:
        self.results, self.made, self.stages = results, list[int](), list[int]()
        monkeypatch.setattr("perception.inference.view_sampler.infer", self.infer)
        monkeypatch.setattr("perception.inference.view_sampler.crossings_of", lambda *_: 1)
        monkeypatch.setattr(ViewSampler, "likelihood", None)
        monkeypatch.setattr("perception.inference.inference.pooled", self.pooled)
        monkeypatch.setattr("perception.inference.inference.published", self.published)

    def infer(self, *_: Any, on_stage: Callable[[StageInfo], bool | None], **__: Any) -> tuple[Runs, None]:
        number = len(self.made)
        self.made.append(number)
        samples: Any = Runs((number,), StopReason.UNDERWAY)
        for stage in range(STAGES + 1):
            if on_stage(StageInfo(stage, (nan,), (nan,), (nan,), (nan,), (nan,), 0, 0.0, lambda: samples)):
                return Runs((number,), StopReason.STOPPED), None
        return Runs((number,), self.results[number]), None

    @staticmethod
    def pooled(runs: list[Runs], _: float) -> Runs:
        return Runs(tuple(number for run in runs for number in run.numbers), runs[-1].result)

    @staticmethod
    def published(_: Any, posterior: Runs, *rest: Any, **__: Any) -> Hypotheses:
        """What runs an answer is of stands in its label, and in its error whether it is one of few shapes."""
        few = rest[2].hypotheses == CONFIG.first_hypotheses
        diagnostics = AnswerDiagnostics(expected_loss=0.04, explained=1.0)
        return body_with_handle(
            label=str(posterior.numbers), result=posterior.result, monte_carlo_error=float(few), diagnostics=diagnostics
        )


CONFIG = ControllerConfig(hypotheses=8, first_hypotheses=4)


def inferred(
    runs: int = 4, limits: Limits = NO_LIMITS, on_stage: Any = None, **given: Any
) -> tuple[Any, list[tuple[str, str]]]:
    """An estimate, and the answers with all their shapes that were handed out: which runs they are of, their result."""
    answers = list[Hypotheses]()
    view: Any = SimpleNamespace(pose_known=True, observation=None, every_choice=None, object_frame=None)
    config, prior = replace(CONFIG, runs=runs), SimpleNamespace(model=None, network=None)
    callbacks = Callbacks(on_stage, answers.append)
    found = infer_view(view, prior, config, limits=limits, callbacks=callbacks, **given)
    assert answers[-1] is found.hypotheses and answers[0].monte_carlo_error == 1.0
    whole = [h.monte_carlo_error == 0.0 for h in answers]
    assert sorted(whole) == whole  # early ones of few shapes come before all others
    return found, [(h.label, str(h.result)) for h in answers if h.monte_carlo_error == 0.0]


def with_network(monkeypatch: pytest.MonkeyPatch, suffice: bool | None) -> None:
    """A network stands for itself, and so do its weighed draws; None: none are weighed."""
    numbers: Any = dict(log_weights=[0.0] * 512, ess=250.0, k=0.3, apart=0.1)
    draws = SimpleNamespace(suffice=lambda _: suffice, posterior=lambda: Runs((DRAWS,), WHOLE), **numbers)
    monkeypatch.setattr(ViewSampler, "asks_network", True)
    monkeypatch.setattr(ViewSampler, "guess", lambda _: Runs((GUESS,), StopReason.UNDERWAY))
    monkeypatch.setattr(ViewSampler, "weigh", lambda _: None if suffice is None else draws)


def test_where_the_network_s_draws_suffice_no_run_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    sampler = Sampler(monkeypatch, *[WHOLE] * 4)
    with_network(monkeypatch, suffice=True)
    found, answers = inferred()
    assert sampler.made == [] and answers == [("(-1,)", "converged")] and found.posterior.numbers == (DRAWS,)
    assert found.log == (
        "512 draws of the network: ESS 250, Pareto k 0.30, halves 0.10 nats apart: no tempering is needed",
    )


@pytest.mark.parametrize("suffice", [False, None])
def test_where_they_do_not_the_runs_begin_there(monkeypatch: pytest.MonkeyPatch, suffice: bool | None) -> None:
    sampler = Sampler(monkeypatch, *[WHOLE] * 4)
    with_network(monkeypatch, suffice)
    found, answers = inferred(runs=1)
    assert sampler.made == [0] and answers == [("(0,)", "converged")]
    assert len(found.log) == (1 if suffice is None else 2)
    assert suffice is None or found.log[0].endswith("halves 0.10 nats apart -> tempering from there")


def test_the_runs_that_are_asked_for_answer_together(monkeypatch: pytest.MonkeyPatch) -> None:
    sampler = Sampler(monkeypatch, *[WHOLE] * 3)
    found, answers = inferred(runs=3)
    assert sampler.made == [0, 1, 2] and found.posterior.numbers == (0, 1, 2)
    assert answers == [("(0,)", "underway"), ("(0, 1)", "underway"), ("(0, 1, 2)", "converged")]
    assert found.hypotheses.stage == 3 * STAGES and len(found.log) == 3


def test_what_goes_on_from_an_earlier_posterior_is_one_run(monkeypatch: pytest.MonkeyPatch) -> None:
    sampler = Sampler(monkeypatch, WHOLE)
    before: Any = SimpleNamespace(diagnostics=SimpleNamespace(beta=[0.5] * 8), positions=[0.0] * 64)
    assert inferred(before=before)[1] == [("(0,)", "converged")] and sampler.made == [0]


def test_a_first_run_that_is_cut_is_the_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    sampler = Sampler(monkeypatch, CUT)
    found, answers = inferred(runs=1)
    assert answers == [("(0,)", "interrupted")] and sampler.made == [0] and len(found.log) == 1


def test_a_further_run_that_is_cut_is_left_out_and_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    sampler = Sampler(monkeypatch, WHOLE, WHOLE, CUT)
    found, answers = inferred()
    assert sampler.made == [0, 1, 2] and found.posterior.numbers == (0, 1)
    assert answers == [("(0,)", "underway"), ("(0, 1)", "underway"), ("(0, 1)", "interrupted")]
    assert found.hypotheses.stage == 3 * STAGES and found.log[-1] == "no room for more (interrupted)"


@pytest.mark.parametrize(("stages", "whole"), [(STAGES, 1), (3 * STAGES, 3)])
def test_no_run_is_begun_past_the_limit(monkeypatch: pytest.MonkeyPatch, stages: int, whole: int) -> None:
    sampler = Sampler(monkeypatch, *[WHOLE] * 4)
    found, answers = inferred(limits=Limits(stages=stages))
    assert sampler.made == list(range(whole)) and found.hypotheses.stage == stages
    assert answers[-1] == (str(tuple(range(whole))), "stages") and found.log[-1] == "no room for more (stages)"
    assert len(answers) == whole  # nothing is called underway where nothing follows


def test_stages_are_counted_over_all_runs_and_may_be_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    sampler, heard = Sampler(monkeypatch, *[WHOLE] * 4), list[int]()

    def on_stage(info: StageInfo) -> bool:
        heard.append(info.stage)
        return info.stage == STAGES + 1

    _, answers = inferred(on_stage=on_stage)
    assert heard == [0, 1, 2, 2, 3] and sampler.made == [0, 1]
    assert answers == [("(0,)", "underway"), ("(0,)", "stopped")]
