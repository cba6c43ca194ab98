"""The built kernel, loaded into the process."""

import ctypes
import os
from functools import cache

import jax

from probnerf.kernel.build import LIBRARY

VIEW_TERMS, DENSITY = "farside_view_terms", "farside_density"


@cache
def available() -> bool:
    """Whether the kernel was built and JAX runs on the CPU; `FARSIDE_KERNEL=0` says no."""
    if os.environ.get("FARSIDE_KERNEL") == "0" or not LIBRARY.is_file() or jax.default_backend() != "cpu":
        return False
    library = ctypes.CDLL(str(LIBRARY))
    for target, function in ((VIEW_TERMS, library.FarsideViewTerms), (DENSITY, library.FarsideDensity)):
        jax.ffi.register_ffi_target(target, jax.ffi.pycapsule(function), platform="cpu")
    return True
