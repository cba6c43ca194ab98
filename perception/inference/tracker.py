"""Objects over time: each frame adds a view of them, or shows that they moved.

The latents live in the cube of an object's first frame. A later frame of the same still object is observed in that cube
(its camera moves, its rays with it), and the posterior of all views is inferred from the start: the previous samples
cover fewer modes than a new search finds. What a frame adds is measured by the voxels that it is the first to see. A
frame that adds nothing has the same errors as those before it, like pictures from one tripod. It only has to agree. The
answer is then published again under its stamp, or interrupted sampling continues (`populations.start_from`). A frame
that the hypotheses do not explain shows an object that moved.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from perception.answers.hypotheses import Hypotheses
from perception.inference.controller import Estimate, infer_view
from perception.inference.inference import Inference
from perception.inference.limits import NO_CALLBACKS, NO_LIMITS, Callbacks, Limits
from perception.inference.publish import ConditionedView
from perception.inference.settings import ControllerConfig, TrackConfig
from perception.observation.object_frame import ObjectFrame, object_frame
from perception.observation.rays import observations
from perception.observation.segmentation import Segment
from perception.observation.visibility import seen_voxels
from perception.sources.frame import Frame
from probnerf.inference import likelihood_of, without_sizes
from probnerf.prior.checkpoint import Prior
from probnerf.rendering.occupancy import above_plane
from probnerf.sampling.populations import thin
from probnerf.shapes import explained
from probnerf.types import Observation, Posterior, StopReason, joined, on_device


class Change(StrEnum):
    """The effect of one frame on the knowledge of one object."""

    NEW = "new"  # it is seen for the first time
    VIEW = "view"  # it is seen from another side: a further view to condition on
    CONTINUED = "continued"  # nothing to add; interrupted sampling continues
    SAME = "same"  # nothing to add, and nothing left to sample
    MOVED = "moved"  # it is no longer where it was: inference restarts


@dataclass(frozen=True, eq=False)
class Update:
    """The effect of one frame on one object."""

    change: Change
    hypotheses: Hypotheses
    stages: int  # of the sampler, spent on this frame
    agreement: float  # share explained of the frame's telling pixels by the hypothesis that explains most (NaN: new)
    seconds: float  # of sampling


@dataclass(frozen=True, eq=False)
class _Kept:
    """One view of the posterior's condition."""

    observations: tuple[Observation, ...]  # each of its own choice of pixels
    direction: Float[np.ndarray, "3"]  # from the cube's centre to the camera, unit


@dataclass(frozen=True, eq=False)
class _Track:
    """The state of one object."""

    anchor: ObjectFrame  # in the first frame's camera
    first: Frame
    kept: tuple[_Kept, ...]
    seen: Bool[np.ndarray, "g g g"]
    posterior: Posterior
    hypotheses: Hypotheses
    inferences: int  # so far


@dataclass(frozen=True, eq=False)
class Look:
    """The result of a first look at a frame's segment, before any sampling."""

    object_id: int  # the object's own, which stays from frame to frame
    change: Change
    agreement: float
    hypotheses: Hypotheses | None  # earlier ones that still hold, under this frame's stamp; None: there are none
    seed: int
    _view: ConditionedView
    _kept: tuple[_Kept, ...]
    _track: _Track | None  # the track that is continued

    @property
    def builds_on(self) -> bool:
        """Whether inference continues from the object's earlier views or samples."""
        return self.change in (Change.VIEW, Change.CONTINUED)

    @property
    def segment(self) -> Segment:
        """The frame's segment, under the object's own id."""
        return self._view.segment

    @property
    def settled(self) -> bool:
        """Whether there is nothing to infer."""
        return self.change == Change.SAME


@dataclass
class Tracker:
    """The objects of a scene from frame to frame. Deterministic where `stages` is given and no deadline."""

    prior: Prior
    config: ControllerConfig = field(default_factory=ControllerConfig)
    track: TrackConfig = field(default_factory=TrackConfig)
    seed: int = 0
    _tracks: dict[int, _Track] = field(default_factory=dict)
    _names: set[int] = field(default_factory=set)  # that were given

    def update(
        self,
        frame: Frame,
        segment: Segment,
        *,
        stages: int | None = None,
        on_answer: Callable[[Hypotheses], None] | None = None,
    ) -> Update:
        """Process a frame's segment: `look`, then `infer` if there is something to infer."""
        look = self.look(frame, segment)
        assert look is not None
        return self.infer(look, Limits(stages=stages), Callbacks(on_answer=on_answer))

    def look(
        self, frame: Frame, segment: Segment, how: Callable[[int], tuple[int, bool] | None] | None = None
    ) -> Look | None:
        """Compare a frame's segment with the tracked objects.

        `how` maps the object's id to this frame's seed and whether to start afresh. If it returns None, so does this.
        Without it the seed is the tracker's seed plus the number of the inference.
        Raises ValueError if the segment cannot be observed, as `observe` does.
        """
        found = object_frame(frame, segment, self.config.observe)
        name = self._name(frame, segment, found)
        track = self._tracks.get(name)
        chosen = (self.seed + (0 if track is None else track.inferences), False) if how is None else how(name)
        if chosen is None:
            return None
        seed, fresh = chosen
        segment = replace(segment, id=name)
        change = Change.NEW
        agreement = float("nan")
        if track is not None and not fresh:
            cube = track.anchor.seen_from(_moved_by(track.first, frame))
            chosen_pixels, _ = observations(frame, segment, self.config.observe, seed, cube)
            view = ConditionedView(frame, segment, chosen_pixels, cube, track.seen)
            agreement = self._agreement(track.posterior, view.every_pixel)
            still = frame.T_world_camera is not None or _same_plane(cube.plane, found.plane, self.track)
            if still and agreement >= self.track.moved_below:
                return self._go_on(name, track, view, agreement, seed)
            change = Change.MOVED
        chosen_pixels, _ = observations(frame, segment, self.config.observe, seed, found)
        seen = seen_voxels(frame, segment, found, self.config.grid)
        view = ConditionedView(frame, segment, chosen_pixels, found, seen)
        return Look(name, change, agreement, None, seed, view, (_Kept(chosen_pixels, _direction(found)),), None)

    def infer(self, look: Look, limits: Limits = NO_LIMITS, callbacks: Callbacks = NO_CALLBACKS) -> Update:
        """Do the sampling that a look requires, and store the result. If the object has hypotheses already, the
        encoder's guess is not published.
        """
        track = look._track
        if look.settled and track is not None and look.hypotheses is not None:
            self._tracks[look.object_id] = replace(track, hypotheses=look.hypotheses)
            return Update(look.change, look.hypotheses, 0, look.agreement, 0.0)
        return self.keep(look, infer_view(look._view, self.prior, self.config, **self._asked(look, limits, callbacks)))

    def begin(self, look: Look, limits: Limits = NO_LIMITS, callbacks: Callbacks = NO_CALLBACKS) -> Inference:
        """The sampling that a look requires, to be done in steps; its estimate is for `keep`."""
        return Inference(look._view, self.prior, self.config, **self._asked(look, limits, callbacks))

    def _asked(self, look: Look, limits: Limits, callbacks: Callbacks) -> dict[str, Any]:
        before, track = None, look._track
        if look.change == Change.CONTINUED and track is not None:
            estimates = np.asarray(track.posterior.diagnostics.log_evidences)
            before = track.posterior if np.isfinite(estimates).all() else None
        callbacks = replace(callbacks, guess=callbacks.guess and look.hypotheses is None)
        return {"seed": look.seed, "before": before, "limits": limits, "callbacks": callbacks}

    def keep(self, look: Look, result: Estimate) -> Update:
        """Store what a look's sampling found."""
        track = look._track
        self._tracks[look.object_id] = _Track(
            anchor=look._view.object_frame if track is None else track.anchor,
            first=look._view.frame if track is None else track.first,
            kept=look._kept,
            seen=look._view.seen,
            posterior=result.posterior,
            hypotheses=result.hypotheses,
            inferences=1 + (0 if track is None else track.inferences),
        )
        self._tracks[look.object_id] = self._tracks.pop(look.object_id)  # the last seen is the last
        for name in list(self._tracks)[: -self.track.objects]:
            del self._tracks[name]
        return Update(look.change, result.hypotheses, result.hypotheses.stage, look.agreement, result.seconds)

    def _name(self, frame: Frame, segment: Segment, found: ObjectFrame) -> int:
        """The id of the object that a segment shows: by its label, or else by its place; a new id for a new object."""
        if frame.label is not None:
            return segment.id
        distances = {}
        for name, track in self._tracks.items():
            cube = track.anchor.seen_from(_moved_by(track.first, frame))
            apart = float(np.linalg.norm(cube.T_camera_object[:3, 3] - found.T_camera_object[:3, 3]))
            distances[name] = apart / (self.track.reach * cube.half_extent)
        best = min(distances, key=lambda name: distances[name], default=None)
        if best is not None and distances[best] < 1.0:
            return best
        name = max(self._names) + 1 if segment.id in self._names else segment.id
        self._names.add(name)
        return name

    def _go_on(self, name: int, track: _Track, view: ConditionedView, agreement: float, seed: int) -> Look:
        """The look at an object that has not moved."""
        seen = seen_voxels(view.frame, view.segment, view.object_frame, self.config.grid)
        hidden = above_plane(self.config.grid) & ~track.seen
        adds = float((hidden & seen).sum()) / max(int(hidden.sum()), 1) >= self.track.adds
        kept = track.kept
        whole = track.posterior.result == StopReason.CONVERGED
        change = Change.SAME if whole else Change.CONTINUED
        if adds:
            kept = _with_view(kept, _Kept(view.observations, _direction(view.object_frame)), self.track)
            change = Change.VIEW
        h = replace(
            track.hypotheses,
            stamp_ns=view.frame.stamp_ns,
            frame_id=view.frame.frame_id,
            object_frame=view.object_frame,
            T_world_camera=view.frame.T_world_camera,
        )
        together = tuple(joined(each) for each in zip(*(k.observations for k in kept), strict=True))
        view = replace(view, observations=together, seen=track.seen | seen)
        return Look(name, change, agreement, h, seed, view, kept, track)

    def _agreement(self, posterior: Posterior, observation: Observation) -> float:
        """The largest share of the telling pixels that one of a few samples explains."""
        chosen, _, _ = thin(posterior, self.track.checked)
        likelihood = without_sizes(likelihood_of(self.config.infer, observation))
        positions = on_device(np.asarray(posterior.positions)[chosen])
        shares = explained(self.prior.model, likelihood, observation, positions)
        return float(np.max(np.asarray(shares)))


def _moved_by(first: Frame, now: Frame) -> Float[np.ndarray, "4 4"]:
    """T_now_first between the cameras of two frames: the identity if either pose is unknown."""
    if first.T_world_camera is None or now.T_world_camera is None:
        return np.eye(4)
    return np.linalg.inv(now.T_world_camera) @ first.T_world_camera


def _same_plane(a: Float[np.ndarray, "4"], b: Float[np.ndarray, "4"], config: TrackConfig) -> bool:
    turned = np.degrees(np.arccos(np.clip(a[:3] @ b[:3], -1.0, 1.0)))
    return bool(turned <= config.plane_degrees and abs(a[3] - b[3]) <= config.plane_m)


def _direction(cube: ObjectFrame) -> Float[np.ndarray, "3"]:
    at = cube.to_cube(np.zeros(3))
    return at / np.linalg.norm(at)


def _with_view(kept: tuple[_Kept, ...], new: _Kept, config: TrackConfig) -> tuple[_Kept, ...]:
    """The views with a further one: in place of the nearest one if that is near, or if there are enough."""
    cosine = [float(k.direction @ new.direction) for k in kept]
    nearest = int(np.argmax(cosine))
    if len(kept) >= config.views or cosine[nearest] > np.cos(np.radians(config.apart)):
        kept = kept[:nearest] + kept[nearest + 1 :]
    return (*kept, new)
