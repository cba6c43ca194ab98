"""Settings of recordings and of OAK cameras. Standard library only: the command line reads them without OpenCV."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

# The recording that ships with the project, read when no source is named.
SHIPPED_LOG = Path(__file__).parent / "shipped.mcap"


@dataclass(frozen=True)
class RecordConfig:
    """How frames are encoded, and how much a killed recorder may lose."""

    # Processor time and size of a frame of 640x480 with a sensor's noise, roughly, on a busy core: 12 ms and 1.2 MB raw
    # with lz4 (8 and 1.5 with none, 23 and 0.8 with zstd), 18 ms and 0.7 MB with PNG, 7 ms and 0.3 MB with JPEG; depth
    # as PNG would take longer than zstd for the same size. `farside bench record` measures it.

    colour: Literal["raw", "png", "jpeg"] = "raw"
    """raw takes the least time. png is exact and takes more time and less space. jpeg takes the least space but is not
    exact: its hypotheses differ from those made live."""
    jpeg_quality: int = 95
    """1 to 100."""
    depth: Literal["exact", "millimetres"] = "exact"
    """exact: 16UC1 if depth is in whole millimetres, else 32FC1. millimetres: rounded, always 16UC1, 0 beyond 65 m."""
    compression: Literal["none", "lz4", "zstd"] = "lz4"
    """Compression of the file, in order from least time to least space."""
    chunk_bytes: int = 8 << 20
    """Size of the file's chunks before compression."""
    flush_s: float = 0.5
    """Seconds after which a chunk is written even if it is not full. A killed recorder loses no more than that."""
    waiting: int = 60
    """Frames and messages that may wait for the writer; 60 are two seconds of a camera."""

    def __post_init__(self) -> None:
        if not 1 <= self.jpeg_quality <= 100:
            raise ValueError(f"jpeg_quality is {self.jpeg_quality}; give 1 to 100")
        if not self.flush_s > 0 or min(self.chunk_bytes, self.waiting) < 1:
            raise ValueError(
                f"flush_s {self.flush_s:g}, chunk_bytes {self.chunk_bytes} and waiting {self.waiting} must be positive"
            )


OakPreset = Literal[
    "FAST_ACCURACY", "FAST_DENSITY", "DEFAULT", "FACE", "HIGH_DETAIL", "ROBOTICS", "DENSITY", "ACCURACY"
]


@dataclass(frozen=True)
class OakConfig:
    """How an OAK camera is used."""

    width: int = 640  # px, of colour and depth
    height: int = 480  # px
    fps: float = 30.0
    preset: OakPreset | None = None
    """Preset of DepthAI's StereoDepth; None: its defaults with the left-right check and subpixels."""
    confidence: int | None = None
    """0 to 255, threshold of the disparity's confidence as DepthAI counts it: less keeps fewer and surer pixels; the
    others have no depth. None: the preset's."""
    tolerance_ms: float = 10.0  # between colour and depth of one frame
    undistort: bool = True  # by the device, which aligns depth to the undistorted image: else they differ at the edges
    silence_s: float = 5.0  # without a frame: the camera counts as lost
    retry_s: float = 0.5  # after a loss, doubled up to `longest_retry_s`
    longest_retry_s: float = 8.0

    def __post_init__(self) -> None:
        for name in ("width", "height", "fps", "tolerance_ms", "silence_s", "retry_s", "longest_retry_s"):
            if not getattr(self, name) > 0:
                raise ValueError(f"oak: {name} is {getattr(self, name)}; give more than 0")
        if self.confidence is not None and not 0 <= self.confidence <= 255:
            raise ValueError(f"oak: confidence is {self.confidence}; give 0 to 255")
