"""Live scenes of a simulated person: cameras.yaml, sources.yaml and pictures."""

from pathlib import Path

import cv2
import numpy as np
import yaml

from drake_pose.body import ArticulatedModel
from drake_pose.camera.camera_files import save_cameras
from drake_pose.camera.models import circle_of_cameras
from drake_pose.systems.cameras import build_camera_rig
from tests.person.persons_in_view import posed
from tests.written_files import write_mask

SIZE = (240, 180)
RATE_HZ = 15.0


def standing(person: ArticulatedModel, ahead: float = 0.0, arm_deg: float = 30.0) -> np.ndarray:
    """Return positions (nq,) of a person who stands ahead of the middle [m] with raised arms."""
    # The forearms' silhouettes distinguish front and back.
    return posed(
        person, ahead, left_upper_arm_z=arm_deg, right_upper_arm_z=-30.0, left_forearm_x=-70.0,
        right_forearm_x=-70.0,
    )  # fmt: skip


def absent(person: ArticulatedModel) -> np.ndarray:
    """Return positions (nq,) out of view, 9 m below the ground."""
    return posed(person, z=-9.0)


def write_studio(
    folder: Path, person: ArticulatedModel, poses: list[np.ndarray], kind: str, cameras: int = 3,
    size: tuple[int, int] = SIZE,
) -> None:  # fmt: skip
    """Write a live scene: noisy videos with backgrounds, or folders of masks."""
    placed = circle_of_cameras(cameras, size=size, radius=2.6, face_camera=False)
    save_cameras(folder / "cameras.yaml", placed)
    rig = build_camera_rig(person, placed)
    context = rig.diagram.CreateDefaultContext()
    generator = np.random.default_rng(0)

    def picture(name: str) -> np.ndarray:
        seen = rig.picture(context, name) + generator.normal(0.0, 2.0, (size[1], size[0], 3))
        return cv2.cvtColor(np.clip(seen, 0, 255).astype(np.uint8), cv2.COLOR_RGB2BGR)

    entries, writers = {}, {}
    rig.set_positions(context, absent(person))
    for name in placed:
        if kind == "masks":
            (folder / "masks" / name).mkdir(parents=True)
            entries[name] = {"kind": "folder", "location": f"masks/{name}", "rate_hz": RATE_HZ,
                             "masks": True}  # fmt: skip
            continue
        (folder / "empty" / name).mkdir(parents=True)
        for k in range(3):
            cv2.imwrite(str(folder / "empty" / name / f"{k}.png"), picture(name))
        entries[name] = {"kind": "video", "location": f"{name}.avi", "background": f"empty/{name}"}
        code = cv2.VideoWriter_fourcc(*"MJPG")
        writers[name] = cv2.VideoWriter(str(folder / f"{name}.avi"), code, RATE_HZ, size)
    (folder / "sources.yaml").write_text(yaml.safe_dump(entries))
    for k, q in enumerate(poses):
        rig.set_positions(context, q)
        for name in placed:
            if kind == "masks":
                write_mask(folder / "masks" / name / f"{k:04d}.png", rig.mask(context, name))
            else:
                writers[name].write(picture(name))
    for writer in writers.values():
        writer.release()
