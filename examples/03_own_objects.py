"""A prior of your own objects: from posed pictures to weights, and an answer with them.

    python examples/03_own_objects.py DATA      # as `farside capture` writes it with a turntable (SRN layout)
    python examples/03_own_objects.py           # makes a few pictures of simulated mugs, so that it runs anywhere

The simulated run takes a minute and is far too short for a useful prior: it shows the steps. docs/teaching.md says how
many pictures and steps a useful one takes.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np

import farside
from probnerf.training.pictures import draw_views
from probnerf.training.srn_dataset import Instance, write_instance

SIZE, VIEWS, OBJECTS = 32, 6, 4


def simulated_pictures(folder: Path) -> Path:
    """A data set of the simulator's tabletop objects, one folder each: rgb/, pose/ and intrinsics.txt."""
    views = draw_views(np.arange(OBJECTS), VIEWS, SIZE)
    for i in range(OBJECTS):
        focal = 0.5 * SIZE / float(views.tan_half_fov[i, 0])
        pictures = Instance(
            name=f"object_{i}",
            focal=focal,
            centre=(SIZE / 2, SIZE / 2),
            barycentre=(0.0, 0.0, 0.0),
            scale=2.0,  # the cube [-1, 1]^3
            rgb=views.rgb[i],
            mask=views.range[i] != 0.0,
            T_world_camera=views.T_object_camera[i].astype(np.float64),
        )
        write_instance(folder, pictures)
    return folder


def main(data: str | None = None, run: str = "runs/own_objects", steps: int = 200) -> farside.Scene:
    """Train a tiny prior on the pictures and infer a frame with it."""
    folder = Path(data) if data else simulated_pictures(Path(run) / "data")
    train = ["train", "--data", str(folder), "--out", run, "--preset", "tiny", "--steps", str(steps)]
    subprocess.run([sys.executable, "-m", "farside", *train], check=True)  # resumes by itself after a stop
    prior = farside.load_prior(Path(run) / "prior.safetensors")
    frame = farside.read_frame()  # put a view of your own object here
    scene = farside.estimate(frame, farside.segment(frame, 1), prior=prior, stages=4, budget_s=None)
    for h in scene:
        explained = "explained by" if not h.out_of_model else "not explained by"
        print(f"object {h.object_id} is {explained} the new prior ({len(h.weights)} hypotheses)")
    return scene


if __name__ == "__main__":
    try:
        main(sys.argv[1] if sys.argv[1:] else None)
    except (ValueError, OSError, subprocess.CalledProcessError) as error:
        raise SystemExit(f"error: {error}") from None
