"""Training a prior: the views, the run (resumed after a stop), its curves, and the weights at the end."""

import json
import os
import subprocess
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from foundation.whole_file import check_folder, write_whole
from node.commands.training_options import Training
from node.figures.object_figure import draw_training
from probnerf.likelihood.settings import Likelihood
from probnerf.objects.tabletop import TRAIN_SEEDS
from probnerf.prior.checkpoint import load_prior, load_recognition, recognition_path, save_prior, save_recognition
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.rendering import foam
from probnerf.training import elbo as training
from probnerf.training.pictures import ViewSet, draw_views
from probnerf.training.processes import Mesh, is_first, joined
from probnerf.training.shape_set import ShapeSet, load_shapes
from probnerf.training.srn_dataset import read_views
from probnerf.training.tabletop_shapes import tabletop_shapes

LEARNT = "learnt.json"  # in the folder of a finished run: which objects it learnt
TABLETOP_SHARE = 0.4  # of a batch, where there are other things; these share the rest by their numbers


def train(options: Training, out: Console, err: Console) -> bool:
    """Train, or continue an earlier run of the same recipe in `options.out`. False after Ctrl-C.

    Raises ValueError if the folder holds another recipe, FloatingPointError if the loss is not finite, ConnectionError
    if one of several processes is lost.
    """
    where, processes, process = options.coordinator, options.processes, options.process
    try:
        with nullcontext() if where is None else joined(where, processes, process) as mesh:
            _train(options, mesh, out, err)
    except KeyboardInterrupt:
        out.print("stopped; the same command continues from the last checkpoint", highlight=False)
        return False
    return True


def _train(options: Training, mesh: Mesh | None, out: Console, err: Console) -> None:
    preset, config, folder = PRESETS[options.preset], options.recipe, options.out
    check_folder(folder)
    if options.data is not None:  # there is no phase that trains only the decoder
        config = replace(config, solid_steps=0, ray_learning_rate=config.learning_rate)
    if not 1 <= options.objects <= len(TRAIN_SEEDS):
        raise ValueError(f"--objects is {options.objects}; give 1 to {len(TRAIN_SEEDS)}")
    if not 0 <= options.household <= len(TRAIN_SEEDS):
        raise ValueError(f"--household is {options.household}; give 0 to {len(TRAIN_SEEDS)}")
    for name in ("pictured", "pictures", "variants"):
        if (value := getattr(options, name)) is not None and value < 1:
            raise ValueError(f"--{name} is {value}; give 1 or more")
    begun = None if options.start is None else load_prior(options.start, preset=options.preset)
    recognition = None
    if options.start is not None and begun is not None and recognition_path(options.start).is_file():
        recognition = load_recognition(recognition_path(options.start), begun)
    key = np.array([0, config.seed], np.uint32)  # a raw key
    model = ProbNeRF(preset, key) if begun is None else begun.model  # type: ignore[arg-type]
    weights = folder / "prior.safetensors"
    likelihood = Likelihood(lattice=foam.Lattice(preset.lattice, 1.0, 9 * preset.lattice // 4))
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    state = None
    with (
        Progress(*columns, TimeRemainingColumn(), console=err, disable=not err.is_terminal) as progress,
        drawn_curves(folder, out),
    ):
        solids, views, story = _material(options, preset.image_size, progress)
        steps = progress.add_task("steps", total=config.steps)
        for state, metrics in training.train(  # noqa: B007
            model, solids, views, likelihood, config, folder, recognition, mesh
        ):
            text = "steps  " + "  ".join(f"{k} {v:.4g}" for k, v in metrics.items() if k != "step")
            progress.update(steps, completed=int(metrics["step"]), description=text)
    if not is_first():
        return
    if state is None:
        out.print(f"{folder} is trained already", highlight=False, soft_wrap=True)
        return
    story |= {
        "recipe": asdict(config),
        "steps": int(state.step),
        "revision": revision(),
        "start": None if begun is None else {"hash": begun.hash, **begun.metadata},
        "gate": None,
    }
    save_prior(weights, state.model, story, half=preset.name == "household")
    if options.data is None:
        save_recognition(recognition_path(weights), state.recognition, load_prior(weights).hash)
        learnt = {name: getattr(options, name) for name in ("objects", "household", "variants")}
        learnt["meshes"] = [os.path.relpath(meshes, folder) for meshes in options.meshes]
        write_whole(folder / LEARNT, json.dumps(learnt, indent=1).encode())
    out.print(f"{weights}; judge it with `farside bench prior --prior {weights}`", highlight=False, soft_wrap=True)


@contextmanager
def drawn_curves(folder: Path, out: Console) -> Iterator[None]:
    """Draws a run's history in the end, however that comes."""
    try:
        yield
    finally:
        history, curves = folder / "history.jsonl", folder / "curves.png"
        if is_first() and history.is_file() and (lines := history.read_text(encoding="utf-8").splitlines()):
            rows = list[dict[str, Any]]()
            with suppress(ValueError):  # a line that is damaged, which the run itself has named
                rows = [json.loads(line) for line in lines]
            if rows:
                draw_training(curves, rows)
                out.print(str(curves), highlight=False, soft_wrap=True)


def learnt_objects(run: Path) -> dict[str, Any]:
    """Which objects the finished run of this folder learnt: `objects`, `household`, `variants` and `meshes` of its
    options, the last as paths from the folder.

    Raises FileNotFoundError if the run does not tell.
    """
    path = run / LEARNT
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; give the folder of a run of `farside train` without --data")
    return json.loads(path.read_text(encoding="utf-8"))


def _material(
    options: Training, size: int, progress: Progress
) -> tuple[list[tuple[ShapeSet, float]], ViewSet, dict[str, Any]]:
    """The training data, and their description for the weights' metadata."""

    def advance(task: TaskID) -> Callable[[int, int], None]:
        return lambda done, total: progress.update(task, completed=done, total=total)

    if options.data is not None:
        reading = progress.add_task("objects", total=None)
        views = read_views(options.data, size, options.pictures, advance(reading))
        return [], views, {"family": "srn", "data": options.data.name, "objects": len(views.seeds)}
    sampling = progress.add_task("objects", total=options.objects)
    seeds = np.asarray(TRAIN_SEEDS[: options.objects])
    tabletop = _kept(
        options.out / "shapes" / f"tabletop-{options.objects}.npz", lambda: tabletop_shapes(seeds, advance(sampling))
    )
    others = _mesh_sets(options, progress, advance)
    pictured, pictures = min(options.pictured, options.objects), options.pictures or 8
    drawing = progress.add_task("pictures", total=pictured)
    views = draw_views(seeds[:pictured], pictures, size, progress=advance(drawing))
    seed_range = [TRAIN_SEEDS.start, TRAIN_SEEDS.start + options.objects]
    story = {"family": "tabletop", "seeds": seed_range, "pictured": pictured, "pictures": pictures}
    if others:
        story |= {"family": "household", "others": {name: len(each) for name, each in others.items()}}
    share = TABLETOP_SHARE if others else 1.0
    total = sum(len(each) for each in others.values())
    sets = [(tabletop, share), *((each, (1.0 - share) * len(each) / total) for each in others.values())]
    return sets, views, story


def _mesh_sets(
    options: Training, progress: Progress, advance: Callable[[TaskID], Callable[[int, int], None]]
) -> dict[str, ShapeSet]:
    """Shapes of the household generator and of every folder of meshes, by name; what was left out is printed."""
    if not options.household and not options.meshes:
        return {}
    require_mesh_libraries()
    from probnerf.training import mesh_shapes  # only here: it needs them

    folder, found = options.out / "shapes", {}
    each = household_variants(options.variants)
    if options.household:
        task = progress.add_task("household", total=options.household)
        found["household"] = _kept(
            folder / f"household-{options.household}x{each}.npz",
            lambda: mesh_shapes.household_shapes(TRAIN_SEEDS[: options.household], each, advance(task)),
        )
    for meshes in options.meshes:
        task = progress.add_task(meshes.name, total=None)

        def make(meshes: Path = meshes, task: TaskID = task) -> ShapeSet:
            shapes, left_out = mesh_shapes.folder_shapes(meshes, options.variants, progress=advance(task))
            for line in left_out:
                progress.console.print(f"left out {line}", highlight=False, soft_wrap=True)
            return shapes

        path = f"{meshes.name}-{zlib.crc32(str(meshes.resolve()).encode()):08x}x{options.variants}"
        found[path] = _kept(folder / f"{path}.npz", make)
    return found


def _kept(path: Path, make: Callable[[], ShapeSet]) -> ShapeSet:
    """The set in this file, made where there is none. The name holds all that the set was made from."""
    if path.exists():
        return load_shapes(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    shapes = make()
    shapes.save(path)
    return shapes


def require_mesh_libraries() -> None:
    """Raises ValueError with the remedy where one of them is missing."""
    for library in ("igl", "embreex", "manifold3d"):
        if find_spec(library) is None:
            raise ValueError(f"meshes need the package {library}: pip install 'farside[meshes]'")


def household_variants(variants: int) -> int:
    """Of a household thing, where a mesh has so many."""
    return max(1, variants // 4)


def revision() -> str:
    """The checkout's git revision, with + where files were changed; empty outside a checkout."""
    command = ("git", "-C", str(Path(__file__).parent), "describe", "--always", "--abbrev=12", "--dirty=+")
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""
