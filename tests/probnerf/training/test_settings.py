"""Recipes that cannot be followed are refused before anything is drawn."""

import math
from dataclasses import fields

import pytest

from probnerf.training.settings import TrainConfig


@pytest.mark.parametrize("name", [field.name for field in fields(TrainConfig)])
def test_no_field_of_a_recipe_is_negative_endless_or_no_number(name: str) -> None:
    wrong = (-1, 1 << 32) if isinstance(getattr(TrainConfig(), name), int | None) else (-1.0, 0.0, math.nan, math.inf)
    for value in wrong:
        with pytest.raises(ValueError, match=f"--{name.replace('_', '-')} is "):
            TrainConfig(**{name: value})


@pytest.mark.parametrize("name", ["steps", "batch", "views", "points", "log_every", "checkpoint_every", "map_batch"])
def test_some_are_one_or_more(name: str) -> None:
    with pytest.raises(ValueError, match="give 1 to"):
        TrainConfig(**{name: 0})
