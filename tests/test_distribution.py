"""The wheel and the source distribution, installed in a fresh environment."""

import json
import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.slow


def run(*command: object, cwd: Path) -> str:
    # Keep the checkout off the search path.
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    words = [str(word) for word in command]
    done = subprocess.run(words, cwd=cwd, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, f"{words}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The wheel, built from the source distribution, and that distribution."""
    folder = tmp_path_factory.mktemp("distribution")
    run(sys.executable, "-m", "build", "--outdir", folder, ROOT, cwd=folder)
    (wheel,), (source,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return wheel, source


def test_distributions_have_the_expected_files(built: tuple[Path, Path]) -> None:
    wheel, source = built
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    assert {"drake_pose/compiled.py", "drake_pose/urdf/man/man.urdf"} <= names
    for scene in ("human", "experiment_b", "experiment_c"):
        assert f"drake_pose/tutorials/data/{scene}/NOTICE" in names
    assert not [name for name in names if name.startswith("tests/") or name.endswith(".nbi")]
    with tarfile.open(source) as archive:
        parts = {Path(name).parts[1] for name in archive.getnames()}
    assert {"drake_pose", "urdf", "tests", "tutorials", "README.md", "LICENSE"} <= parts


def test_the_demonstration_runs_from_the_wheel(built: tuple[Path, Path], tmp_path: Path) -> None:
    wheel, _ = built
    environment, away = tmp_path / "environment", tmp_path / "a stranger's folder ä"
    away.mkdir()
    run(sys.executable, "-m", "venv", environment, cwd=away)
    run(environment / "bin" / "pip", "install", "--quiet", wheel, cwd=away)
    program = environment / "bin" / "drake-pose"
    shown = run(program, "demo", "--json", "--out", away / "result", cwd=away)
    assert json.loads(shown)["found_count"] == 1
    assert (away / "result" / "overlay" / "cam04" / "0010.png").is_file()
    place = run(
        environment / "bin" / "python", "-c", "import drake_pose; print(drake_pose.__file__)",
        cwd=away,
    )  # fmt: skip
    assert Path(place.strip()).is_relative_to(environment)
