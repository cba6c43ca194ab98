"""The rules of the architecture find what breaks them, and accept what does not."""

import ast
from pathlib import PurePosixPath

import pytest

from tests.test_architecture import (
    RULES,
    Rule,
    breaks_diamond,
    breaks_importer_rule,
    breaks_layers,
    can_execute_code,
    has_global_state,
    has_untyped_signature,
    has_vague_name,
    hides_a_broken_install,
)


@pytest.mark.parametrize(
    ("rule", "path", "source", "said"),
    [
        (breaks_diamond, "probnerf/a.py", "def f():\n    from calibration.camera import Camera", "imports calibration"),
        (breaks_diamond, "perception/a.py", "from .. import node", "imports node"),
        (breaks_diamond, "probnerf/fields/a.py", "from ...node.bus import Bus", "imports node"),
        (breaks_layers, "perception/sources/a.py", "from perception.answers.query import query", "stands above it"),
        (breaks_layers, "probnerf/a.py", "", "stands in no layer of probnerf"),
        (
            breaks_diamond,
            "calibration/a.py",
            "importlib.import_module('perception.sources.open_source')",
            "imports perception",
        ),
        (breaks_importer_rule, "perception/a.py", "import zenoh.ext", "a.py imports zenoh, which only node/ros/bus.py"),
        (breaks_importer_rule, "probnerf/a.py", "import torch", "a.py imports torch, which is not in the table"),
        (can_execute_code, "probnerf/a.py", "np.load(f, allow_pickle=True)", "a.py:1 passes allow_pickle"),
        (can_execute_code, "probnerf/a.py", "import pickle", "imports pickle"),
        (has_global_state, "probnerf/a.py", "def f():\n    global x", "a.py:2 rebinds the module's x"),
        (
            hides_a_broken_install,
            "node/a.py",
            "try:\n    from perception.answers.query import query\nexcept (OSError, ImportError):\n    pass",
            "a.py:1 goes on without perception",
        ),
        (has_vague_name, "node/utils.py", "", "`utils` says nothing"),
        (has_untyped_signature, "node/a.py", "class A:\n    def f(self, x) -> int: ...", "a.py:2 f: no type for x"),
    ],
)
def test_rule_finds(rule: Rule, path: str, source: str, said: str) -> None:
    assert said in "".join(rule(PurePosixPath(path), ast.parse(source)))


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_rule_accepts(rule: Rule) -> None:
    source = """
from ..types import Pose
from . import foam
import jax.numpy as jnp, numpy as np, os.path
def area(x: float, *, y: float = 1) -> float:
    return _times(x, y)
def _times(x, y): return x * y
np.load("f", allow_pickle=False)
"""
    assert not list(rule(PurePosixPath("probnerf/objects/a.py"), ast.parse(source)))
