"""The rivals by name: sizes, model and recipe of each."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from benchmarks.rivals.functa import Functa, FunctaConfig
from benchmarks.rivals.functa_recipe import functa_recipe
from benchmarks.rivals.model import load_rival
from benchmarks.rivals.nerf_vae import NeRFVAE, NeRFVAEConfig, nerf_vae_recipe
from benchmarks.rivals.pi_gan import PiGAN, PiGANConfig
from benchmarks.rivals.pi_gan_recipe import pi_gan_recipe
from benchmarks.rivals.pixel_nerf import PixelNeRF, PixelNeRFConfig, pixel_nerf_recipe
from benchmarks.rivals.recipe import Recipe

Sizes = Literal["own", "small", "tiny"]


@dataclass(frozen=True)
class Entry:
    """What a rival is made of."""

    config: Callable[..., Any]
    """Its sizes, given `box` and `tan_half_fov`."""
    model: Callable[..., Any]
    """Given its sizes and a key."""
    recipe: Callable[[Any], Recipe]
    """Given its sizes."""
    label: str
    """Its name in tables."""
    draws: bool = False
    """Whether its answers to one picture differ from draw to draw; otherwise it gives a point estimate."""
    small: dict[str, Any] = field(default_factory=dict)
    """Sizes for minutes on one CPU core."""
    tiny: dict[str, Any] = field(default_factory=dict)
    """Sizes for tests."""

    def sizes(self, which: Sizes) -> dict[str, Any]:
        """What differs from the config's own sizes."""
        return {"own": {}, "small": self.small, "tiny": self.tiny}[which]


TINY = {"samples": 12, "objects": 4, "rays": 64}
ONE_CORE = {"width": 64, "blocks": 2, "samples": 24, "objects": 6, "rays": 64, "peak_rate": 2e-3}
RIVALS: dict[str, Entry] = {
    "functa": Entry(
        FunctaConfig,
        Functa,
        functa_recipe,
        "Functa",
        small={"width": 64, "layers": 4, "latent": 64, "samples": 24, "training_samples": 16, "objects": 4, "rays": 64}
        | {"flow_hidden": 128, "diffusion_width": 128, "diffusion_blocks": 2, "map_rays": 128},
        tiny={"width": 32, "layers": 3, "latent": 16, "samples": 12, "training_samples": 12, "objects": 4, "rays": 64}
        | {"flow_hidden": 16, "diffusion_width": 16, "diffusion_blocks": 1, "map_steps": 20, "map_rays": 64},
    ),
    "nerf_vae": Entry(
        NeRFVAEConfig,
        NeRFVAE,
        nerf_vae_recipe,
        "NeRF-VAE",
        draws=True,
        small=ONE_CORE | {"latent": 48, "channels": (16, 32, 64, 96), "summary": 128},
        tiny=TINY | {"latent": 16, "channels": (8, 16), "summary": 32, "width": 32, "blocks": 2},
    ),
    "pi_gan": Entry(
        PiGANConfig,
        PiGAN,
        pi_gan_recipe,
        "pi-GAN",
        small={"latent": 32, "mapping": 64, "width": 32, "layers": 3, "samples": 10, "batches": (12, 6)}
        | {"channels": (32, 48, 64, 96), "shares": (0.5, 0.5)},
        tiny={"latent": 8, "mapping": 32, "width": 16, "layers": 2, "samples": 6, "sizes": (8, 16), "batches": (4, 4)}
        | {"channels": (16, 16, 32)},
    ),
    "pixel_nerf": Entry(
        PixelNeRFConfig,
        PixelNeRF,
        pixel_nerf_recipe,
        "pixelNeRF",
        small=ONE_CORE | {"channels": (16, 24, 32, 48, 64), "features": 24, "objects": 4, "rays": 96},
        tiny=TINY | {"channels": (8, 16, 16), "features": 16, "width": 32, "blocks": 2},
    ),
}


def load(path: Path) -> tuple[Any, dict[str, Any]]:
    """A trained rival and its file's metadata. Raises as `load_rival` does."""

    def build(story: dict[str, Any]) -> Callable[..., Any]:
        entry = RIVALS[story["model"]]
        config = entry.config(**story["config"])
        return lambda key: entry.model(config, key)

    return load_rival(path, build)
