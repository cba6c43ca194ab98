"""The built kernel, loaded into the process."""

import ctypes
import os
from functools import cache

import jax

from probnerf.kernel.build import built_library

VIEW_TERMS, DENSITY = "farside_view_terms", "farside_density"


@cache
def available() -> bool:
    """Whether JAX runs on the CPU and the kernel is built. The first call builds it. `FARSIDE_KERNEL=0` disables it."""
    if os.environ.get("FARSIDE_KERNEL") == "0" or jax.default_backend() != "cpu":
        return False
    path = built_library()
    if path is None:
        return False
    library = ctypes.CDLL(str(path))
    for target, function in ((VIEW_TERMS, library.FarsideViewTerms), (DENSITY, library.FarsideDensity)):
        jax.ffi.register_ffi_target(target, jax.ffi.pycapsule(function), platform="cpu")
    return True
