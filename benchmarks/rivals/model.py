"""What the bench asks of a rival, its pictures, and its file: safetensors in half precision.

A rival is an `equinox.Module` of arrays with a static field `config`: a dataclass of numbers and tuples, with `box` and
`tan_half_fov`. A state is what a rival knows of one object: any tree of arrays.
"""

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, PyTree, UInt8
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from benchmarks.rivals.volume import Box, RadianceField, directions, integrate
from foundation.bounded import parse_json
from foundation.whole_file import write_whole

M = TypeVar("M", bound=eqx.Module)

FORMAT = "farside-rival-1"
RAYS = 4096  # rendered at a time


class Rival(Protocol):
    """Renders what it knows of an object."""

    def render(self, state: PyTree, T_object_camera: Float[Array, "v 4 4"], size: int) -> Float[Array, "v s s 3"]:
        """Square pictures of one state, in [0, 1]."""
        ...


@runtime_checkable
class Conditioned(Rival, Protocol):
    """A rival that answers to one picture."""

    def condition(
        self, picture: UInt8[Array, "s s 3"], T_object_camera: Float[Array, "4 4"], key: PRNGKeyArray, draws: int
    ) -> PyTree:
        """States given a picture, white outside the object; each array begins with an axis of `draws`.

        They are equal if the rival gives a point estimate.
        """
        ...


@runtime_checkable
class Generator(Rival, Protocol):
    """A rival with a prior over objects."""

    def sample(self, key: PRNGKeyArray, count: int) -> PyTree:
        """States of objects from the prior; each array begins with an axis of `count`."""
        ...


@runtime_checkable
class DiffusionGenerator(Generator, Protocol):
    """A rival with a second prior, a diffusion model."""

    def sample_diffusion(self, key: PRNGKeyArray, count: int) -> PyTree:
        """As `sample`."""
        ...


def picture_rays(
    T_object_camera: Float[Array, "4 4"], tan_half_fov: float, size: int
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
    """Origins and unit directions of a square picture's pixels, row by row."""
    row, column = jnp.meshgrid(jnp.arange(size), jnp.arange(size), indexing="ij")
    centre = jnp.stack([column, row], axis=-1).reshape(-1, 2) + 0.5
    direction = directions(T_object_camera, jnp.asarray(tan_half_fov), centre, size)
    return jnp.broadcast_to(T_object_camera[:3, 3], direction.shape), direction


def rendered(
    field: RadianceField,
    box: Box,
    tan_half_fov: float,
    T_object_camera: Float[Array, "v 4 4"],
    size: int,
    samples: int,
) -> Float[Array, "v s s 3"]:
    """Pictures of a field, some rays at a time (`integrate`)."""
    origin, direction = jax.vmap(lambda T: picture_rays(T, tan_half_fov, size))(T_object_camera)
    rays = jnp.stack([origin, direction], axis=2).reshape(-1, 2, 3)
    each = min(size * size, RAYS)
    padded = jnp.concatenate([rays, rays[: -len(rays) % each]]).reshape(-1, each, 2, 3)
    rgb = jax.lax.map(lambda part: integrate(field, box, part[:, 0], part[:, 1], samples)[0], padded)
    return rgb.reshape(-1, 3)[: len(rays)].reshape(-1, size, size, 3)


def save_rival(path: Path, name: str, model: Any, metadata: dict[str, Any]) -> None:
    """Write atomically, in half precision, with the model's name and sizes; `metadata` must be JSON-serialisable.

    Raises ValueError if a weight is not finite in half precision.
    """
    with np.errstate(over="ignore"):
        arrays = {key: np.ascontiguousarray(leaf, np.float16) for key, leaf in _named(model).items()}
    for key, array in arrays.items():
        if not np.isfinite(array).all():
            raise ValueError(f"{path}: array {key} is not finite in half precision; nothing was written")
    story = {"format": FORMAT, "model": name, "config": asdict(model.config), **metadata}
    write_whole(path, save(arrays, metadata={"farside": json.dumps(story, sort_keys=True)}))


def load_rival(path: Path, build: Callable[[dict[str, Any]], Callable[[PRNGKeyArray], M]]) -> tuple[M, dict[str, Any]]:
    """A rival in single precision, and its metadata. `build` gives the model of a file's metadata, given a key.

    Raises FileNotFoundError if there is no file. Raises ValueError if it is no rival, is damaged, or has other sizes.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such rival; train one with `python -m benchmarks.rivals.train`")
    try:
        with safe_open(path, framework="np") as file:
            story = parse_json((file.metadata() or {}).get("farside", "{}"))
            arrays = {key: file.get_tensor(key) for key in file.keys()}
        if story.get("format") != FORMAT:
            raise ValueError(f"its format is {story.get('format')}, not {FORMAT}")
        story["config"] = {name: _tuples(value) for name, value in story["config"].items()}
        model = jax.eval_shape(build(story), jax.random.key(0))
        named = _named(model)
        if {key: leaf.shape for key, leaf in named.items()} != {key: array.shape for key, array in arrays.items()}:
            raise ValueError("its arrays have other sizes than its model's")
    except (SafetensorError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise ValueError(f"{path} is not a readable rival ({error}); train it again") from None
    leaves = [jnp.asarray(arrays[key], leaf.dtype) for key, leaf in named.items()]
    return jax.tree.unflatten(jax.tree.structure(model), leaves), story


def _named(model: Any) -> dict[str, Any]:
    leaves = jax.tree_util.tree_flatten_with_path(model)[0]
    return {jax.tree_util.keystr(path).lstrip("."): leaf for path, leaf in leaves}


def _tuples(value: Any) -> Any:
    """JSON's lists as tuples, which a static field needs."""
    return tuple(_tuples(each) for each in value) if isinstance(value, list) else value
