"""The hypotheses file keeps all it is given, runs nothing, and says in one line what is wrong with it."""

import json
import zipfile
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perception.answers.diagnostics import AnswerDiagnostics
from perception.answers.hypotheses import Hypotheses, binary_entropy, by_weight, meshes, surface_points
from perception.answers.hypotheses_file import hypotheses_path, load, load_scene, save
from perception.observation.object_frame import ObjectFrame
from probnerf.rendering.occupancy import voxel_centres
from probnerf.types import BASE_Z, StopReason

GRID = 16
HALF_EXTENT = 0.08


def _rigid(axis: int, angle: float, translation: tuple[float, float, float]) -> np.ndarray:
    T = np.eye(4)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    T[[i, i, j, j], [i, j, i, j]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
    T[:3, 3] = translation
    return T


def _hypotheses(opacity: np.ndarray, weights: list[float], **changes) -> Hypotheses:
    grid = opacity.shape[-1]
    frame = ObjectFrame(
        T_camera_object=_rigid(0, 2.0, (0.1, -0.05, 0.6)),
        half_extent=HALF_EXTENT,
        plane=np.array([0.0, -0.8, -0.6, 0.4]),
        xy_sigma=0.05,
        log_scale_sigma=0.1,
        along_sigma=0.3,
        sight_sigma=0.04,
    )
    h = Hypotheses(
        stamp_ns=1_700_000_000_123_456_789,
        frame_id="oak_rgb",
        object_id=3,
        label="mug",
        object_frame=frame,
        T_world_camera=_rigid(2, 0.7, (1.0, 2.0, 0.5)),
        opacity=opacity,
        pose=np.pad(np.linspace(0, 1, 4 * len(weights), dtype=np.float32).reshape(-1, 4), ((0, 0), (0, 1))),
        weights=np.array(weights),
        population=(np.arange(len(weights)) % 2).astype(np.int32),
        seen=voxel_centres(grid)[..., 0] > 0,
        inside_view=True,
        out_of_model=False,
        stage=4,
        monte_carlo_error=0.0125,
        prior_hash="5f3a",
        seed=17,
        diagnostics=AnswerDiagnostics(ess=12.5),
        result=StopReason.STAGES,
        kinds={"vessel": 0.75, "box": 0.25},
    )
    return replace(h, **changes)


def _box(low: float, high: float, grid: int = GRID) -> np.ndarray:
    """A box of opaque voxels standing on the plane: |x|, |y| < high, hollow inside |x|, |y| < low."""
    x, y, z = np.moveaxis(np.abs(voxel_centres(grid) - [0, 0, BASE_Z + high]), -1, 0)
    wall = (np.maximum(x, y) < high) & (z < high) & ~((np.maximum(x, y) < low) & (z < low))
    return (255 * wall).astype(np.uint8)


@pytest.fixture
def mixed() -> Hypotheses:
    rng = np.random.default_rng(0)
    return _hypotheses(rng.integers(0, 256, (4, GRID, GRID, GRID), np.uint8), [0.1, 0.4, 0.2, 0.3])


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, ObjectFrame | Hypotheses | AnswerDiagnostics):
        return all(_same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if a is None or b is None:
        return a is b
    return np.asarray(a).dtype == np.asarray(b).dtype and np.array_equal(
        a, b, equal_nan=np.asarray(a).dtype.kind == "f"
    )


@pytest.mark.parametrize("with_world", [True, False])
def test_a_round_trip_is_exact(tmp_path, mixed, with_world):
    given = mixed if with_world else replace(mixed, T_world_camera=None)
    path = hypotheses_path(tmp_path / "new" / "folder", given.object_id)
    save(path, given)
    assert path.name == "object_3.npz" and _same(given, load(path))
    assert [p.name for p in path.parent.iterdir()] == [path.name]  # nothing temporary is left


def test_equal_content_gives_equal_bytes(tmp_path, mixed):
    save(tmp_path / "a.npz", mixed)
    save(tmp_path / "b.npz", replace(load(tmp_path / "a.npz")))
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        assert {member.date_time for member in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}


def test_a_failed_write_leaves_the_old_file(tmp_path, mixed, monkeypatch):
    path = tmp_path / "object_3.npz"
    save(path, mixed)
    before = path.read_bytes()

    def full(file, array, **_) -> None:
        file.write(b"some")
        raise OSError("No space left on device")

    monkeypatch.setattr(np.lib.format, "write_array", full)
    with pytest.raises(OSError, match="No space left"):
        save(path, mixed)
    assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("share", [0.02, 0.3, 0.9, 0.999])
def test_a_file_cut_short_is_named_in_one_line(tmp_path, mixed, share):
    path = tmp_path / "object_3.npz"
    save(path, mixed)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(ValueError, match=f"object_3.npz is cut short at byte {int(share * len(data))}") as error:
        load(path)
    assert "\n" not in str(error.value)


def test_damage_never_goes_unnoticed(tmp_path, mixed):
    path = tmp_path / "object_3.npz"
    save(path, mixed)
    data = path.read_bytes()
    rng = np.random.default_rng(1)
    noticed = 0
    for _ in range(60):
        broken = bytearray(data)
        broken[rng.integers(len(data))] ^= int(rng.integers(1, 256))
        path.write_bytes(bytes(broken))
        try:
            assert _same(mixed, load(path))  # a byte that means nothing, like a member's date
        except ValueError as error:
            noticed += 1
            assert str(path) in str(error) and "replay" in str(error)
    assert noticed > 50


def test_other_files_are_refused(tmp_path, mixed):
    text, other, folder = tmp_path / "notes.txt", tmp_path / "other.npz", tmp_path / "empty"
    text.write_text("hello")
    np.savez(other, opacity=mixed.opacity)
    folder.mkdir()
    for path in (text, other):
        with pytest.raises(ValueError, match=f"{path.name} is not a hypotheses file"):
            load(path)
    with pytest.raises(FileNotFoundError, match=r"absent\.npz: no such file"):
        load_scene(tmp_path / "absent.npz")
    with pytest.raises(FileNotFoundError, match=r"empty holds no object_<id>\.npz"):
        load_scene(folder)


def _rewrite(path: Path, **changes: object) -> None:
    """Save the file's arrays again, with changes to arrays (ndarray) or header fields (others); None removes."""
    with np.load(path) as archive:
        arrays = dict(archive)
    header = json.loads(arrays["header"].tobytes())
    for name, value in changes.items():
        target = arrays if name in arrays else header
        target.pop(name, None)
        if value is not None:
            target[name] = value
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    np.savez(path, **arrays)


def test_newer_and_inconsistent_files_are_refused(tmp_path, mixed):
    cases = [
        ({"format": "farside-hypotheses-3"}, "newer than this Farside"),
        ({"format": "farside-prior-1"}, "not a hypotheses file"),
        ({"seed": None}, "no field 'seed'"),
        ({"weights": None}, "no field 'weights'"),
        ({"weights": np.array([0.5, 0.5, 0.5, 0.5])}, "must sum to 1"),
        ({"weights": np.array([0.5, 0.5])}, r"weights has shape \[2\]"),
        ({"opacity": mixed.opacity.astype(np.float32)}, "opacity is float32"),
        ({"seen": mixed.seen.astype(np.uint8)}, "seen is uint8"),
        ({"result": "bored"}, "why sampling stopped is 'bored'; it must be one of converged, budget"),
        ({"diagnostics": {"ess": "many"}}, "the diagnostic ess is 'many'; it must be a number"),
    ]
    for changes, message in cases:
        path = tmp_path / "object_3.npz"
        save(path, mixed)
        _rewrite(path, **changes)
        with pytest.raises(ValueError, match=message):
            load(path)


def test_a_file_of_the_first_format_is_read_as_standing_on_the_plane(tmp_path, mixed):
    path = tmp_path / "object_3.npz"
    save(path, mixed)
    _rewrite(path, format="farside-hypotheses-1", pose=mixed.pose[:, :4])
    np.testing.assert_array_equal(load(path).base, BASE_Z)
    np.testing.assert_array_equal(load(path).solid, mixed.solid)


def test_diagnostics_of_another_version_are_read_as_far_as_they_are_known(tmp_path, mixed):
    path = tmp_path / "object_3.npz"
    save(path, mixed)
    _rewrite(path, diagnostics={"ess": 7, "of a later version": 1.0})
    diagnostics = load(path).diagnostics
    assert diagnostics.ess == 7.0 and np.isnan(diagnostics.r_hat)  # the one that is missing was not measured
    assert load(path).failed == 0


class _Trap:
    """Unpickling it would leave a file behind."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return (Path.touch, (self.path,))


def test_a_pickle_in_the_file_is_refused_and_never_run(tmp_path, mixed):
    path, mark = tmp_path / "object_3.npz", tmp_path / "mark"
    save(path, mixed)
    _rewrite(path, pose=np.array([_Trap(mark)], dtype=object))
    with pytest.raises(ValueError, match="damaged"):
        load(path)
    assert not mark.exists()


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"T_camera_object": np.full((4, 4), np.nan)}, "T_camera_object is no rigid transform"),
        ({"T_camera_object": np.eye(4)[:3]}, "T_camera_object is no rigid transform"),
        ({"T_world_camera": np.diag([1.0, 2.0, 1.0, 1.0])}, "T_world_camera is no rigid transform"),
        ({"plane": np.array([0.0, 0.0, 1.0])}, "plane is"),
        ({"plane": np.full(4, np.nan)}, "plane is"),
        ({"pose": np.full((4, 5), np.nan, np.float32)}, "a pose is not finite"),
    ],
)
def test_a_place_that_is_none_is_damage(tmp_path, mixed, changed: dict[str, np.ndarray], says: str):
    path = tmp_path / "object_3.npz"
    save(path, mixed)
    _rewrite(path, **changed)
    with pytest.raises(ValueError, match=rf"object_3\.npz is damaged \({says}.*write it again"):
        load(path)


def test_a_folder_is_a_scene_ordered_by_object(tmp_path, mixed):
    for object_id in (11, 2):
        save(hypotheses_path(tmp_path, object_id), replace(mixed, object_id=object_id))
    assert [h.object_id for h in load_scene(tmp_path)] == [2, 11]
    assert [h.object_id for h in load_scene(hypotheses_path(tmp_path, 11))] == [11]


def test_occupancy_is_solid_and_marginals_are_weighted():
    h = _hypotheses(np.stack([_box(0.2, 0.5), _box(0.0, 0.3)]), [0.25, 0.75])
    assert h.solid[0].sum() == 8**3  # its hollow is filled
    core = tuple(np.argwhere(h.solid[1])[0])
    shell = tuple(np.argwhere(h.solid[0] & ~h.solid[1])[0])
    assert h.p_occupied[core] == 1.0 and h.p_occupied[shell] == 0.25
    assert h.disagreement[core] == 0.0
    assert h.disagreement[shell] == pytest.approx(-0.25 * np.log(0.25) - 0.75 * np.log(0.75))
    np.testing.assert_allclose(binary_entropy(np.array([0.0, 0.5, 1.0])), [0, np.log(2), 0])


def test_copies_of_a_hypothesis_are_no_new_evidence():
    one, other = _box(0.0, 0.5), _box(0.0, 0.3)
    h = _hypotheses(np.stack([one, one, other, other]), [0.3, 0.2, 0.25, 0.25], population=np.zeros(4, np.int32))
    assert h.effective_hypotheses == pytest.approx(2.0)
    assert by_weight(replace(h, weights=np.array([0.4, 0.0, 0.3, 0.3]))).tolist() == [2, 0] and len(meshes(h, 4)) == 2
    mean, se = h.estimate(np.array([1.0, 1.0, 0.0, 0.0]))
    assert mean == pytest.approx(0.5) and se == pytest.approx(np.sqrt(2 * 0.5**2 * 0.5**2))


def test_standard_error_sees_populations_that_disagree(mixed):
    # Within each population all agree; only the comparison of the two shows the error.
    equal = replace(mixed, weights=np.full(4, 0.25))
    values = np.array([1.0, 0.0, 1.0, 0.0])
    mean, se = equal.estimate(values)
    assert mean == pytest.approx(0.5) and se == pytest.approx(0.5)  # std([1, 0], ddof=1) / sqrt(2)
    alone = replace(equal, population=np.zeros(4, np.int32))
    assert alone.estimate(values)[1] == pytest.approx(0.25)
    assert equal.estimate(np.ones(4))[1] == 0.0
    assert equal.estimate(np.zeros((4, 3, 2)))[0].shape == (3, 2)


def test_standard_error_is_that_of_independent_draws():
    rng = np.random.default_rng(5)
    grids = rng.integers(0, 256, (64, 4, 4, 4), np.uint8)
    h = _hypotheses(grids, [1 / 64] * 64, population=(np.arange(64) // 8).astype(np.int32))
    means, errors = zip(*(h.estimate(rng.uniform(size=64) < 0.3) for _ in range(400)), strict=True)
    assert np.std(means) < np.mean(errors) < 1.35 * np.std(means)  # the larger of two estimates errs upwards


def test_transforms_chain_object_camera_world(mixed):
    centres = voxel_centres(GRID).reshape(-1, 3).astype(np.float64)
    p_object = np.c_[centres * HALF_EXTENT, np.ones(len(centres))].T
    p_camera = mixed.object_frame.T_camera_object @ p_object
    p_world = mixed.T_world_camera @ p_camera
    for name, points in (("object", p_object), ("camera", p_camera), ("world", p_world)):
        np.testing.assert_array_equal(mixed.voxels(name, *points[:3]), np.arange(GRID**3))
    assert mixed.voxels("camera", np.zeros(1), np.zeros(1), np.zeros(1)).tolist() == [-1]
    with pytest.raises(ValueError, match="object 3 was recorded without the camera's pose"):
        replace(mixed, T_world_camera=None).T_object_from("world")
    with pytest.raises(ValueError, match="unknown frame 'base'"):
        mixed.T_object_from("base")


def _signed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def test_meshes_are_closed_outward_in_metres_and_heaviest_first():
    grid = 32
    shapes = np.stack([_box(0.3, 0.5, grid), _box(0.0, 0.25, grid), np.zeros((grid,) * 3, np.uint8)])
    h = _hypotheses(shapes, [0.3, 0.6, 0.1])
    (small, small_faces), (large, large_faces), (empty, no_faces) = meshes(h, 5)
    assert by_weight(h).tolist() == [1, 0, 2] and len(empty) == len(no_faces) == 0
    # Marching cubes cuts the edges of a box; its faces lie between voxel centres.
    assert _signed_volume(large, large_faces) == pytest.approx(HALF_EXTENT**3, rel=0.03)  # hollow, but no inner wall
    assert _signed_volume(small, small_faces) == pytest.approx((0.5 * HALF_EXTENT) ** 3, rel=0.06)
    np.testing.assert_allclose(large.min(0), np.array([-0.5, -0.5, BASE_Z]) * HALF_EXTENT, atol=1e-9)
    edges = np.sort(np.concatenate([large_faces[:, [0, 1]], large_faces[:, [1, 2]], large_faces[:, [2, 0]]]), axis=1)
    assert np.all(np.unique(edges, axis=0, return_counts=True)[1] == 2)  # closed
    assert len(meshes(h, 1)) == 1


def test_surface_points_lie_on_the_box():
    h = _hypotheses(_box(0.0, 0.5)[None], [1.0])
    surface = surface_points(h, 0) / HALF_EXTENT
    assert len(surface) == 6 * 8 * 8
    np.testing.assert_allclose(np.max(np.abs(surface - [0, 0, BASE_Z + 0.5]), axis=1), 0.5)


def test_unseen_space_lies_above_the_plane_and_in_no_view(mixed):
    seen = np.random.default_rng(0).random(mixed.seen.shape) < 0.5
    z = voxel_centres(GRID)[..., 2]
    np.testing.assert_array_equal(replace(mixed, seen=seen).unseen, ~seen & (z > BASE_Z))
    assert not replace(mixed, seen=np.ones_like(seen)).unseen.any()
