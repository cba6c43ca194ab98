"""What is installed is all that exists, and all that is imported is declared and locked."""

import re
import sys
import tomllib
from functools import cache
from importlib.metadata import packages_distributions

from tests.test_architecture import MAY_IMPORT, PACKAGES, ROOT, files_of, imports, tree_of


@cache
def project() -> dict:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


# Scripts for an environment of their own, which has Blender: no package, nothing of it is installed.
INFINIGEN = "probnerf/training/infinigen"
SEPARATE = {"bpy", "infinigen", "make_objects", "one_object"}


def test_installed_packages_are_those_that_exist() -> None:
    found = {str(path.parent).replace("/", ".") for path in files_of(*PACKAGES) if str(path.parent) != INFINIGEN}
    with_init = {str(path.parent).replace("/", ".") for path in files_of(*PACKAGES) if path.name == "__init__.py"}
    assert found == with_init, "a folder of Python files has no __init__.py"
    assert sorted(project()["tool"]["setuptools"]["packages"]) == sorted(with_init | {"node.farside_msgs"})
    assert all((ROOT / name / "py.typed").is_file() for name in PACKAGES), "a package without py.typed has no types"


def extra(name: str) -> list[str]:
    """The requirement lines of an optional dependency."""
    return project()["project"]["optional-dependencies"][name]


def names(requirements: list[str]) -> set[str]:
    """Normalised names of the distributions that requirement lines ask for."""
    return {re.sub("[-_.]+", "-", re.split(r"[^\w.-]", line)[0].lower()) for line in requirements}


def test_every_imported_library_is_declared() -> None:
    """A package imports dependencies and those of the other extras; tests those of `dev`, too."""
    others = [line for name in ("cluster", "dds", "meshes", "planners") for line in extra(name)]
    runtime = names(project()["project"]["dependencies"] + others)
    developer = runtime | names(extra("dev"))
    distributions = packages_distributions()
    undeclared = []
    for folders, declared in ((tuple(MAY_IMPORT), runtime), (("tests",), developer)):
        for path in files_of(*folders):
            for library in sorted(
                imports(path, tree_of(path)) - sys.stdlib_module_names - {*MAY_IMPORT, "tests"} - SEPARATE
            ):
                if not names(distributions.get(library, [library])) & declared:
                    undeclared.append(f"{path} imports {library}, which pyproject.toml does not declare")
    assert not undeclared, "\n" + "\n".join(undeclared)


def test_lock_has_an_exact_version_of_all_that_is_declared() -> None:
    lines = (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines()
    entries = [line for line in lines if line and not line.startswith((" ", "#"))]
    assert all(re.match(r"[\w.-]+==[\w.]+( ;.*)? \\$", entry) for entry in entries)  # and no option, no address
    extras = [line for name in project()["project"]["optional-dependencies"] for line in extra(name)]
    declared = project()["project"]["dependencies"] + extras
    missing = names(declared) - names(entries) - {"farside"}  # `farside[meshes]`: an extra that another one asks for
    assert not missing, f"requirements.lock lacks {', '.join(sorted(missing))}: run `make lock`"
