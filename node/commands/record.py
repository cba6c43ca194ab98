"""`farside record`: frames of a source into a file, with a progress line."""

from rich.console import Console

from node.commands.options import Record
from perception.sources.playback import open_playback
from perception.sources.recorder import Recorder
from perception.sources.topic_names import TopicNames


def record(options: Record, out: Console, err: Console) -> None:
    """Record until the source ends, the time is over or Ctrl-C, and print what was recorded.

    Frames of a live source that come too fast to be written are dropped and counted; a recording's frames are not.
    Raises OSError if writing fails (the written part stays), ValueError if the source gave no frame.
    """
    if options.seconds is not None and not options.seconds > 0:
        raise ValueError(f"--seconds is {options.seconds:g}; give more than 0")
    topics = TopicNames(options.colour_topic, options.depth_topic)
    source = open_playback(options.source, 0.0, options.start_s, options.end_s, topics=topics)
    recorder = Recorder(options.out, options.recording, wait=not source.live)
    first_ns = last_ns = None
    try:
        with recorder, err.status("recording; Ctrl-C ends it") as status:
            try:
                for frame in source:
                    first_ns = frame.stamp_ns if first_ns is None else first_ns
                    if options.seconds is not None and frame.stamp_ns - first_ns >= 1e9 * options.seconds:
                        break
                    recorder.write_frame(frame)
                    last_ns = frame.stamp_ns
                    if recorder.error is not None:
                        break
                    status.update(f"recording; Ctrl-C ends it: {_tally(recorder, last_ns - first_ns)}")
            except KeyboardInterrupt:
                pass  # the usual way to end it
        if recorder.error is not None:
            raise OSError(recorder.error)
        if not recorder.frames or first_ns is None or last_ns is None:
            raise ValueError(f"{options.source} gave no frame to record")
    finally:
        if not recorder.frames:
            options.out.unlink(missing_ok=True)
    for note in source.notes:
        err.print(f"note: {note}", highlight=False, soft_wrap=True)
    out.print(f"{options.out}: {_tally(recorder, last_ns - first_ns)}", highlight=False, soft_wrap=True)


def _tally(recorder: Recorder, span_ns: int) -> str:
    """Frames, rate, dropped, size."""
    rate = f" over {span_ns / 1e9:.1f} s ({(recorder.frames - 1) * 1e9 / span_ns:.1f} per s)" if span_ns > 0 else ""
    return f"{recorder.frames} frames{rate}, {recorder.dropped} dropped, {recorder.bytes / 1e6:.1f} MB"
