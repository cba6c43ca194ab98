"""The folders are the architecture: who may import whom, one importing file per outside library, and the house rules.

Each rule is a function from a file's path and syntax tree to complaints; test_architecture_rules.py tests the rules.
"""

import ast
import sys
from collections.abc import Callable, Iterator
from fnmatch import fnmatch
from functools import cache
from pathlib import Path, PurePosixPath

import pytest

ROOT = Path(__file__).resolve().parent.parent
MAX_LINES = 350

# The diamond: a folder of ours and the folders of ours that it may import besides itself.
MAY_IMPORT: dict[str, set[str]] = {
    "foundation": set(),  # what the standard library lacks; for all
    "calibration": {"foundation"},
    "probnerf": {"foundation"},
    "perception": {"foundation", "calibration", "probnerf"},
    "node": {"foundation", "calibration", "probnerf", "perception"},
    "farside": {"calibration", "probnerf", "perception", "node"},
    "examples": {"farside", "node", "probnerf"},  # what users would write
    "benchmarks": {"foundation", "calibration", "probnerf", "perception", "node", "farside", "examples"},
}
# Installed; `benchmarks` runs from a checkout.
PACKAGES = ("foundation", "calibration", "probnerf", "perception", "node", "farside")

# Inside a folder: its rooms and files from the lowest layer to the highest. Each may import its own layer and those
# before it; circles are excluded by a test of their own.
LAYERS: dict[str, tuple[tuple[str, ...], ...]] = {
    "foundation": (("bounded", "one_line", "png", "whole_file", "worker_pool"), ("archive", "store")),
    "calibration": (
        ("boards", "camera", "deviations", "turntable"),
        ("camchain", "fit", "print_board", "turntable_pose"),
        ("calibrate", "camera_file", "coverage", "hand_eye", "pose_files", "projection"),
    ),
    "probnerf": (
        ("environment", "geometry", "pixel_status", "settings", "types"),
        ("kernel",),
        ("compile_cache", "fields"),
        ("rendering",),
        ("likelihood",),
        ("prior",),
        ("sampling",),
        ("inference", "network_start", "ray_ends", "shapes"),
        ("objects",),
        ("training",),
    ),
    "perception": (("sources",), ("observation",), ("answers",), ("inference",), ("simulation",)),
    "node": (("figures",), ("ros", "viewer"), ("commands",), ("__main__",)),
    "benchmarks": (
        ("harness",),
        ("scenes",),
        ("measures",),
        ("household",),
        ("rivals", "paper"),  # they share pictures; a circle of modules is excluded
        ("studies",),
        ("figures", "golden"),
        ("__main__",),
    ),
}

# An outside library and the files that may import it: one per purpose. `*` also matches folders; tests import freely.
IMPORTERS: dict[str, tuple[str, ...]] = {
    "numpy": ("*",),
    "jaxtyping": ("*",),
    # JAX is probnerf's; perception meets it only where arrays are handed over.
    "jax": (
        "probnerf/*",
        "perception/inference/publish.py",
        "perception/inference/view_sampler.py",
        "perception/inference/warm_up.py",
        "benchmarks/*",
    ),
    "equinox": ("probnerf/*", "benchmarks/*"),
    "optax": (
        "probnerf/sampling/*",
        "probnerf/training/elbo.py",
        "probnerf/training/posterior_flow.py",
        "benchmarks/household/flow.py",
        "benchmarks/rivals/*",
    ),
    "safetensors": ("probnerf/prior/checkpoint.py", "benchmarks/rivals/model.py", "benchmarks/rivals/inception.py"),
    "blackjax": (),  # an independent sampler to test against
    # pictures in a second, before matplotlib is imported; PNG files, resized
    "cv2": ("calibration/*", "perception/*", "node/*/segment*.py", "probnerf/*/srn*.py", "benchmarks/*/intrinsics.py"),
    "scipy": (
        "calibration/hand_eye.py",
        "calibration/pose_files.py",
        "node/figures/object_figure.py",  # morphology
        "node/figures/voxel_renderer.py",
        "node/ros/messages.py",
        "probnerf/objects/household_parts.py",  # splines
        "probnerf/rendering/occupancy.py",
        "probnerf/training/batches.py",
        "perception/*",
        "benchmarks/*",
    ),
    "skimage": ("probnerf/rendering/occupancy.py", "probnerf/training/learnt_objects.py", "perception/*"),
    "serial": ("calibration/turntable.py",),
    "depthai": ("perception/sources/oak.py",),
    # recorded logs; messages on the bus
    "rosbags": (
        "perception/sources/bounded_reading.py",
        "perception/sources/log_messages.py",
        "perception/sources/recorder.py",
        "node/ros/messages.py",
    ),
    "fsspec": ("foundation/store.py",),
    "pyarrow": ("node/commands/batch_table.py",),
    "dask": ("node/commands/batch_dask.py",),  # the extra `cluster`, imported when it is asked for
    "distributed": ("node/commands/batch_dask.py", "benchmarks/studies/batch.py"),
    "mcap": ("perception/sources/log_messages.py", "perception/sources/recorder.py"),
    # YAML 1.1, as ROS and its tools write it
    "yaml": ("foundation/bounded.py", "calibration/camera_file.py", "calibration/pose_files.py"),
    # launch files: YAML 1.2 (1e-3 is a number), no key twice; then into dataclasses
    "ruamel": ("node/commands/config_file.py",),
    "pydantic": ("node/commands/config_file.py",),
    "zenoh": ("node/ros/bus.py",),
    "viser": ("node/viewer/page.py", "node/viewer/page_guard.py"),
    "websockets": ("node/viewer/page_guard.py",),  # viser's server
    "xxhash": ("node/ros/rmw_zenoh.py",),
    "tyro": ("node/__main__.py", "node/commands/*options.py", "benchmarks/*", "examples/*"),
    "trimesh": ("perception/answers/regions.py", "probnerf/objects/*", "probnerf/training/*", "benchmarks/scenes/*"),
    "igl": ("probnerf/objects/mesh.py", "benchmarks/scenes/strangers.py"),  # generalised winding numbers
    "embreex": ("perception/simulation/ray_caster.py",),  # the extra `meshes`, imported where it is needed
    "manifold3d": ("probnerf/objects/household_parts.py",),  # the same extra: exact booleans of solids
    "ompl": ("examples/05_ompl_planner.py",),  # the extra `planners`, imported where it is needed
    "cyclonedds": ("examples/06_dds_relay.py",),  # the extra `dds`
    "rich": ("node/*", "benchmarks/*"),
    "PIL": ("node/figures/turning.py", "perception/sources/image_files.py"),  # GIF; the size a picture claims
    "simplejpeg": ("perception/sources/image_files.py",),  # says what is damaged
    "matplotlib": ("calibration/print_board.py", "node/figures/*", "benchmarks/*"),
    # Two scripts in an environment of their own with Blender, which is under the GPL; no other file may import them.
    "bpy": ("probnerf/training/infinigen/one_object.py",),
    "infinigen": ("probnerf/training/infinigen/one_object.py",),
    "one_object": ("probnerf/training/infinigen/make_objects.py",),
}

CAN_EXECUTE_CODE = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "marshal", "shelve"}
Rule = Callable[[PurePosixPath, ast.Module], Iterator[str]]


def imported_modules(path: PurePosixPath, tree: ast.AST) -> Iterator[str]:
    """Dotted names of all modules that a file imports, inside functions and relative or by name, too."""
    for node in ast.walk(tree):
        match node:
            case ast.Import(names=names):
                yield from (name.name for name in names)
            case ast.ImportFrom(module=module, names=names, level=level):
                parts = [*(path.parts[:-level] if level else ()), *(module.split(".") if module else ())]
                for name in names:  # a name from a package may be its file
                    file = ROOT.joinpath(*parts, name.name)
                    yield ".".join([*parts, name.name] if file.with_suffix(".py").is_file() or file.is_dir() else parts)
            case ast.Call(
                func=ast.Name(id="__import__") | ast.Attribute(attr="import_module") | ast.Name(id="import_module"),
                args=[ast.Constant(value=str(name)), *_],
            ):
                yield name


def imports(path: PurePosixPath, tree: ast.AST) -> set[str]:
    """Top-level names of the same, without files beside a script of `examples`."""
    beside = {file.stem for file in (ROOT / "examples").glob("*.py")} if path.parts[0] == "examples" else set()
    return {module.split(".")[0] for module in imported_modules(path, tree)} - beside


def breaks_diamond(path: PurePosixPath, tree: ast.Module) -> Iterator[str]:
    folder = path.parts[0]
    for other in sorted(imports(path, tree) & {*MAY_IMPORT, "tests", "launch"} - {folder} - MAY_IMPORT[folder]):
        yield f"{path} imports {other}, which {folder} must not know"
    if folder == "farside" and path.stem != "__main__" and "node" in imports(path, tree):
        yield f"{path} imports node, which only farside/__main__.py may"


def breaks_layers(path: PurePosixPath, tree: ast.Module) -> Iterator[str]:
    folder, room = path.parts[0], path.parts[1].removesuffix(".py")
    layers = LAYERS.get(folder, ())
    height = {name: i for i, layer in enumerate(layers) for name in layer}
    if not layers or room == "__init__":
        return
    if room not in height:
        yield f"{path}: {room} stands in no layer of {folder} (LAYERS)"
        return
    for module in sorted(set(imported_modules(path, tree))):
        parts = module.split(".")
        if parts[0] == folder and len(parts) > 1 and height.get(parts[1], -1) > height[room]:
            yield f"{path} imports {module}, which stands above it"


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Groups of modules that import each other, directly or through others."""
    reach: dict[str, set[str]] = {}
    for start in graph:
        found, waiting = set[str](), list(graph[start])
        while waiting:
            if (module := waiting.pop()) not in found:
                found.add(module)
                waiting += graph.get(module, ())
        reach[start] = found
    together = {frozenset(b for b in reach[a] if a in reach.get(b, ())) for a in graph if a in reach[a]}
    return sorted(sorted(group) for group in together)


def breaks_importer_rule(path: PurePosixPath, tree: ast.Module) -> Iterator[str]:
    ours = {*MAY_IMPORT, "tests", "launch"}
    for library in sorted(imports(path, tree) - ours - sys.stdlib_module_names):
        allowed = IMPORTERS.get(library)
        if allowed is None:
            yield f"{path} imports {library}, which is not in the table of outside libraries (IMPORTERS)"
        elif not any(fnmatch(str(path), pattern) for pattern in allowed):
            yield f"{path} imports {library}, which only {', '.join(allowed) or 'tests'} may import"


def can_execute_code(path: PurePosixPath, tree: ast.Module) -> Iterator[str]:
    if str(path) == "probnerf/compile_cache.py":  # what it reads back is machine code, kept beside that of JAX
        return
    for module in sorted(imports(path, tree) & CAN_EXECUTE_CODE):
        yield f"{path} imports {module}: a file that it reads could execute code"
    for node in ast.walk(tree):
        if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
            if not (isinstance(node.value, ast.Constant) and node.value.value is False):
                yield f"{path}:{node.value.lineno} passes allow_pickle: a file that it reads could execute code"


def has_global_state(path: PurePosixPath, tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Global):
            yield f"{path}:{node.lineno} rebinds the module's {', '.join(node.names)}: pass it as an argument"


def hides_a_broken_install(path: PurePosixPath, tree: ast.Module) -> Iterator[str]:
    """Whatever else is installed, our own modules are there."""
    missing = {"ImportError", "ModuleNotFoundError"}
    for node in (node for node in ast.walk(tree) if isinstance(node, ast.Try)):
        ours = imports(path, ast.Module(node.body, [])) & {*MAY_IMPORT}
        kinds = [handler.type for handler in node.handlers]
        caught = {name.id for kind in kinds if kind for name in ast.walk(kind) if isinstance(name, ast.Name)}
        if ours and caught & missing:
            yield f"{path}:{node.lineno} goes on without {', '.join(sorted(ours))}, which is installed or broken"


def has_vague_name(path: PurePosixPath, tree: ast.Module) -> Iterator[str]:
    for part in {path.stem, *path.parts[:-1]} & {"util", "utils", "helper", "helpers", "misc", "common"}:
        yield f"{path}: `{part}` says nothing; name the concept"


def has_untyped_signature(path: PurePosixPath, tree: ast.Module) -> Iterator[str]:
    """Public functions and methods; what is private or local may leave its types to inference."""
    scopes: list[ast.Module | ast.ClassDef] = [tree, *(node for node in tree.body if isinstance(node, ast.ClassDef))]
    for f in (node for scope in scopes for node in scope.body):
        if not isinstance(f, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        initialiser = f.name == "__init__"
        if f.name.startswith("_") and not initialiser:
            continue
        arguments = [*f.args.posonlyargs, *f.args.args, *f.args.kwonlyargs]
        bare = [a.arg for a in arguments if a.annotation is None and a.arg not in ("self", "cls")]
        if bare or (f.returns is None and not initialiser):
            yield f"{path}:{f.lineno} {f.name}: no type for {', '.join(bare) or 'what it returns'}"


RULES = (
    breaks_diamond,
    breaks_layers,
    breaks_importer_rule,
    can_execute_code,
    has_global_state,
    hides_a_broken_install,
    has_vague_name,
    has_untyped_signature,
)


def files_of(*folders: str) -> list[PurePosixPath]:
    found = (path for folder in folders for path in (ROOT / folder).rglob("*.py"))
    return sorted(PurePosixPath(path.relative_to(ROOT).as_posix()) for path in found)


@cache
def tree_of(path: PurePosixPath) -> ast.Module:
    return ast.parse((ROOT / path).read_text(encoding="utf-8"), str(path))


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_no_file(rule: Rule) -> None:
    complaints = [line for path in files_of(*MAY_IMPORT) for line in rule(path, tree_of(path))]
    assert not complaints, "\n" + "\n".join(complaints)


def test_no_files_import_each_other() -> None:
    graph = {
        ".".join(path.with_suffix("").parts).removesuffix(".__init__"): set(imported_modules(path, tree_of(path)))
        for path in files_of(*MAY_IMPORT)
    }
    assert not circles(graph)
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]  # and one would be found


def test_no_file_is_long() -> None:
    lengths = {
        path: len((ROOT / path).read_text(encoding="utf-8").splitlines()) for path in files_of(*MAY_IMPORT, "tests")
    }
    long = [f"{path} has {length} lines" for path, length in lengths.items() if length > MAX_LINES]
    assert not long, f"\nat most {MAX_LINES} lines; a longer file has found a second concept\n" + "\n".join(long)


def test_launch_holds_no_python_package() -> None:
    """A ROS package is named `launch`: ours must never be importable."""
    for path in (ROOT / "launch").rglob("*"):
        if path.is_file() and "__pycache__" not in path.parts and "farside_msgs" not in path.parts:
            assert path.name.endswith((".yaml", ".launch.py")), f"{path.relative_to(ROOT)} does not belong in launch/"
        assert path.name != "__init__.py", f"{path.relative_to(ROOT)} makes launch/ importable"
