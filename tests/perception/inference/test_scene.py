"""The order in which a scene's objects are worked on, with stand-ins for their inferences and a clock of our own."""

import math
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import pytest

import perception.inference.scene
from perception.inference.scene import estimate_scene
from probnerf.types import StopReason

INTERRUPTED = StopReason.INTERRUPTED


@dataclass
class Clock:
    now: float = 0.0

    def monotonic(self) -> float:
        return self.now


@dataclass
class Inference:
    """Runs of `cost` seconds; the loss is `losses[runs]`, and it is done when that is 0."""

    name: int
    clock: Clock
    diary: list[str]
    end: float | None
    losses: list[float]
    cost: float = 3.0
    first_cost: float = 0.0  # of the scene's first step
    runs: int = 0
    done: bool = False
    cut: bool = False
    answer: Any = None
    interrupts: bool = False
    reason: StopReason | None = None
    steps: list[float | None] = field(default_factory=list)

    @property
    def loss(self) -> float:
        return math.inf if self.cut or not self.runs else self.losses[self.runs - 1]

    @property
    def interrupted(self) -> bool:
        return self.reason == StopReason.INTERRUPTED

    def guess(self) -> None:
        self.clock.now += 0.5
        self.answer = "guess"
        self.diary.append(f"{self.name} guesses")

    def begin(self) -> None:
        self.diary.append(f"{self.name} begins")

    def step(self, deadline: float | None = None) -> bool:
        ends = min(t for t in (deadline, self.end, math.inf) if t is not None)
        cost = (
            self.first_cost if self.first_cost and not any("runs" in d or "cut" in d for d in self.diary) else self.cost
        )
        whole = self.clock.now + cost <= ends
        self.clock.now += cost if whole else max(ends - self.clock.now, 0.0)
        self.diary.append(f"{self.name} {'runs' if whole else 'is cut'}")
        self.answer = "shapes"
        if self.interrupts:
            self.done, self.reason = True, StopReason.INTERRUPTED
        elif whole:
            self.cut, self.runs = False, self.runs + 1
            self.done = self.loss == 0.0
        else:
            self.cut = self.runs == 0
            self.done = self.end is not None and ends == self.end
        return whole

    def stop(self, reason: StopReason) -> None:
        if not self.done:
            self.done, self.reason = True, reason

    def estimate(self) -> Any:
        return SimpleNamespace(name=self.name, answer=self.answer, runs=self.runs, reason=self.reason)


class Scene:
    def __init__(self, monkeypatch: pytest.MonkeyPatch, *losses: list[float], **given: Any) -> None:
        self.clock, self.diary, self.given, self.losses = Clock(), list[str](), given, losses
        self.made = list[Inference]()
        monkeypatch.setattr(perception.inference.scene, "time", self.clock)

    def start(self, segment: Any, end: float | None) -> Any:
        if not self.losses[segment.id - 1]:
            raise ValueError("too small")
        made = Inference(segment.id, self.clock, self.diary, end, self.losses[segment.id - 1], **self.given)
        self.made.append(made)
        return made

    def answers(self, deadline: float | None, kept_back_s: float = 0.0) -> list[tuple[int, Any]]:
        segments: Any = [SimpleNamespace(id=i) for i in range(1, len(self.losses) + 1)]
        return [(s.id, found) for s, found in estimate_scene(segments, self.start, deadline, kept_back_s)]


def test_without_a_budget_one_object_is_finished_after_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(monkeypatch, [0.2, 0.0], [0.0])
    assert [name for name, _ in scene.answers(None)] == [1, 2]
    assert scene.diary == ["1 begins", "1 runs", "1 runs", "2 begins", "2 runs"]


def test_all_first_answers_come_first_then_first_runs_then_what_may_gain_most(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(monkeypatch, [0.2, 0.1, 0.0], [0.0], [0.4, 0.15, 0.0])
    found = scene.answers(100.0)
    first = [f"{i} guesses" for i in (1, 2, 3)] + [f"{i} {does}" for i in (1, 2, 3) for does in ("begins", "runs")]
    assert scene.diary == [*first, "3 runs", "1 runs", "3 runs", "1 runs"]
    assert [name for name, _ in found] == [2, 3, 1]  # each as soon as it is done
    assert all(made.reason is None for made in scene.made)


def test_every_object_gets_its_share_of_a_short_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(monkeypatch, *[[0.3, 0.0]] * 4)
    found = scene.answers(18.0)  # 2 s of first answers, 12 of first runs; one of four has a second
    assert [made.runs for made in scene.made] == [2, 1, 1, 1]
    assert scene.clock.now <= 18.0
    assert [estimate.reason for _, estimate in found].count(StopReason.BUDGET) == 2  # the third was cut off by its end


def test_a_run_that_its_share_cut_is_made_again_if_there_is_time(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(monkeypatch, [0.0], [0.0], first_cost=20.0)  # such as of compiling
    found = scene.answers(28.0)
    assert scene.diary[2:] == ["1 begins", "1 is cut", "2 begins", "2 runs", "1 runs"]
    assert [(name, e.runs, e.reason) for name, e in found] == [(2, 1, None), (1, 1, None)]


def test_runs_that_are_cut_are_answers_where_there_is_no_time_for_more(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(monkeypatch, [0.0], [0.0], cost=9.0)
    found = scene.answers(17.0)  # both have 8 s of 9
    assert scene.diary[2:] == ["1 begins", "1 is cut", "2 begins", "2 is cut"] and scene.clock.now <= 17.0
    assert [(name, e.answer) for name, e in found] == [(1, "shapes"), (2, "shapes")]


def test_without_time_for_runs_the_first_answers_stand(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(monkeypatch, [0.3, 0.0], [0.0], [0.0])
    found = scene.answers(1.0)
    assert [(name, e.answer, e.reason) for name, e in found] == [(i, "guess", StopReason.BUDGET) for i in (1, 2, 3)]
    assert scene.diary == ["1 guesses", "2 guesses", "3 guesses"]


def test_what_the_caller_needs_is_kept_back(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(monkeypatch, [0.3, 0.2, 0.1, 0.0], [0.3, 0.2, 0.1, 0.0])
    scene.answers(20.0, kept_back_s=3.0)
    assert {made.end for made in scene.made} == {14.0} and scene.clock.now <= 14.0


def test_an_object_that_cannot_be_inferred_does_not_stop_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    for deadline in (None, 50.0):
        found = dict(Scene(monkeypatch, [0.0], [], [0.0]).answers(deadline))
        assert isinstance(found[2], ValueError) and found[1].runs == found[3].runs == 1


def test_ctrl_c_gives_all_present_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(monkeypatch, [0.0], [0.0], [0.0], interrupts=True)
    found = scene.answers(100.0)
    assert [(name, e.answer, e.reason) for name, e in found] == [
        (1, "shapes", StopReason.INTERRUPTED),
        (2, "guess", StopReason.INTERRUPTED),
        (3, "guess", StopReason.INTERRUPTED),
    ]
    one = Scene(monkeypatch, [0.0], [0.0], interrupts=True)
    assert [name for name, _ in one.answers(None)] == [1]


def test_ctrl_c_between_stages_or_outside_gives_all_present_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(monkeypatch, [0.3, 0.0], [0.0], [0.0])

    def step(self: Inference, *_: Any) -> bool:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Inference, "step", step)
        found = scene.answers(100.0)
        assert [(name, e.answer, e.reason) for name, e in found] == [(i, "guess", INTERRUPTED) for i in (1, 2, 3)]
        with pytest.raises(KeyboardInterrupt):
            one = Scene(patched, [0.0])
            one.answers(None)  # nothing is there yet
    again = Scene(monkeypatch, [0.3, 0.0], [0.0], [0.0])
    segments: Any = [SimpleNamespace(id=i) for i in (1, 2, 3)]
    answers: Any = estimate_scene(segments, again.start, 100.0)
    first = next(answers)[0].id  # it is drawn meanwhile, say
    rest = [answers.throw(KeyboardInterrupt()), *answers]
    assert [first, *(s.id for s, _ in rest)] == [2, 1, 3]
    assert [(e.answer, e.reason) for _, e in rest] == [("shapes", INTERRUPTED), ("shapes", None)]  # 3 was done


def test_ctrl_c_is_told_where_no_answer_can_say_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before the first of all answers, and where all objects that are left are done."""

    def guess(self: Inference) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Inference, "guess", guess)
        with pytest.raises(KeyboardInterrupt):
            Scene(patched, [0.0], [0.0]).answers(100.0)
    done = Scene(monkeypatch, [0.0], [0.0])
    segments: Any = [SimpleNamespace(id=i) for i in (1, 2)]
    answers: Any = estimate_scene(segments, done.start, 100.0)
    assert next(answers)[0].id == 1
    assert answers.throw(KeyboardInterrupt())[0].id == 2
    with pytest.raises(KeyboardInterrupt):
        next(answers)
