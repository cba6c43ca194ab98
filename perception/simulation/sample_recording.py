"""The recording that ships with the project, and the program that makes it.

`python -m perception.simulation.sample_recording` writes it again.

A mug with its handle turned away from the camera, so that no pixel shows where the handle is, and a low carton that
hides the mug's lower corner. No label map: the objects are found as in any recording.
"""

from collections.abc import Iterator

import numpy as np

from calibration.camera import Camera
from perception.simulation.sensor_faults import SensorConfig, sense
from perception.simulation.simulated_camera import PlacedObject, TableScene, place_camera, render
from perception.sources.frame import Frame
from perception.sources.recorder import write_log
from perception.sources.settings import SHIPPED_LOG

CAMERA = Camera(640, 480, np.array([[612.0, 0.0, 322.4], [0.0, 612.0, 238.7], [0.0, 0.0, 1.0]]), np.zeros(5))
T_WORLD_CAMERA = place_camera((0.46, 0.0, 0.29), (0.0, 0.01, 0.03))
MUG = PlacedObject(seed=2_900_727, x=-0.02, y=0.0, yaw=np.deg2rad(172.0))  # test seeds: no prior was trained on these
CARTON = PlacedObject(seed=2_900_483, x=0.068, y=0.034, yaw=np.deg2rad(25.0))
SCENE = TableScene((MUG, CARTON))
SENSOR = SensorConfig(colour_noise=0.002, max_range=1.6)  # little noise and no wall: the file stays small
START_NS, STEP_NS, FRAMES = 1_790_000_000_000_000_000, 100_000_000, 5


def frames() -> Iterator[Frame]:
    """The same view at 10 Hz; only the sensor's noise differs."""
    picture = render(SCENE, CAMERA, T_WORLD_CAMERA)
    for i in range(FRAMES):
        frame = sense(picture, CAMERA, T_WORLD_CAMERA, seed=i, config=SENSOR, stamp_ns=START_NS + i * STEP_NS)
        yield Frame(frame.rgb, frame.depth, frame.camera, stamp_ns=frame.stamp_ns, frame_id=frame.frame_id)


if __name__ == "__main__":
    count = write_log(SHIPPED_LOG, frames())
    print(f"{SHIPPED_LOG}: {count} frames, {SHIPPED_LOG.stat().st_size / 1e6:.2f} MB")
