"""Priors in the checkout that are not shipped."""

from pathlib import Path

TABLETOP = Path(__file__).resolve().parent.parent / "benchmarks" / "checkpoints" / "tabletop" / "prior.safetensors"
"""Of the tabletop family alone, with an encoder and no posterior network."""
