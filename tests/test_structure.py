"""The rooms and folders of drake_pose, which of them may know which, and that none is too full."""

import ast
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "drake_pose"

MAY_KNOW = {
    "body": set(),
    "camera": set(),
    "silhouette": {"body", "camera"},
    "matching": {"silhouette", "body", "camera"},
    "registration": {"matching", "silhouette", "body", "camera"},
    "filtering": {"matching", "silhouette", "body", "camera"},
    "multiview": {"filtering", "matching", "silhouette", "body", "camera"},
    "systems": {
        "multiview",
        "registration",
        "filtering",
        "matching",
        "silhouette",
        "body",
        "camera",
    },
    "apps": {
        "systems",
        "multiview",
        "registration",
        "filtering",
        "matching",
        "silhouette",
        "body",
        "camera",
    },
}
# Inside a room: which folder may know which, and which module that stands beside the folders.
# "." are all other modules beside the folders; everybody in the room may know them.
MAY_KNOW_INSIDE = {
    "body": {
        "surfaces": set(),
        "files": {"surfaces"},
        ".": set(),
        "parsed_model": {"files", "surfaces"},
        "tree": {"parsed_model", "surfaces"},
        "model": {"tree", "parsed_model", "files", "surfaces"},
        "landmarks": {"tree", "parsed_model"},
        "report": {"tree", "model", "parsed_model", "files", "surfaces"},
        "check_child": {"model", "files"},
    },
    "camera": {".": set(), "calibration": set(), "sources": set()},
    "silhouette": {
        "pictures": set(),
        "areas": {"pictures"},
        "contours": {"areas"},
        "bits": {"areas", "contours"},
        "segmentation": set(),
    },
    "matching": {
        ".": set(),
        "kameda": set(),
        "grid": set(),
        "fit": set(),
        "raster_fit": {"fit"},
        "segmentation": {"fit"},
        "starts": {"raster_fit", "fit", "grid"},
        "continuous": {"starts", "raster_fit", "fit", "grid"},
    },
    "matching/grid": {
        ".": set(),
        "branch_and_bound": set(),
        "families": {"branch_and_bound"},
        "beam": {"families"},
    },
    "filtering": {
        ".": set(),
        "truncation": set(),
        "kalman": {"truncation"},
        "measurements": {"truncation"},
        "hand": set(),
        "tracking": {"measurements", "kalman"},
    },
    "multiview": {".": set(), "date": set(), "person": set(), "recordings": {"person"}},
    "systems": {
        ".": set(),
        "bodies": set(),
        "pictures": {"bodies"},
        "estimators": {"bodies"},
        "date": {"bodies", "pictures"},
        "person": {"bodies", "pictures"},
        "walk": {"bodies"},
    },
    "apps": {
        ".": set(),
        "calibrate": set(),
        "results": set(),
        "check": {"results"},
        "estimate": {"results"},
        "demo": {"estimate", "results"},
        "registration": {"estimate", "results"},
        "experiments": {"demo", "estimate", "results"},
        "live": {"experiments", "estimate", "results"},
        "masks": {"live", "registration", "estimate", "results"},
        "cluster": {"live"},
        "batch": {"cluster", "registration", "estimate", "results"},
        "benchmarks": {
            "batch",
            "cluster",
            "live",
            "experiments",
            "registration",
            "estimate",
            "results",
            "demo",
        },
        "commands": {
            "batch",
            "cluster",
            "live",
            "experiments",
            "masks",
            "registration",
            "estimate",
            "results",
        },
        "main": {"commands", "calibrate", "check", "demo", "estimate"},
    },
    "apps/experiments": {
        "kameda": set(),
        "shimada": set(),
        "date": set(),
        "paper_figures": {"kameda"},
        "all_experiments": {"kameda", "shimada", "date", "paper_figures"},
    },
}
# Drake keeps three plain value types, ImageLabel16I, CameraInfo and CameraConfig, in
# pydrake.systems.sensors.
VALUE_TYPES = {
    "camera/config_files.py",
    "camera/drake.py",
    "silhouette/pictures/label_images.py",
}

# Beside the rooms, for all of them.
FOR_ALL = {"compiled", "errors", "regular_files", "version", "yaml_files"}

MOST_FILES = 20
MOST_LINES = 60

FILES = sorted(PACKAGE.rglob("*.py"))
MODULES = {
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__"): path
    for path in FILES
}


@cache
def imports_of(path: Path) -> list[tuple[str, list[str]]]:
    """All imports of a file: at its head, inside functions, and for type checkers alone."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            found.append((node.module or "", [alias.name for alias in node.names]))
        elif isinstance(node, ast.Import):
            found += [(alias.name, []) for alias in node.names]
    return found


def modules_imported(path: Path) -> set[str]:
    """The modules of drake_pose that a file imports."""
    found = set()
    for module, names in imports_of(path):
        for name in names or [""]:
            longer = f"{module}.{name}"
            found.add(longer if longer in MODULES else module)
    return found & set(MODULES)


def place_in(folder: str, path: Path) -> str:
    """Which of a folder's entries in MAY_KNOW_INSIDE a file belongs to."""
    entry = path.relative_to(PACKAGE / folder).parts[0].removesuffix(".py")
    return entry if entry in MAY_KNOW_INSIDE[folder] else "."


def circles(arrows: dict[str, set[str]]) -> list[set[str]]:
    """Groups of modules that reach each other."""
    reached: dict[str, set[str]] = {}
    for start in arrows:
        seen: set[str] = set()
        queue = list(arrows[start])
        while queue:
            module = queue.pop()
            if module not in seen:
                seen.add(module)
                queue += arrows[module]
        reached[start] = seen
    groups = {
        frozenset(other for other in reached[one] if one in reached[other])
        for one in arrows
        if one in reached[one]
    }
    return [set(group) for group in groups]


def test_every_folder_is_a_known_room():
    rooms = {p.name for p in PACKAGE.iterdir() if p.is_dir() and (p / "__init__.py").exists()}
    assert rooms == set(MAY_KNOW)


def test_every_folder_of_a_room_is_known():
    for folder, known in MAY_KNOW_INSIDE.items():
        found = {path.parent.name for path in (PACKAGE / folder).glob("*/__init__.py")}
        assert found <= set(known), folder
        names = found | {path.stem for path in (PACKAGE / folder).glob("*.py")} | {"."}
        assert set(known) <= names, folder
    deeper = {p.parent.parent.relative_to(PACKAGE).as_posix() for p in FILES if p.stem == "__init__"
              and len(p.relative_to(PACKAGE).parts) > 2}  # fmt: skip
    assert deeper == set(MAY_KNOW_INSIDE)


def test_no_folder_is_too_full():
    counts = {str(folder): len(list(folder.glob("*.py"))) for folder in {p.parent for p in FILES}}
    assert {folder: count for folder, count in counts.items() if count > MOST_FILES + 1} == {}


def test_no_function_is_too_long():
    # A kernel cannot be parted at will: what it calls must be compiled with it.
    too_long = {}
    for path in [*FILES, *sorted((PACKAGE.parent / "urdf").rglob("*.py"))]:
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            count = node.end_lineno - node.lineno + 1
            is_kernel = any("compiled" in ast.unparse(one) for one in node.decorator_list)
            if count > MOST_LINES and not is_kernel:
                too_long[f"{path.relative_to(PACKAGE.parent)}: {node.name}"] = count
    assert too_long == {}


@pytest.mark.parametrize("path", FILES, ids=[str(p.relative_to(PACKAGE)) for p in FILES])
def test_imports_point_left_only(path):
    relative = path.relative_to(PACKAGE)
    room = relative.parts[0]
    if room not in MAY_KNOW:
        return
    for module, names in imports_of(path):
        parts = module.split(".")
        if parts[0] == "drake_pose" and len(parts) > 1 and parts[1] not in FOR_ALL:
            assert parts[1] in MAY_KNOW[room] | {room}, f"{relative} imports {module}"
        if module.startswith("pydrake.systems") and room not in ("systems", "apps"):
            allowed = set(names) <= {"ImageLabel16I", "CameraInfo", "CameraConfig"}
            assert str(relative) in VALUE_TYPES, f"{relative} imports {module}"
            assert allowed, f"{relative} imports {names} from {module}"
        if module == "pydrake.multibody.parsing":
            assert room == "body", f"{relative} parses models"
        assert module != "pydrake.all", relative


@pytest.mark.parametrize("folder", MAY_KNOW_INSIDE)
def test_imports_inside_a_room_point_one_way(folder):
    may_know = MAY_KNOW_INSIDE[folder]
    # What a package's face hands on makes no arrow.
    for path in (p for p in (PACKAGE / folder).rglob("*.py") if p.parent != PACKAGE / folder
                 or p.stem != "__init__"):  # fmt: skip
        here = place_in(folder, path)
        for module in modules_imported(path):
            other = MODULES[module]
            if not other.is_relative_to(PACKAGE / folder):
                continue
            assert other != PACKAGE / folder / "__init__.py", f"{path} imports its room's face"
            there = place_in(folder, other)
            assert there in may_know[here] | {here, "."}, f"{path} imports {module}"


def test_no_modules_import_each_other_in_a_circle():
    # drake_pose/__init__.py hands on names of its rooms when they are asked for.
    arrows = {
        module: modules_imported(path) - {"drake_pose"}
        for module, path in MODULES.items()
        if module != "drake_pose"
    }
    assert circles(arrows) == []
