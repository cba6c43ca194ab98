"""A trained prior grown to larger sizes, which makes the same fields as before: training goes on where it stood."""

import math
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int, PRNGKeyArray

from probnerf.field import MLPField
from probnerf.prior import Preset, ProbNeRF


def grow(model: ProbNeRF, preset: Preset, key: PRNGKeyArray) -> ProbNeRF:
    """`model` at the sizes of `preset`, which may only add waves. New weights of the field start at zero, new wave
    vectors at random.

    Raises ValueError where another size differs.
    """
    if model.preset == preset:
        return model
    fresh = ProbNeRF(preset, key)
    old, new = model.hyper, fresh.hyper
    place = _places(model.field, fresh.field)
    if place is None or replace(model.preset, name=preset.name, waves=preset.waves) != preset:
        raise ValueError(f"weights of preset '{model.preset.name}' do not fit '{preset.name}': only waves may be added")
    ratio = jnp.asarray(model.field.weight_scale / fresh.field.weight_scale[place])
    added = np.ones(fresh.field.size, bool)
    added[place] = False
    added[len(added) - 3 * preset.waves :] = False  # wave vectors keep their random start
    weight, bias = (jnp.where(added.reshape(-1, *[1] * (a.ndim - 1)), 0.0, a) for a in (new.weight, new.bias))
    hyper = eqx.tree_at(
        lambda h: (h.hidden0, h.hidden1, h.weight, h.bias),
        new,
        (
            old.hidden0,
            old.hidden1,
            weight.at[place].set(ratio[:, None] * old.weight),
            bias.at[place].set(ratio * old.bias),
        ),
    )
    return eqx.tree_at(lambda m: (m.flow, m.hyper, m.encoder), fresh, (model.flow, hyper, model.encoder))


def _places(old: MLPField, new: MLPField) -> Int[np.ndarray, "d"] | None:
    """Where each weight of `old` stands in `new`, whose kernels may have further rows; None if it does not fit."""
    before, after = old.shapes, new.shapes
    if len(after) < len(before) or any(a[0] > b[0] or a[1:] != b[1:] for a, b in zip(before, after, strict=False)):
        return None
    starts = np.cumsum([0, *map(math.prod, after)])
    return np.concatenate([start + np.arange(math.prod(a)) for start, a in zip(starts, before, strict=False)])
