"""Options of `farside batch` (as `options`: only modules without JAX are imported here)."""

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional, Suppress, arg

from node.commands.options import FrameOptions
from perception.inference.settings import ControllerConfig
from probnerf.settings import Method


@dataclass(frozen=True)
class BatchConfig(FrameOptions):
    """Infer the objects of many logs, on one machine or many; what is done already is not done again.

    Each object of each log, with each seed, is written by itself, whole or not at all; a table (Parquet) lists them.
    """

    source: Annotated[Path | None, Suppress] = None  # each of the logs in its turn
    logs: Annotated[Positional[tuple[str, ...]], arg(metavar="LOGS", help_behavior_hint="(required)")] = ()
    """Recordings, frame folders and frames in one file, as `farside replay` reads them; folders of these; globs (in
    quotes); paths, or URLs that fsspec reads (s3://bucket/logs)."""
    out: Annotated[str | None, arg(metavar="URL", help_behavior_hint="(required)")] = None
    """Folder or URL for the results: logs/LOG/seed_N/object_ID.npz, and table.parquet. It holds results of one prior
    and one set of settings."""
    seeds: Annotated[int, arg(metavar="N")] = 1
    """Infer each object with the seeds 0 to N - 1."""
    shard: Annotated[str | None, arg(metavar="I/N", help_behavior_hint="(default: all)")] = None
    """Do the I-th of N parts, I from 0 to N - 1, such as $SLURM_ARRAY_TASK_ID/100; --table-only makes the table of all
    parts when they are done."""
    workers: Annotated[int, arg(metavar="K")] = 1
    """Processes of this machine that infer. Each has its own memory of 1 to 2 GB."""
    retry_failed: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Do what failed once more."""
    table_only: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Only make the table, of all results that are there."""
    dask: Annotated[str | None, arg(metavar="ADDRESS", help_behavior_hint="(default: no Dask)")] = None
    """Work on the cluster of this Dask scheduler (tcp://host:8786), or, with `local`, on a new one of --workers
    processes. Needs `farside[cluster]`."""
    stages: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: until it has converged)")] = None
    """Stop the sampler after N stages."""
    budget: Annotated[float | None, arg(metavar="SECONDS", help_behavior_hint="(default: no limit)")] = None
    """Time for each object. Results then depend on how fast the machine is."""
    method: Annotated[
        Method | None,
        arg(metavar="{tempered_smc,annealed_hmc}", help_behavior_hint="(default: tempered_smc)"),
    ] = None
    """Sampler: weighted tempered populations, or the annealed chains of the ProbNeRF paper."""
    prior: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: the shipped one)")] = None
    """Weights of another prior (.safetensors, as `farside train` writes them)."""
    controller: ControllerConfig = field(default_factory=ControllerConfig)

    def __post_init__(self) -> None:
        if self.budget is not None and not self.budget > 0:
            raise ValueError(f"the budget is {self.budget:g} s; give more than 0")
        for name in ("stages", "seeds", "workers"):
            if (value := getattr(self, name)) is not None and value < 1:
                raise ValueError(f"{name} is {value}; give 1 or more")
        self.part  # noqa: B018  a shard that is none is named at once

    @property
    def part(self) -> tuple[int, int]:
        """Which of how many parts of the work is to be done. Raises `ValueError` for a shard that is none."""
        if self.shard is None:
            return 0, 1
        if (found := re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", self.shard)) is None:
            raise ValueError(f"the shard is {self.shard!r}; give I/N, such as 0/8")
        i, n = int(found[1]), int(found[2])
        if i >= n:
            parts = f"the parts of {n} are 0/{n} to {n - 1}/{n}" if n else "there are no parts of 0"
            raise ValueError(f"the shard is {self.shard}; {parts}")
        return i, n

    @property
    def inference(self) -> ControllerConfig:
        """The controller's configuration with the chosen method."""
        if self.method is None:
            return self.controller
        return replace(self.controller, infer=replace(self.controller.infer, method=self.method))
