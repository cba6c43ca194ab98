"""A preset's wall error is the least that inference with its models assumes."""

from types import SimpleNamespace
from typing import Any, cast

import jax

from probnerf.inference import suited
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.settings import InferConfig


def test_a_model_is_trusted_no_more_than_its_preset_says() -> None:
    least = PRESETS["household"].wall_sigma
    household = jax.eval_shape(lambda key: ProbNeRF(PRESETS["household"], key), jax.random.key(0))
    assert InferConfig().wall_sigma < least
    assert suited(InferConfig(), household).wall_sigma == least
    assert suited(InferConfig(wall_sigma=0.3), household).wall_sigma == 0.3


def test_other_models_leave_the_settings_as_they_are() -> None:
    tiny = jax.eval_shape(lambda key: ProbNeRF(PRESETS["tiny"], key), jax.random.key(0))
    for model in (tiny, cast(Any, SimpleNamespace())):
        assert suited(InferConfig(), model) == InferConfig()
