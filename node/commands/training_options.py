"""Options of the commands that train (as `options`: only modules without JAX are imported here)."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import arg

from probnerf.training.settings import PosteriorTrainConfig, TrainConfig


@dataclass(frozen=True)
class Training:
    """Train a prior on procedural objects and meshes, or on pictures of your own; resumes by itself after a stop."""

    out: Path = Path("runs/tabletop")
    """Folder of the run: checkpoint, history, curves.png and, in the end, prior.safetensors."""
    preset: Literal["household", "small", "paper", "tiny"] = "small"
    """Sizes of the model: small (vessels and cartons), household (all kinds of things), the paper's, or tiny for a
    trial."""
    start: Path | None = None
    """Initial weights, of the same preset. Give --frozen-steps with it, unless NAME.recognition.safetensors lies beside
    it. Random by default."""
    objects: int = 40_000
    """Vessels and cartons: the first seeds of the tabletop family."""
    household: int = 0
    """Things of the household generator: its first seeds. This and --meshes need the extra packages of
    `farside[meshes]`."""
    meshes: tuple[Path, ...] = ()
    """Folders of meshes to learn from (.glb, .gltf, .obj, .ply, .stl; metres; y is up in .glb and .gltf, z in the
    others). One class of names in ten is left for validation."""
    variants: int = 8
    """Variants of each mesh, stretched and in other resting poses; a household thing gets a quarter of them."""
    pictured: int = 4_000
    """How many of them, from the first, are also seen in pictures."""
    data: Path | None = None
    """Train on the posed pictures in this folder alone (SRN layout, as `farside capture` writes it), not on tabletop
    objects. Every step is one of rays then: --solid-steps is 0, --learning-rate holds throughout, and --objects and
    --pictured are not read."""
    pictures: int | None = None
    """Pictures of each of them; 8 by default, or all with --data."""
    coordinator: Annotated[str | None, arg(metavar="HOST:PORT", help_behavior_hint="(default: one process)")] = None
    """Train in several processes, on one machine or many: where process 0 is, with any free port. Under Slurm or Open
    MPI `auto`, without the next two. --batch and --ray-batch are of all processes together."""
    processes: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """How many processes; each is started with the same options, but for --process."""
    process: Annotated[int | None, arg(metavar="I", help_behavior_hint="")] = None
    """Which of them this is, from 0 to N - 1. Process 0 reads and writes checkpoint, history and weights in --out."""
    recipe: tyro.conf.OmitArgPrefixes[TrainConfig] = field(default_factory=TrainConfig)

    def __post_init__(self) -> None:
        told = self.coordinator not in (None, "auto")
        if {told} != {self.processes is not None, self.process is not None}:
            raise ValueError("several processes need --coordinator HOST:PORT, --processes and --process; or auto alone")
        port = re.fullmatch(r".+:([0-9]{1,5})", str(self.coordinator))
        if told and not (port and 0 < int(port[1]) < 1 << 16):  # gRPC waits for ever at another
            raise ValueError(f"--coordinator is {self.coordinator}; give HOST:PORT of process 0, or auto")
        if self.processes is not None and self.processes < 1:
            raise ValueError(f"--processes is {self.processes}; give 1 or more")
        if self.processes is not None and self.process is not None and not 0 <= self.process < self.processes:
            raise ValueError(f"--process is {self.process} of {self.processes}; give 0 to {self.processes - 1}")


@dataclass(frozen=True)
class NetworkTraining:
    """Train a prior's posterior network on simulated pictures of the objects that it learnt; resumes after a stop."""

    run: Path = Path("runs/tabletop")
    """Folder of a finished run of `farside train`. It gets the pictures, network/ (checkpoint, history, curves.png)
    and, in the end, prior.network.safetensors."""
    start: Path | None = None
    """Prior whose posterior network is where training begins: of this run or an earlier one. Random by default."""
    plain: int = 100_000
    """Plain pictures: one object alone, cheap to draw. They teach how whole shapes look."""
    pictures: int = 20_000
    """Pictures of scenes, as perception sees them; those that it refuses count. All are kept for later runs."""
    image_size: int = 32
    """Pixels a side of a picture."""
    processes: int | None = None
    """How many processes draw pictures; all processors by default."""
    recipe: tyro.conf.OmitArgPrefixes[PosteriorTrainConfig] = field(default_factory=PosteriorTrainConfig)
