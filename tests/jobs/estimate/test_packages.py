"""`--package NAME=FOLDER` on every command that reads a model."""

import json
import shutil
from pathlib import Path

import pytest
import trimesh

from drake_pose.commands.main import app
from drake_pose.errors import SettingsError
from drake_pose.files.options import parse_packages
from tests.cli import CliRunner, Result
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


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(one) for one in arguments])


def assert_names_option(result: Result) -> None:
    assert result.exit_code == 1, result.output
    message = " ".join(result.stderr.split())
    assert "link 'boom': mesh 'package://parts/boom.stl'" in message
    assert "--package parts=FOLDER" in message


def test_another_form_is_wrong_usage(far: tuple[Path, Path]) -> None:
    for text in ("parts", "=x", "parts=", "parts=/no/such/folder"):
        result = run("check", far[0], "--package", text)
        assert result.exit_code == 2
        assert "--package" in result.stderr
    with pytest.raises(SettingsError, match="given twice"):
        parse_packages([f"a={far[1]}", f"a={far[1]}"])


def test_estimate_and_its_resumption(
    tmp_path: Path, tiny_scene: TinyScene, far: tuple[Path, Path]
) -> None:
    model, folder = far
    out = tmp_path / "out"
    arguments = ("estimate", tiny_scene.folder, "--model", model, "--out", out, "--interval", 20)
    arguments = (*arguments, "--no-replay", "--no-overlay")
    assert_names_option(run(*arguments))
    assert_names_option(run("check", model))
    package = ("--package", f"parts={folder}")
    assert run("check", model, *package).exit_code == 0
    result = run(*arguments, *package, "--frame", "0")
    assert result.exit_code == 0, result.output
    summary = json.loads((out / "summary.json").read_text())
    assert summary["settings"]["packages"] == {"parts": str(folder)}
    assert summary["found_count"] == 1
    moved = folder.with_name("moved")
    shutil.copytree(folder, moved)
    refused = run(*arguments, "--resume", "--package", f"parts={moved}")
    assert refused.exit_code == 1
    assert "packages" in refused.stderr
    resumed = run(*arguments, *package, "--frame", "0:1", "--resume")
    assert resumed.exit_code == 0, resumed.output
    assert json.loads((out / "summary.json").read_text())["found_count"] == 2
