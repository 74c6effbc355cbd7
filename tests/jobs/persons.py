"""Small recordings of the bundled person, drawn by Drake's renderer."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drake_pose.body import ArticulatedModel, bundled_model, load_model
from drake_pose.camera.camera_files import save_cameras
from drake_pose.camera.models import circle_of_cameras
from tests.jobs.scenes import write_masks
from tests.person.persons_in_view import posed


@dataclass(frozen=True)
class PersonScene:
    """A scene's folder, its model, and the true positions (frames, nq)."""

    folder: Path
    person: ArticulatedModel
    truth: np.ndarray

    def estimate(self, out: Path, command: str = "estimate") -> list[str]:
        """Return the words of an estimate or capture command."""
        model = str(self.person.path)
        return [command, str(self.folder), "--model", model, "--out", str(out), "--no-replay"]


def record_person(
    folder: Path, frames: int = 3, sequence: bool = True, size: tuple[int, int] = (160, 120)
) -> PersonScene:
    """Write a recording of a person who raises an arm."""
    folder.mkdir(parents=True, exist_ok=True)
    person = load_model(bundled_model("person"), check=False)
    cameras = circle_of_cameras(4, size=size, face_camera=False)
    save_cameras(folder / "cameras.yaml", cameras)
    rate = "frame_rate_hz: 30\n" if sequence else ""
    (folder / "scene.yaml").write_text(f"sequence: {str(sequence).lower()}\n{rate}")
    arms = [(30.0 + 10.0 * k, -30.0) for k in range(frames)]
    truth = np.array([posed(person, left_upper_arm_z=a, right_upper_arm_z=b) for a, b in arms])
    write_masks(folder, person, cameras.values(), truth)
    return PersonScene(folder, person, truth)
