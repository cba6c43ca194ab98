"""`farside replay --schedule`: repeat the inferences of a recording, and compare the results."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from rich.console import Console

from calibration.camera_file import read_camera
from foundation.whole_file import check_folder
from node.commands.options import ReplayConfig
from node.commands.progress import InferenceProgress
from node.commands.replay import publish
from perception.inference.limits import Callbacks, Limits
from perception.inference.schedule import config_hash, digest
from perception.inference.tracker import Look, Tracker
from perception.observation.segmentation import Segment, segment
from perception.sources.frame import Frame
from perception.sources.playback import Playback, open_playback
from perception.sources.schedule_entry import Scheduled
from perception.sources.settings import SHIPPED_LOG
from probnerf.prior.checkpoint import Prior, load_prior
from probnerf.types import StopReason


def follow(config: ReplayConfig, out: Console, err: Console) -> bool:
    """Repeat the inferences of a recording's schedule, frame by frame. Returns False if Ctrl-C ended it.

    Results go to `<folder>/<stamp>/object_<id>.npz` and are compared with the schedule's digests. An inference that
    continued from an earlier frame continues from the repeat of that frame. Raises ValueError in one line, before
    anything is written, if there is no schedule, or if the prior or the configuration differs.
    """
    check_folder(config.folder)
    path = config.source or SHIPPED_LOG
    camera = None if config.camera is None else read_camera(config.camera)
    playback = open_playback(config.source, 0.0, config.start_s, config.end_s, camera, config.topics)
    entries = playback.log.schedule() if isinstance(playback, Playback) else []
    wanted = [entry for entry in entries if config.object in (None, entry.object_id)]
    if not wanted:
        whose = "" if config.object is None else f" for object {config.object}"
        raise ValueError(f"{path} has no schedule{whose}; omit --schedule")
    prior = load_prior(config.prior)
    _check(path, entries, prior, config)
    # Without labels an object's id depends on the objects inferred before, so these are inferred too.
    last = max(entry.stamp_ns for entry in wanted)
    by_stamp: dict[int, list[Scheduled]] = {}
    for entry in (entry for entry in entries if entry.stamp_ns <= last):
        by_stamp.setdefault(entry.stamp_ns, []).append(entry)
    tracker = Tracker(prior, config.inference, config.track)
    done = same = 0
    stamps = []
    for frame in playback:
        stamps.append(frame.stamp_ns)
        if not (scheduled := by_stamp.get(frame.stamp_ns)):
            continue
        looks = _looks(tracker, frame, scheduled, config, err)
        for entry in scheduled:
            if entry.object_id not in looks:
                err.print(f"object {entry.object_id} is not in the frame at {frame.stamp_ns} ns", highlight=False)
                continue
            found, look = looks[entry.object_id]
            if entry not in wanted and frame.label is not None:
                continue
            with InferenceProgress([entry.object_id], entry.stages, None, err) as progress:
                callbacks = Callbacks(partial(progress.on_stage, entry.object_id))
                update = tracker.infer(look, Limits(stages=entry.stages), callbacks)
            if entry not in wanted:
                continue
            folder = config.folder / str(frame.stamp_ns)
            publish(folder, frame, found, update.hypotheses, update.seconds, out)
            if update.hypotheses.result == StopReason.INTERRUPTED:
                return False
            done += 1
            if digest(update.hypotheses) == entry.digest:
                same += 1
            else:
                out.print("  differs from what came out when it was recorded", style="yellow", highlight=False)
    lost = sum(stamps[0] <= stamp <= stamps[-1] and stamp not in stamps for stamp in by_stamp)
    notes = list(playback.notes)
    if lost:
        notes.append(f"{lost} frames of the schedule are not in {path.name}")
    for note in notes:
        err.print(f"note: {note}", highlight=False, soft_wrap=True)
    if not done:
        raise ValueError(f"{path} has nothing in this range whose inference can be repeated; widen --from and --to")
    out.print(f"{same} of {done} inferences came out as they did when they were recorded", highlight=False)
    return True


def _looks(
    tracker: Tracker, frame: Frame, scheduled: Sequence[Scheduled], config: ReplayConfig, err: Console
) -> dict[int, tuple[Segment, Look]]:
    """The objects of a frame that are in the schedule, by id."""
    how = {entry.object_id: (entry.seed, entry.started_from == "fresh") for entry in scheduled}
    looks = {}
    try:
        segments = segment(frame, None, config.segmentation)
    except ValueError as error:
        err.print(f"frame at {frame.stamp_ns} ns is left out: {error}", highlight=False, soft_wrap=True)
        return {}
    for found in segments:
        try:
            look = tracker.look(frame, found, how.get)
        except ValueError as error:
            err.print(f"object {found.id} is left out: {error}", highlight=False, soft_wrap=True)
            continue
        if look is not None:
            looks[look.object_id] = (found, look)
    return looks


def _check(path: Path, entries: Sequence[Scheduled], prior: Prior, config: ReplayConfig) -> None:
    """Raises ValueError if another prior or configuration was recorded."""
    current = config_hash(config.inference, config.segmentation, config.track)
    without_track = config_hash(config.inference, config.segmentation)  # what Farside before 0.2.0 recorded
    for entry in entries:
        if entry.prior_hash != prior.identity:
            raise ValueError(
                f"{path} was recorded with prior {entry.prior_hash}, and this one is {prior.identity}; give that one's"
                " file with --prior"
            )
        if entry.config_hash == without_track:
            raise ValueError(
                f"{path} was recorded by Farside before 0.2.0, whose schedules do not tell of the tracker's settings;"
                " record it again, or replay it with the version that recorded it"
            )
        if entry.config_hash != current:
            raise ValueError(
                f"{path} was recorded with configuration {entry.config_hash}, and this one is {current}; give that one"
                " with --config and --method"
            )
