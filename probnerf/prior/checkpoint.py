"""Priors on disk: one safetensors file (which cannot execute code) with named arrays and metadata."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from foundation.whole_file import write_whole
from probnerf.prior.networks import PRESETS, ProbNeRF

FORMAT = "farside-prior-1"
SHIPPED = Path(__file__).parent / "weights" / "tabletop.safetensors"


@dataclass(frozen=True)
class Prior:
    """A trained prior and where it comes from."""

    model: ProbNeRF
    metadata: dict[str, Any]  # preset, family, seeds, revision, recipe, gate figures
    hash: str  # of the file's bytes; identifies the prior in every posterior


def _named(model: ProbNeRF) -> dict[str, Any]:
    leaves = jax.tree_util.tree_flatten_with_path(model)[0]
    return {jax.tree_util.keystr(path).lstrip("."): leaf for path, leaf in leaves}


def save_prior(path: Path, model: ProbNeRF, metadata: dict[str, Any]) -> None:
    """Write atomically. `metadata` must be JSON-serialisable."""
    arrays = {name: np.ascontiguousarray(leaf) for name, leaf in _named(model).items()}
    story = {"format": FORMAT, "preset": model.preset.name, **metadata}
    write_whole(path, save(arrays, metadata={"farside": json.dumps(story, sort_keys=True)}))


def load_prior(path: Path | None = None, preset: str | None = None) -> Prior:
    """Read a prior. None is the one shipped with the project. `preset` is the preset that the caller requires, if any.

    Raises FileNotFoundError if there is no file. Raises ValueError if it is not a prior, is damaged or has another
    preset. Messages have one line.
    """
    path = SHIPPED if path is None else Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such prior; train one with `farside train`, or omit the option")
    try:
        with safe_open(path, framework="np") as file:
            story = json.loads((file.metadata() or {}).get("farside", "{}"))
            arrays = {name: file.get_tensor(name) for name in file.keys()}
    except (SafetensorError, json.JSONDecodeError, OSError) as error:
        raise ValueError(f"{path} is not a readable prior ({error}); train one with `farside train`") from None
    if story.get("format") != FORMAT or story.get("preset") not in PRESETS:
        raise ValueError(f"{path} is not a prior of format {FORMAT} with a preset of {', '.join(PRESETS)}")
    if preset is not None and story["preset"] != preset:
        raise ValueError(f"{path} holds preset '{story['preset']}', not '{preset}'; give weights of that preset")
    # shapes only: initialising weights just to replace them would take seconds
    model = jax.eval_shape(lambda key: ProbNeRF(PRESETS[story["preset"]], key), jax.random.key(0))
    named = _named(model)
    for name, leaf in named.items():
        found = arrays.get(name)
        if found is None or found.shape != leaf.shape:
            shape = "missing" if found is None else f"of shape {list(found.shape)}"
            raise ValueError(
                f"{path}: array {name} is {shape}, preset '{story['preset']}' needs {list(leaf.shape)}; train it again"
            )
    leaves = jax.device_put([arrays[name] for name in named])
    model = jax.tree.unflatten(jax.tree.structure(model), leaves)
    return Prior(model, story, hashlib.sha256(path.read_bytes()).hexdigest()[:16])
