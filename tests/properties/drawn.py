"""Strategies for what files and messages hold.

Every field of a dataclass is drawn, so that a new one cannot be forgotten. A field is drawn by its type; one that is
more than its type says (an array of a certain shape, a number in a range) needs a strategy of its own; `every_field`
raises where it has none.
"""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from calibration.camera import Camera
from perception.answers.diagnostics import AnswerDiagnostics
from perception.answers.hypotheses import Hypotheses
from perception.observation.object_frame import ObjectFrame
from perception.sources.frame import Frame

Any_ = TypeVar("Any_")

# The same examples in every run, whatever the machine's speed. A failure is told as it is: to look for a smaller one
# takes minutes.
law = settings(
    deadline=None,
    derandomize=True,
    database=None,
    max_examples=50,
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=[HealthCheck.too_slow],
)
slower_law = settings(law, max_examples=15)

numbers = st.floats(allow_nan=False, allow_infinity=False)
widths = st.floats(1e-3, 2.0)
texts = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=20)  # UTF-8, as CDR has it
seeds = st.integers(0, 2**32 - 1)  # of large arrays
stamps = st.integers(0, 2**31 * 10**9 - 1)  # ns; seconds of a ROS stamp have 31 bits


def by_type(hint: Any) -> st.SearchStrategy:
    """Any value of a plain type. Raises TypeError for another type."""
    plain = {int: st.integers(0, 2**31 - 1), float: numbers, str: texts, bool: st.booleans(), NoneType: st.none()}
    if hint in plain:
        return plain[hint]
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Literal:
        return st.sampled_from(inner)
    if origin in (Union, UnionType):
        return st.one_of(*map(by_type, inner))
    if origin is dict:
        return st.dictionaries(by_type(inner[0]), by_type(inner[1]), max_size=4)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return st.sampled_from(hint)
    if isinstance(hint, type) and is_dataclass(hint):
        return every_field(hint)
    raise TypeError(f"say how a {hint} is drawn")


def every_field(kind: type[Any_], together: st.SearchStrategy | None = None, **own: Any) -> st.SearchStrategy[Any_]:
    """Instances of a dataclass: `together` draws a dict of fields that depend on each other, `own` single fields."""
    hints = get_type_hints(kind)

    def build(given: Mapping[str, Any]) -> st.SearchStrategy[Any_]:
        values = {f.name: own.get(f.name) for f in fields(kind) if f.name not in given}
        drawn = {name: by_type(hints[name]) if value is None else value for name, value in values.items()}
        return st.builds(kind, **drawn, **{name: st.just(value) for name, value in given.items()})

    return (st.just({}) if together is None else together).flatmap(build)


@st.composite
def poses(draw: st.DrawFn) -> np.ndarray:
    """A rigid transform, f64[4, 4], m."""
    T = np.eye(4)
    turn, place = (st.lists(st.floats(-size, size), min_size=3, max_size=3) for size in (3.0, 5.0))
    T[:3, :3] = Rotation.from_rotvec(draw(turn)).as_matrix()
    T[:3, 3] = draw(place)
    return T


@st.composite
def scenes(draw: st.DrawFn) -> list[Hypotheses]:
    """One or two objects of one frame; the origins of their cubes lie 0.01 to 0.25 m from the camera."""
    stamp, place = draw(stamps), draw(poses())
    objects = []
    for i in range(draw(st.integers(1, 2))):
        T = draw(poses())
        T[:3, 3] = 0.02 * T[:3, 3] + [0.0, 0.0, 0.11]
        cube = every_field(ObjectFrame, T_camera_object=st.just(T), half_extent=st.floats(0.05, 0.2), plane=vectors(4))
        same = {"stamp_ns": st.just(stamp), "frame_id": st.just("camera"), "T_world_camera": st.just(place)}
        objects.append(draw(hypotheses(object_id=st.just(i + 1), object_frame=cube, **same)))
    return objects


def vectors(size: int, most: float = 10.0) -> st.SearchStrategy[np.ndarray]:
    """f64[size] of finite numbers."""
    return st.lists(st.floats(-most, most), min_size=size, max_size=size).map(np.array)


def object_frames() -> st.SearchStrategy[ObjectFrame]:
    """Any cube."""
    return every_field(ObjectFrame, T_camera_object=poses(), half_extent=st.floats(0.01, 1.0), plane=vectors(4))


@st.composite
def _shapes(draw: st.DrawFn) -> dict[str, Any]:
    """The arrays of hypotheses: S sparse shapes on a small grid, some of them alike."""
    count, grid = draw(st.integers(1, 5)), draw(st.sampled_from([4, 8]))
    rng = np.random.default_rng(draw(seeds))
    filled = rng.random((count, grid, grid, grid)) < rng.uniform(0.0, 0.3)
    alike = np.sort(rng.integers(0, count, count))
    weights = rng.dirichlet(np.full(count, 2.0))
    return {
        "opacity": np.where(filled, rng.integers(128, 256), rng.integers(0, 128)).astype(np.uint8)[alike],
        "pose": rng.normal(0.0, 0.1, (count, 5)).astype(np.float32)[alike],
        "weights": weights / weights.sum(),
        "population": rng.integers(0, 3, count).astype(np.int32),
        "seen": rng.random((grid, grid, grid)) < 0.5,
    }


def _of_sum_1(values: dict[str, float]) -> dict[str, float]:
    return {name: value / sum(values.values()) for name, value in values.items()}


def hypotheses(**own: Any) -> st.SearchStrategy[Hypotheses]:
    """Any hypotheses; `own` replaces the strategies of fields."""
    usual: dict[str, Any] = {
        "stamp_ns": stamps,
        "object_frame": object_frames(),
        "T_world_camera": st.none() | poses(),
        "diagnostics": st.builds(AnswerDiagnostics, **{f.name: st.floats() for f in fields(AnswerDiagnostics)}),
        "kinds": st.dictionaries(texts, st.floats(0.01, 1.0), max_size=4).map(_of_sum_1),
    }
    return every_field(Hypotheses, _shapes(), **(usual | own))


@st.composite
def _optics(draw: st.DrawFn) -> dict[str, Any]:
    """A model with a distortion of one of its lengths, and the deviations of that."""
    lengths = {"plumb_bob": (4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (4,)}
    model = draw(st.sampled_from(sorted(lengths)))
    size = draw(st.sampled_from(lengths[model]))
    return {
        "model": model,
        "distortion": draw(vectors(size)),
        "distortion_std": draw(st.none() | vectors(size).map(abs)),
    }


@st.composite
def _matrices(draw: st.DrawFn) -> np.ndarray:
    fx, fy = draw(st.floats(1.0, 1e4)), draw(st.floats(1.0, 1e4))
    cx, cy, skew = draw(vectors(3, 1e3))
    return np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def cameras(**own: Any) -> st.SearchStrategy[Camera]:
    """Any camera."""
    usual = {"width": st.integers(1, 9999), "height": st.integers(1, 9999), "K": _matrices()}
    usual["K_std"] = st.none() | vectors(9).map(lambda v: np.abs(v).reshape(3, 3))
    usual["rms"] = st.none() | st.floats(0.0, 10.0)
    return every_field(Camera, _optics(), **(usual | own))


@st.composite
def _images(draw: st.DrawFn) -> dict[str, Any]:
    """Colour, and maybe depth (1 mm to 49 m, or unknown) and labels, and the camera of that size."""
    width, height = draw(st.integers(1, 9)), draw(st.integers(1, 9))
    rng = np.random.default_rng(draw(seeds))
    depth = np.where(rng.random((height, width)) < 0.2, np.nan, rng.uniform(1e-3, 49.0, (height, width)))
    label = rng.integers(0, draw(st.sampled_from([2, 256, 65536])), (height, width), dtype=np.int32)
    return {
        "rgb": rng.integers(0, 256, (height, width, 3), dtype=np.uint8),
        "depth": depth.astype(np.float32) if draw(st.booleans()) else None,
        "label": label if draw(st.booleans()) else None,
        "camera": draw(cameras(width=st.just(width), height=st.just(height))),
    }


def frames() -> st.SearchStrategy[Frame]:
    """Any small frame."""
    return every_field(Frame, _images(), stamp_ns=stamps, T_world_camera=st.none() | poses())


def assert_same(a: Any, b: Any, within: Mapping[str, float] | None = None, name: str = "it") -> None:
    """Two values are equal in all that they hold, NaN to NaN; the fields named in `within` up to that error."""
    if is_dataclass(a):
        assert type(a) is type(b), name
        for field in fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name), within, field.name)
    elif isinstance(a, dict):
        assert a.keys() == b.keys(), name
        for key in a:
            assert_same(a[key], b[key], within, f"{name}[{key!r}]")
    elif a is None or b is None:
        assert a is b, f"{name}: {a} became {b}"
    elif isinstance(a, np.ndarray):
        assert np.shape(a) == np.shape(b) and a.dtype.kind == np.asarray(b).dtype.kind, name
        np.testing.assert_allclose(b, a, rtol=0.0, atol=(within or {}).get(name, 0.0), err_msg=name)
    else:
        assert a == b or (a != a and b != b), f"{name}: {a!r} became {b!r}"
