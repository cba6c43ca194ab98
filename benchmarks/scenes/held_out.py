"""Household things that no prior is trained on: the generator's validation seeds, held-out classes of the training
meshes, and scans."""

from collections.abc import Iterator
from pathlib import Path

from probnerf.objects.household import draw_mesh
from probnerf.objects.mesh import MeshObject, read_folder
from probnerf.objects.shape_kinds import kind_of_name
from probnerf.objects.tabletop import VALIDATION_SEEDS
from probnerf.training.mesh_shapes import held_out, variant

_DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
FOLDERS = {  # the second: whether all of it is held out
    "held-out meshes": (_DATA / "train_meshes" / "base_meshes", False),
    "scans": (_DATA / "val_meshes" / "gso", True),
}


def held_out_things(
    count: int, folders: dict[str, tuple[Path, bool]] | None = None
) -> Iterator[tuple[str, MeshObject, int]]:
    """Source, object and seed: `count` of the generator, and those of each folder that is there (`FOLDERS`)."""
    for seed in VALIDATION_SEEDS[:count]:
        made = draw_mesh(seed)
        yield "generator", *variant(made.mesh, f"{made.name}_{seed}", made.kind, 0)
    for source, (folder, whole) in (FOLDERS if folders is None else folders).items():
        for name, mesh in read_folder(folder) if folder.is_dir() else ():
            if not isinstance(mesh, str) and (whole or held_out(name)):
                yield source, *variant(mesh, name, kind_of_name(name), 0)
