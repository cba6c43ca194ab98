"""The rivals by name: sizes, model and recipe of each."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.rivals.functa import Functa, FunctaConfig
from benchmarks.rivals.functa_recipe import functa_recipe
from benchmarks.rivals.model import load_rival
from benchmarks.rivals.recipe import Recipe


@dataclass(frozen=True)
class Entry:
    """What a rival is made of."""

    config: Callable[..., Any]
    """Its sizes, given `box` and `tan_half_fov`."""
    model: Callable[..., Any]
    """Given its sizes and a key."""
    recipe: Callable[[Any], Recipe]
    """Given its sizes."""
    tiny: dict[str, Any] = field(default_factory=dict)
    """Sizes for tests."""


RIVALS: dict[str, Entry] = {
    "functa": Entry(
        FunctaConfig,
        Functa,
        functa_recipe,
        tiny={"width": 32, "layers": 3, "latent": 16, "samples": 12, "objects": 4, "rays": 64, "map_steps": 20},
    ),
}


def load(path: Path) -> tuple[Any, dict[str, Any]]:
    """A trained rival and its file's metadata. Raises as `load_rival` does."""

    def build(story: dict[str, Any]) -> Callable[..., Any]:
        entry = RIVALS[story["model"]]
        config = entry.config(**story["config"])
        return lambda key: entry.model(config, key)

    return load_rival(path, build)
