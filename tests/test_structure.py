"""The rooms of drake_pose, and which of them may know which."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "drake_pose"

MAY_KNOW = {
    "body": set(),
    "camera": set(),
    "silhouette": {"body", "camera"},
    "matching": {"silhouette", "body", "camera"},
    "filtering": {"matching", "silhouette", "body", "camera"},
    "multiview": {"filtering", "matching", "silhouette", "body", "camera"},
    "systems": {"multiview", "filtering", "matching", "silhouette", "body", "camera"},
    "apps": {"systems", "multiview", "filtering", "matching", "silhouette", "body", "camera"},
}
# Drake keeps two plain value types, ImageLabel16I and CameraInfo, in pydrake.systems.sensors.
VALUE_TYPES = {"camera/models.py", "camera/drake.py", "silhouette/pictures/label_images.py"}

# Beside the rooms, for all of them.
FOR_ALL = {"compiled", "errors", "regular_files", "yaml_files"}

FILES = sorted(PACKAGE.rglob("*.py"))


def imports_of(path: Path) -> list[tuple[str, list[str]]]:
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            found.append((node.module or "", [alias.name for alias in node.names]))
        elif isinstance(node, ast.Import):
            found += [(alias.name, []) for alias in node.names]
    return found


def test_every_folder_is_a_known_room():
    rooms = {p.name for p in PACKAGE.iterdir() if p.is_dir() and (p / "__init__.py").exists()}
    assert rooms == set(MAY_KNOW)


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
            allowed = set(names) <= {"ImageLabel16I", "CameraInfo"}
            assert str(relative) in VALUE_TYPES, f"{relative} imports {module}"
            assert allowed, f"{relative} imports {names} from {module}"
        if module == "pydrake.multibody.parsing":
            assert room == "body", f"{relative} parses models"
        assert module != "pydrake.all", relative
