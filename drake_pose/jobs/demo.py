"""The demonstration: joint angles of a real person from one silhouette."""

import json
import shutil
from pathlib import Path

from drake_pose.body import bundled_model
from drake_pose.errors import OutputError, SceneError
from drake_pose.files.folder import OVERLAY, OVERLAY_MODES, RESULT_FILES, SUMMARY, claimed
from drake_pose.files.records import SceneEstimate
from drake_pose.files.settings import EstimateSettings
from drake_pose.files.writer import OnFrame
from drake_pose.jobs.estimate.scene import estimate_scene


def stored_scene(name: str) -> Path:
    """Return the folder of a bundled scene, in a checkout or in the installed package.

    Raises SceneError: the scene is in neither.
    """
    package = Path(__file__).resolve().parents[1]
    for root in (package.parent, package):
        folder = root / "tutorials" / "data" / name
        if (folder / "cameras.yaml").is_file():
            return folder
    raise SceneError(f"the bundled scene '{name}' is missing; install drake_pose again")


def demo_settings(scene: Path) -> EstimateSettings:
    """Return the settings of Kameda, Minoh and Ikeda's experiment B for a standing person.

    ``scene`` is the scene's folder, with root_position.csv. The root is a foot with a known
    position, any heading, and a tilt of up to 20 degrees. The search is the multi-start search at
    continuous angles.
    """
    return EstimateSettings(
        root="right_foot",
        root_position=(scene / "root_position.csv", "right_ankle"),
        root_rotation={"y": (-180.0, 180.0), "x": (-20.0, 20.0), "z": (-20.0, 20.0)},
    )


def run_demo(out: Path, on_frame: OnFrame = lambda *_: None) -> SceneEstimate:
    """Estimate the demonstration's scene.

    ``out``: folder for the result; the result of an earlier demonstration is replaced.
    ``on_frame``: called before and after the only frame. Raises OutputError: it holds other files.
    """
    scene = stored_scene("human")
    with claimed(out, resume=True):
        try:
            summary = json.loads((out / SUMMARY).read_text(encoding="utf-8"))
            is_demo = Path(summary["scene"]).resolve() == scene.resolve()
        except (OSError, ValueError, TypeError, KeyError):
            is_demo = False
        known = {*RESULT_FILES, OVERLAY, OVERLAY_MODES}
        own = [*out.iterdir()] if is_demo else []
        pictures = [one for one in out.rglob("*/*") if one.is_file()]
        if {one.name for one in own} <= known and all(one.suffix == ".png" for one in pictures):
            for file in own:
                try:
                    shutil.rmtree(file) if file.is_dir() else file.unlink()
                except OSError as error:
                    raise OutputError(f"{file}: cannot be removed: {error.strerror}") from error
    return estimate_scene(scene, bundled_model("man"), out, demo_settings(scene), on_frame=on_frame)
