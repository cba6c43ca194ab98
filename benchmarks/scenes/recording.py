"""Frames of the shipped recording with a camera's noise, 30 a second."""

from dataclasses import replace

import numpy as np

from perception.sources.frame import Frame
from perception.sources.open_source import open_source

NOISE = 2.0  # counts, standard deviation of each pixel's colour
REALTIME = 30.0  # frames per second that a camera gives


def noisy(count: int) -> list[Frame]:
    """Frames at 30 per second; a few different ones, over and over."""
    still = list(open_source(None))
    rng = np.random.default_rng(0)
    several = []
    for frame in still:
        rgb = frame.rgb + rng.normal(0.0, NOISE, frame.rgb.shape)
        several.append(replace(frame, rgb=np.clip(np.rint(rgb), 0, 255).astype(np.uint8)))
    start = still[0].stamp_ns
    return [replace(several[i % len(several)], stamp_ns=start + round(i * 1e9 / REALTIME)) for i in range(count)]
