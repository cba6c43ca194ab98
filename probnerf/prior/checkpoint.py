"""Priors, posterior networks and recognitions on disk: safetensors files (which cannot execute code) with arrays and
metadata."""

import hashlib
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from foundation.bounded import LARGEST_ARRAYS, parse_json
from foundation.whole_file import write_whole
from probnerf.prior.networks import PRESETS, ProbNeRF, Recognition
from probnerf.prior.posterior_flow import NetworkSizes, PosteriorNetwork

M = TypeVar("M")

FORMAT = "farside-prior-1"
NETWORK_FORMAT = "farside-posterior-network-1"
RECOGNITION_FORMAT = "farside-recognition-1"
SHIPPED = Path(__file__).parent / "weights" / "household.safetensors"


@dataclass(frozen=True)
class Prior:
    """A trained prior, where it comes from, and the posterior network that was trained for it, if there is one."""

    model: ProbNeRF
    metadata: dict[str, Any]  # preset, family, seeds, revision, recipe, gate figures
    hash: str  # of the file's bytes
    network: PosteriorNetwork | None = None
    network_hash: str = ""  # of the network's file

    @property
    def identity(self) -> str:
        """What identifies prior and network in every posterior: their hashes."""
        return self.hash if self.network is None else f"{self.hash}+{self.network_hash}"


@dataclass(frozen=True)
class TrainedNetwork:
    """A trained posterior network and where it comes from."""

    network: PosteriorNetwork
    metadata: dict[str, Any]  # sizes, prior (its hash), recipe, validation figures
    hash: str  # of the file's bytes


def _named(model: Any) -> dict[str, Any]:
    leaves = jax.tree_util.tree_flatten_with_path(model)[0]
    return {jax.tree_util.keystr(path).lstrip("."): leaf for path, leaf in leaves}


def save_prior(path: Path, model: ProbNeRF, metadata: dict[str, Any], half: bool = False) -> None:
    """Write atomically; with `half` in half precision. `metadata` must be JSON-serialisable.

    Raises ValueError if a weight is not finite in half precision.
    """
    arrays = {name: np.ascontiguousarray(leaf) for name, leaf in _named(model).items()}
    arrays = _halved(arrays, path) if half else arrays
    story = {"format": FORMAT, "preset": model.preset.name, **metadata}
    write_whole(path, save(arrays, metadata={"farside": json.dumps(story, sort_keys=True)}))


def network_path(prior: Path) -> Path:
    """Where the posterior network of the prior in this file is looked for: NAME.network.safetensors beside it."""
    return prior.with_suffix(".network.safetensors")


def load_prior(path: Path | None = None, preset: str | None = None) -> Prior:
    """Read a prior, and its posterior network if the file is there (`network_path`).

    None is the prior shipped with the project. `preset` is the preset that the caller requires, if any.
    Raises FileNotFoundError if there is no file. Raises ValueError if it is not a prior, is damaged or has another
    preset, or if the network's file is damaged or another prior's. Messages have one line.
    """
    path = _prior_path(path)
    story, arrays = _read(path, "prior", "train one with `farside train`")
    if story.get("format") != FORMAT or story.get("preset") not in PRESETS:
        raise ValueError(f"{path} is not a prior of format {FORMAT} with a preset of {', '.join(PRESETS)}")
    if preset is not None and story["preset"] != preset:
        raise ValueError(f"{path} holds preset '{story['preset']}', not '{preset}'; give weights of that preset")
    # shapes only: initialising weights just to replace them would take seconds
    model = jax.eval_shape(lambda key: ProbNeRF(PRESETS[story["preset"]], key), jax.random.key(0))
    prior = Prior(_filled(model, arrays, path, f"preset '{story['preset']}'"), story, _hash(path))
    beside = network_path(path)
    if not beside.is_file():
        return prior
    found = load_posterior_network(beside, prior)
    return replace(prior, network=found.network, network_hash=found.hash)


def identity_of(path: Path | None = None) -> str:
    """`Prior.identity` of what `load_prior` would read, without its weights. Raises FileNotFoundError as it does."""
    path = _prior_path(path)
    beside = network_path(path)
    return f"{_hash(path)}+{_hash(beside)}" if beside.is_file() else _hash(path)


def save_posterior_network(path: Path, network: PosteriorNetwork, prior: str, metadata: dict[str, Any]) -> None:
    """Write atomically, in half precision. `prior` is the hash of the prior that it was trained for.

    `metadata` must be JSON-serialisable. Raises ValueError if a weight is not finite in half precision.
    """
    arrays = _halved({name: np.asarray(leaf) for name, leaf in _named(network).items()}, path)
    story = {"format": NETWORK_FORMAT, "sizes": asdict(network.sizes), "prior": prior, **metadata}
    write_whole(path, save(arrays, metadata={"farside": json.dumps(story, sort_keys=True)}))


def load_posterior_network(path: Path, prior: Prior) -> TrainedNetwork:
    """Read the posterior network of `prior`, in single precision.

    Raises FileNotFoundError if there is no file. Raises ValueError if it is not a posterior network, is damaged, or has
    another architecture or another prior. Messages have one line.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such posterior network; train one for the prior {prior.hash}")
    story, arrays = _read(path, "posterior network", "train it again")
    if story.get("format") != NETWORK_FORMAT:
        raise ValueError(f"{path} has format {story.get('format')}, not {NETWORK_FORMAT}; train it again")
    if story.get("prior") != prior.hash:
        raise ValueError(f"{path} was trained for the prior {story.get('prior')}, not for {prior.hash}; train it again")
    try:
        sizes = NetworkSizes(**story["sizes"])
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path} has sizes of another architecture ({error}); train it again") from None
    if sizes.latent != prior.model.latent:
        raise ValueError(f"{path} has {sizes.latent} latents, the prior has {prior.model.latent}; train it again")
    network = jax.eval_shape(lambda key: PosteriorNetwork(sizes, key), jax.random.key(0))
    return TrainedNetwork(_filled(network, arrays, path, "this architecture"), story, _hash(path))


def recognition_path(prior: Path) -> Path:
    """Where the recognition of the prior in this file is kept: NAME.recognition.safetensors beside it."""
    return prior.with_suffix(".recognition.safetensors")


def save_recognition(path: Path, recognition: Recognition, prior: str) -> None:
    """Write atomically, in half precision. `prior` is the hash of the prior that it was trained with.

    Raises ValueError if a weight is not finite in half precision.
    """
    arrays = _halved({name: np.asarray(leaf) for name, leaf in _named(recognition).items()}, path)
    first = recognition.hidden.first
    story = {"format": RECOGNITION_FORMAT, "prior": prior, "inputs": first.in_features, "hidden": first.out_features}
    write_whole(path, save(arrays, metadata={"farside": json.dumps(story, sort_keys=True)}))


def load_recognition(path: Path, prior: Prior) -> Recognition:
    """Read the recognition of `prior`, in single precision.

    Raises FileNotFoundError if there is no file. Raises ValueError if it is not a recognition, is damaged, or has
    another prior. Messages have one line.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such recognition; `farside train` writes one beside its prior")
    story, arrays = _read(path, "recognition", "train the prior again")
    if story.get("format") != RECOGNITION_FORMAT:
        raise ValueError(f"{path} has format {story.get('format')}, not {RECOGNITION_FORMAT}; train the prior again")
    if story.get("prior") != prior.hash:
        raise ValueError(
            f"{path} belongs to the prior {story.get('prior')}, not to {prior.hash}; train the prior again"
        )
    sizes = (story["inputs"], prior.model.latent, story["hidden"])
    recognition = jax.eval_shape(lambda key: Recognition(*sizes, key), jax.random.key(0))
    return _filled(recognition, arrays, path, "this architecture")


def _halved(arrays: dict[str, np.ndarray], path: Path) -> dict[str, np.ndarray]:
    """The same in half precision."""
    with np.errstate(over="ignore"):
        halves = {name: np.ascontiguousarray(array, np.float16) for name, array in arrays.items()}
    for name, array in halves.items():
        if not np.isfinite(array).all():
            raise ValueError(f"{path}: array {name} is not finite in half precision; nothing was written")
    return halves


def _read(path: Path, what: str, remedy: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """A file's metadata and arrays."""
    try:
        if (size := path.stat().st_size) > LARGEST_ARRAYS:
            raise ValueError(f"it has {size >> 20} MB, more than any {what}")
        with safe_open(path, framework="np") as file:
            story = parse_json((file.metadata() or {}).get("farside", "{}"))
            if not isinstance(story, dict) or not all(isinstance(story.get(k, ""), str) for k in ("format", "preset")):
                raise ValueError("its metadata is no mapping, or names no format")
            return story, {name: file.get_tensor(name) for name in file.keys()}
    except (SafetensorError, ValueError, OSError) as error:
        raise ValueError(f"{path} is not a readable {what} ({error}); {remedy}") from None


def _filled(model: M, arrays: dict[str, np.ndarray], path: Path, owner: str) -> M:
    """The model, given by its shapes, with the arrays in their places."""
    named = _named(model)
    for name, leaf in named.items():
        found = arrays.get(name)
        if found is None or found.shape != leaf.shape:
            shape = "missing" if found is None else f"of shape {list(found.shape)}"
            raise ValueError(f"{path}: array {name} is {shape}, {owner} needs {list(leaf.shape)}; train it again")
        if found.dtype.kind != "f" or not np.isfinite(found).all():
            what = f"of {found.dtype}" if found.dtype.kind != "f" else "not finite"
            raise ValueError(f"{path}: array {name} is {what}; weights are finite floats: copy it, or train it, again")
    # a file in half precision is read in the model's own
    leaves = jax.device_put([arrays[name].astype(leaf.dtype, copy=False) for name, leaf in named.items()])
    return jax.tree.unflatten(jax.tree.structure(model), leaves)


def _prior_path(path: Path | None) -> Path:
    path = SHIPPED if path is None else Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such prior; train one with `farside train`, or omit the option")
    return path


def _hash(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]
