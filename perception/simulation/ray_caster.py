"""Rays cast at triangle meshes, by Embree (Wald et al. 2014)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

_LIFT = 1e-4  # m: a shadow ray starts so far above the surface that it leaves


@dataclass(frozen=True, eq=False)
class Hits:
    """Where n rays meet the nearest mesh."""

    distance: Float[np.ndarray, "n"]  # m along the unit ray; inf: it meets none
    mesh: Int[np.ndarray, "n"]  # number of the mesh, -1: none
    face: Int[np.ndarray, "n"]  # of that mesh, -1: none
    normal: Float[np.ndarray, "n 3"]  # unit, of the face, towards the ray's origin; zeros: none


class RayCaster:
    """Several meshes in one scene, in one frame, metres. Both sides of a face count.

    Raises `ImportError` where Embree is not installed, and `ValueError` without a face.
    """

    def __init__(self, meshes: Sequence[tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]]) -> None:
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ModuleNotFoundError:
            raise ImportError(
                "pictures of meshes need embreex: pip install 'farside[meshes]' (there is none for Linux on ARM)"
            ) from None
        for number, (vertices, faces) in enumerate(meshes):
            if not len(faces) or not np.isfinite(vertices).all():
                raise ValueError(f"mesh {number} has {len(faces)} faces and must have some, with finite vertices")
        self._scene = EmbreeScene()
        for vertices, faces in meshes:  # numbered by Embree in this order
            TriangleMesh(self._scene, np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.int32))

    def cast(self, origins: Float[np.ndarray, "*n 3"], directions: Float[np.ndarray, "n 3"]) -> Hits:
        """The nearest hit of each ray; `origins` may be one for all, `directions` are unit vectors."""
        count = len(directions)
        if count == 0:
            return Hits(np.zeros(0), np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros((0, 3)))
        towards = np.ascontiguousarray(directions, np.float32)
        found = self._scene.run(np.array(np.broadcast_to(origins, (count, 3)), np.float32), towards, output=1)
        hit = found["primID"] >= 0
        normal = np.zeros((count, 3))
        outward = found["Ng"][hit].astype(np.float64)
        outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-30)
        normal[hit] = -outward * np.sign(np.einsum("ni,ni->n", outward, towards[hit]))[:, None]
        return Hits(
            distance=np.where(hit, found["tfar"], np.inf).astype(np.float64),
            mesh=np.where(hit, found["geomID"], -1),
            face=np.where(hit, found["primID"], -1),
            normal=normal,
        )

    def shaded(
        self,
        points: Float[np.ndarray, "n 3"],
        normals: Float[np.ndarray, "n 3"],
        light: Float[np.ndarray, "3"],
    ) -> Bool[np.ndarray, "n"]:
        """Whether something stands between surface points (with unit normals) and a distant light in this direction."""
        if len(points) == 0:
            return np.zeros(0, bool)
        start = np.ascontiguousarray(points + _LIFT * normals, np.float32)
        return self._scene.run(start, np.array(np.broadcast_to(light, start.shape), np.float32)) >= 0
