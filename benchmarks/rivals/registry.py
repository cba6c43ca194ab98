"""The rivals by name: sizes, model and recipe of each."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.rivals.functa import Functa, FunctaConfig
from benchmarks.rivals.functa_recipe import functa_recipe
from benchmarks.rivals.model import load_rival
from benchmarks.rivals.nerf_vae import NeRFVAE, NeRFVAEConfig, nerf_vae_recipe
from benchmarks.rivals.pi_gan import PiGAN, PiGANConfig
from benchmarks.rivals.pi_gan_recipe import pi_gan_recipe
from benchmarks.rivals.pixel_nerf import PixelNeRF, PixelNeRFConfig, pixel_nerf_recipe
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


SMALL = {"samples": 12, "objects": 4, "rays": 64}
RIVALS: dict[str, Entry] = {
    "functa": Entry(
        FunctaConfig,
        Functa,
        functa_recipe,
        tiny={"width": 32, "layers": 3, "latent": 16, "samples": 12, "training_samples": 12, "objects": 4, "rays": 64}
        | {"flow_hidden": 16, "diffusion_width": 16, "diffusion_blocks": 1, "map_steps": 20, "map_rays": 64},
    ),
    "nerf_vae": Entry(
        NeRFVAEConfig,
        NeRFVAE,
        nerf_vae_recipe,
        tiny=SMALL | {"latent": 16, "channels": (8, 16), "summary": 32, "width": 32, "blocks": 2},
    ),
    "pi_gan": Entry(
        PiGANConfig,
        PiGAN,
        pi_gan_recipe,
        tiny={"latent": 8, "mapping": 32, "width": 16, "layers": 2, "samples": 6, "sizes": (8, 16), "batches": (4, 4)}
        | {"channels": (16, 16, 32)},
    ),
    "pixel_nerf": Entry(
        PixelNeRFConfig,
        PixelNeRF,
        pixel_nerf_recipe,
        tiny=SMALL | {"channels": (8, 16, 16), "features": 16, "width": 32, "blocks": 2},
    ),
}


def load(path: Path) -> tuple[Any, dict[str, Any]]:
    """A trained rival and its file's metadata. Raises as `load_rival` does."""

    def build(story: dict[str, Any]) -> Callable[..., Any]:
        entry = RIVALS[story["model"]]
        config = entry.config(**story["config"])
        return lambda key: entry.model(config, key)

    return load_rival(path, build)
