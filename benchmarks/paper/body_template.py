"""The human mesh that `bodies` poses: vertices, faces, joints and skinning weights in `body_template.npz`.

`python -m benchmarks.paper.body_template FOLDER` makes it anew from MPFB2's assets, which are CC0
(https://github.com/makehumancommunity/mpfb2): base mesh, rig `cmu_mb` and its weights. Metres; x to the person's left,
y to the back, z up.
"""

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float, Int

from foundation.whole_file import whole_file

PATH = Path(__file__).with_name("body_template.npz")
BONES = 6  # most that move a vertex


@dataclass(frozen=True, eq=False)
class Template:
    """A person at rest, arms half raised. Parents come before their children."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    names: tuple[str, ...]  # of bones
    parents: Int[np.ndarray, "b"]  # -1: none
    heads: Float[np.ndarray, "b 3"]  # the joint that a bone turns about
    tails: Float[np.ndarray, "b 3"]
    weights: Float[np.ndarray, "v b"]  # rows sum to 1

    def __getitem__(self, bone: str) -> int:
        return self.names.index(bone)


def read_assets(folder: Path) -> Template:
    """From base.obj, rig.cmu_mb.json and weights.cmu_mb.json."""
    points, quads, group = [], [], ""
    for line in (folder / "base.obj").read_text().splitlines():
        kind, *rest = line.split() or [""]
        if kind == "v":
            points.append([float(x) for x in rest[:3]])
        elif kind == "g":
            group = rest[0]
        elif kind == "f" and group == "body":
            quads.append([int(corner.split("/")[0]) - 1 for corner in rest])
    corners = np.asarray(quads)
    count = corners.max() + 1
    x, up, front = 0.1 * np.asarray(points)[:count].T  # decimetres, y up
    rig = json.loads((folder / "rig.cmu_mb.json").read_text())
    names: list[str] = []
    while len(names) < len(rig):
        names += [n for n in rig if n not in names and (not rig[n]["parent"] or rig[n]["parent"] in names)]
    weights = np.zeros((count, len(names)))
    for name, pairs in json.loads((folder / "weights.cmu_mb.json").read_text())["weights"].items():
        for vertex, weight in pairs:
            if vertex < count:
                weights[vertex, names.index(name)] = weight
    return Template(
        vertices=np.stack([x, -front, up], axis=1),
        faces=np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]]),
        names=tuple(names),
        parents=np.array([names.index(rig[n]["parent"]) if rig[n]["parent"] else -1 for n in names]),
        heads=np.array([rig[n]["head"]["default_position"] for n in names]),
        tails=np.array([rig[n]["tail"]["default_position"] for n in names]),
        weights=weights,
    )


def save_template(template: Template, path: Path = PATH) -> None:
    """Compactly: half precision, and the BONES largest weights of each vertex."""
    bones = np.argsort(template.weights, axis=1)[:, : -BONES - 1 : -1]
    with whole_file(path) as part, part.open("wb") as file:
        np.savez_compressed(
            file,
            vertices=template.vertices.astype(np.float16),
            faces=template.faces.astype(np.uint16),
            names=np.array(template.names),
            parents=template.parents.astype(np.int8),
            heads=template.heads.astype(np.float32),
            tails=template.tails.astype(np.float32),
            bones=bones.astype(np.uint8),
            shares=np.take_along_axis(template.weights, bones, axis=1).astype(np.float16),
        )


@cache
def load_template() -> Template:
    """As committed."""
    with np.load(PATH, allow_pickle=False) as file:
        weights = np.zeros((len(file["vertices"]), len(file["names"])))
        np.put_along_axis(weights, file["bones"].astype(np.intp), file["shares"].astype(float), axis=1)
        return Template(
            vertices=file["vertices"].astype(float),
            faces=file["faces"].astype(np.int64),
            names=tuple(map(str, file["names"])),
            parents=file["parents"].astype(int),
            heads=file["heads"].astype(float),
            tails=file["tails"].astype(float),
            weights=weights / weights.sum(axis=1, keepdims=True),
        )


def main(folder: tyro.conf.Positional[Path]) -> None:
    """Make body_template.npz from a folder of the assets."""
    save_template(read_assets(folder))


if __name__ == "__main__":
    tyro.cli(main)
