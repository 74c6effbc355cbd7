"""`--package NAME=FOLDER` on every command that reads a model."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import trimesh

from drake_pose.errors import SettingsError
from drake_pose.files.settings import parse_packages
from tests.cli import assert_refused, run_command, run_to_end
from tests.jobs.scenes import LINK, TinyScene

BOOM = LINK.format(name="boom", z=0.25, size="0.1 0.12 0.5")


@pytest.fixture
def far(tmp_path: Path, tiny_scene: TinyScene) -> tuple[Path, Path]:
    """A model whose boom is a mesh of a package that lies far away, and that package's folder."""
    folder = tmp_path / "far away" / "crane parts"
    folder.mkdir(parents=True)
    trimesh.creation.box((0.1, 0.12, 0.5)).export(folder / "boom.stl")
    model = tmp_path / "robots" / "crane.urdf"
    model.parent.mkdir()
    mesh = BOOM.replace('<box size="0.1 0.12 0.5"/>', '<mesh filename="package://parts/boom.stl"/>')
    assert mesh != BOOM
    model.write_text(tiny_scene.model.read_text().replace(BOOM, mesh))
    return model, folder


def test_a_package_is_named_where_it_is_missing_and_may_not_move(
    out: Path, tiny_scene: TinyScene, far: tuple[Path, Path]
) -> None:
    model, folder = far
    scene = replace(tiny_scene, model=model)
    words = [*scene.estimate(out), "--no-replay", "--no-overlay"]
    package = ["--package", f"parts={folder}"]
    for command in (words, ["check", str(model)]):
        missing = ("link 'boom': mesh 'package://parts/boom.stl'", "--package parts=FOLDER")
        assert_refused(run_command(command), *missing)
        for text in ("parts", "=x", "parts=", "parts=/no/such/folder"):
            assert_refused(run_command([*command, "--package", text]), "--package", status=2)
    run_to_end("check", model, *package)
    run_to_end(*words, *package, "--frame", "0")
    summary = json.loads((out / "summary.json").read_text())
    assert summary["settings"]["packages"] == {"parts": str(folder)}
    assert summary["found_count"] == 1
    moved = shutil.copytree(folder, folder.with_name("moved"))
    again = [*words, "--resume", "--package"]
    assert_refused(run_command([*again, f"parts={moved}"]), "packages")
    run_to_end(*again, f"parts={folder}", "--frame", "0:1")
    assert json.loads((out / "summary.json").read_text())["found_count"] == 2
    with pytest.raises(SettingsError, match="given twice"):
        parse_packages([f"a={folder}", f"a={folder}"])
