"""Where compiled code is kept between processes, and the variables to set before JAX and OpenCV are imported. Imports
neither."""

import os
from pathlib import Path

MOST_PIXELS = 1 << 26  # of a picture that is decoded


def cache_folder() -> Path:
    """`farside` in the user's cache folder."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "farside"


def prepare() -> None:
    """Set the variables of this process that JAX and OpenCV read when first imported; what is set already stays.

    Compiled programs outlive the process: `probnerf.compile_cache` keeps the large ones, JAX the small ones.
    """
    cache = str(cache_folder())
    os.environ.setdefault("FARSIDE_PROGRAMS", cache)
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", cache)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    # Only fatal messages: jaxlib 0.10.1 takes its own kept programs for another machine's, at every start.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    # A picture's header may say any size: for a gigapixel OpenCV takes 6 GB and a minute, even if nothing follows it.
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MOST_PIXELS))
    # One device per core, to share particles out; a power of two divides their number.
    os.environ.setdefault("JAX_NUM_CPU_DEVICES", str(1 << min((os.cpu_count() or 1).bit_length() - 1, 4)))
