"""Structure of drake_pose: permitted imports, and maximum sizes of folders, files and functions."""

import ast
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from tests import sums

PACKAGE = Path(__file__).resolve().parents[1] / "drake_pose"

# A subpackage may import those before it in this order, except the pairs in NOT_IMPORTED.
SUBPACKAGES = (
    "body",
    "camera",
    "silhouette",
    "fit",
    "search",
    "registration",
    "filtering",
    "person",
    "systems",
    "files",
    "jobs",
    "papers",
    "commands",
)
NOT_IMPORTED = {("camera", "body"), ("filtering", "registration"), ("person", "registration")}
WITH_SYSTEMS = {"systems", "files", "jobs", "papers", "commands"}
# These files may import three plain value types of pydrake.systems.sensors: ImageLabel16I,
# CameraInfo and CameraConfig.
VALUE_TYPES = {"camera/exchange.py", "silhouette/pictures/label_renderer.py"}

# Modules that all subpackages may import.
COMMON_MODULES = {*("arrays", "compiled", "errors", "input_files", "version", "workers")}

MOST_FILES, MOST_FILE_LINES, MOST_LINES = 20, 600, 100

FILES = sorted(PACKAGE.rglob("*.py"))
MODULES = {
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__"): path
    for path in FILES
}


@cache
def imports_of(path: Path) -> list[tuple[str, list[str]]]:
    """Return all imports of a file: at its top, inside functions, and for type checkers only."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            found.append((node.module or "", [alias.name for alias in node.names]))
        elif isinstance(node, ast.Import):
            found += [(alias.name, []) for alias in node.names]
    return found


def modules_imported(path: Path) -> set[str]:
    """Return the modules of drake_pose that a file imports."""
    found = set()
    for module, names in imports_of(path):
        for name in names or [""]:
            longer = f"{module}.{name}"
            found.add(longer if longer in MODULES else module)
    return found & set(MODULES)


def require_no_cycle(arrows: dict[str, set[str]]) -> None:
    """Fail, with a cycle, if one of the names reaches itself."""
    TopologicalSorter({one: to - {one} for one, to in arrows.items()}).prepare()


def test_every_folder_is_a_known_subpackage():
    subpackages = {p.name for p in PACKAGE.iterdir() if p.is_dir() and (p / "__init__.py").exists()}
    assert subpackages == set(SUBPACKAGES)


def test_no_sum_of_the_tree_grows():
    # Smaller sums are written by `python -m tests.sums`; a feature pays for itself.
    counted, most = sums.count(PACKAGE.parent), sums.read_table()
    assert counted.keys() == most.keys()
    assert {name: n for name, n in counted.items() if n > most[name]} == {}


def test_sums_of_a_small_tree(tmp_path):
    (tmp_path / "drake_pose").mkdir()
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "test_one.py").write_text("\n\n\n")
    (tmp_path / "drake_pose" / "one.py").write_text(
        '''"""A docstring
of two lines."""

import math


class FitSettings:
    """Settings."""

    width: int = 7
    name: str = "a"


# A comment.
def _once(a, b=0.7, *, c=True, d=5):
    def inner(e=3):
        return 7.5 * e  # 12, 0.5 and 90 are plain.

    return inner(a) + b + 90 - 0.5


def _twice():
    return _once(1) + _recursive(_recursive(12))
'''
    )
    assert sums.count(tmp_path) == {
        "lines": 23, "lines_of_code": 9, "files": 1, "classes": 1, "chosen_numbers": 5,
        "numbers_in_functions": 1, "functions_with_one_caller": 2, "lines_of_tests": 3,
    }  # fmt: skip


def test_no_folder_has_too_many_files():
    counts = {str(folder): len(list(folder.glob("*.py"))) for folder in {p.parent for p in FILES}}
    assert {folder: count for folder, count in counts.items() if count > MOST_FILES + 1} == {}


def test_no_file_is_too_long():
    counts = {str(path): path.read_text().count("\n") for path in FILES}
    assert {path: count for path, count in counts.items() if count > MOST_FILE_LINES} == {}


def test_no_function_is_too_long():
    too_long = {}
    for path in [*FILES, *sorted((PACKAGE.parent / "urdf").rglob("*.py"))]:
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            count = node.end_lineno - node.lineno + 1
            if count > MOST_LINES:
                too_long[f"{path.relative_to(PACKAGE.parent)}: {node.name}"] = count
    assert too_long == {}


@pytest.mark.parametrize("path", FILES, ids=[str(p.relative_to(PACKAGE)) for p in FILES])
def test_subpackages_import_earlier_ones_only(path):
    relative = path.relative_to(PACKAGE)
    subpackage = relative.parts[0]
    if subpackage not in SUBPACKAGES:
        return
    may_import = set(SUBPACKAGES[: SUBPACKAGES.index(subpackage) + 1]) - {
        one for here, one in NOT_IMPORTED if here == subpackage
    }
    for module, names in imports_of(path):
        parts = module.split(".")
        if parts[0] == "drake_pose" and len(parts) > 1 and parts[1] not in COMMON_MODULES:
            assert parts[1] in may_import, f"{relative} imports {module}"
        if module.startswith("pydrake.systems") and subpackage not in WITH_SYSTEMS:
            allowed = set(names) <= {"ImageLabel16I", "CameraInfo", "CameraConfig"}
            assert str(relative) in VALUE_TYPES, f"{relative} imports {module}"
            assert allowed, f"{relative} imports {names} from {module}"
        if module == "pydrake.multibody.parsing":
            assert subpackage == "body", f"{relative} parses models"
        assert module != "pydrake.all", relative


@pytest.mark.parametrize("subpackage", SUBPACKAGES)
def test_folders_of_a_subpackage_have_no_import_cycle(subpackage):
    # Modules beside a subpackage's folders may import them, and be imported by them.
    arrows: dict[str, set[str]] = {}
    for path in (PACKAGE / subpackage).glob("*/**/*.py"):
        there = {MODULES[module].parent for module in modules_imported(path)}
        inside = {str(one) for one in there if PACKAGE / subpackage in one.parents}
        arrows.setdefault(str(path.parent), set()).update(inside)
    require_no_cycle(arrows)


def test_modules_have_no_import_cycle():
    # drake_pose/__init__.py imports names of its subpackages lazily.
    arrows = {
        module: modules_imported(path) - {"drake_pose"}
        for module, path in MODULES.items()
        if module != "drake_pose"
    }
    require_no_cycle(arrows)
