"""Silhouettes that are stored with what the default search finds in them: E_total and pose.

Those of the bundled bodies are drawn by Drake's renderer; the others are real and lie where they
always do. ``python -m tests.silhouettes.stored [NAME]`` draws and estimates them again; do so only
where a body changes or estimates get better, and look at what changes.
"""

import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from drake_pose import MultiStartSearch, PinholeCamera, load_model
from drake_pose.body import PoseTree, bundled_model
from drake_pose.camera.models import look_at
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.demo import stored_scene
from drake_pose.jobs.estimate.scene import estimate_scene
from drake_pose.papers.kameda import REAL_EXPERIMENTS, draw_values
from drake_pose.search import PoseEstimate, View
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer

FOLDER = Path(__file__).parent
COUNT, SIDE, SEED = 20, 240, 2311
# From where the camera looks to where, and the width that it sees there [m].
_VIEWS = {
    "woman": ((4.0, 0.0, -0.55), (0.0, 0.0, -0.55), 2.6),
    "man": ((4.0, 0.0, -0.6), (0.0, 0.0, -0.6), 2.7),
    "person": ((4.0, 0.0, -0.6), (0.0, 0.0, -0.6), 2.7),
    "hand": ((0.8, 0.0, -0.05), (0.0, 0.0, -0.05), 0.6),
    "two_finger_hand": ((0.08, 0.8, 0.0), (0.08, 0.0, 0.0), 0.3),
}
BODIES = tuple(_VIEWS)
REAL = ("B", "C", "hand_photos", "arm_two_views")


def body_tree(body: str) -> PoseTree:
    """A bundled body: its root's place is known, and its lengths are where they are joints."""
    model = load_model(bundled_model(body), check=False)
    if body != "two_finger_hand":
        return model.pose_tree(root_position=np.zeros(3))
    defaults = dict(zip(model.position_names, model.default_positions, strict=True))
    lengths = ("length", "base", "palm_width", "palm_height", "palm_thickness")
    held = {name: value for name, value in defaults.items() if name.startswith(lengths)}
    return model.pose_tree(held=held)


def body_camera(body: str) -> PinholeCamera:
    """The camera of all silhouettes of a body."""
    eye, target, width = (np.array(one) for one in _VIEWS[body])
    focal = SIDE * float(np.linalg.norm(eye - target)) / float(width)
    middle = 0.5 * (SIDE - 1)
    X_WC = look_at(eye, target)
    return PinholeCamera("camera", SIDE, SIDE, focal, focal, middle, middle, X_WC)


def read_body(body: str) -> tuple[list[View], list[dict[str, Any]]]:
    """The silhouettes of a body, and of each what is stored: q_true, q and E_total."""
    sheet = cv2.imread(str(FOLDER / f"{body}.png"), cv2.IMREAD_GRAYSCALE)
    camera = body_camera(body)
    masks = sheet.reshape(COUNT, SIDE, SIDE) > 0
    return [View(camera, mask) for mask in masks], read_table(body)


def read_table(name: str) -> Any:
    """What is stored of a body or of real silhouettes."""
    return json.loads((FOLDER / f"{name}.json").read_text())


def estimate(tree: PoseTree, view: View) -> PoseEstimate:
    """What the default search finds in one silhouette."""
    return MultiStartSearch(tree).match([view])


def estimate_real(name: str, shared_data: Path) -> dict[str, dict[str, Any]]:
    """By frame q and E_total of what the default search finds in real silhouettes, as stills."""
    settings = EstimateSettings(track=False)
    if name in REAL_EXPERIMENTS:
        pictures = REAL_EXPERIMENTS[name]
        scene, model = stored_scene(pictures.scene), bundled_model(pictures.model)
        settings = pictures.settings(scene)
    else:
        scene = shared_data / name
        arm = name == "arm_two_views"
        model = scene / "med7" / "med7.urdf" if arm else bundled_model("hand")
    rows = estimate_scene(scene, model, None, settings).records.values()
    return {row.frame: {"q": row.q.tolist(), "E_total": row.E_total} for row in rows}


def _store(body: str) -> None:
    tree, camera = body_tree(body), body_camera(body)
    renderer, generator = LabelRenderer(tree.model, camera), np.random.default_rng(SEED)
    search = MultiStartSearch(tree)
    masks, rows = [], []
    while len(masks) < COUNT:
        q = tree.positions_from(draw_values(search, "continuous", generator))[0]
        mask = renderer.mask(q)
        if np.concatenate([mask[[0, -1]].ravel(), mask[:, [0, -1]].ravel()]).any():
            continue
        found = estimate(tree, View(camera, mask))
        masks.append(mask)
        rows.append({"q_true": q.tolist(), "q": found.q.tolist(), "E_total": found.E_total})
    cv2.imwrite(str(FOLDER / f"{body}.png"), 255 * np.concatenate(masks).astype(np.uint8))
    (FOLDER / f"{body}.json").write_text(json.dumps(rows) + "\n")


if __name__ == "__main__":
    for one in sys.argv[1:] or (*BODIES, *REAL):
        if one in BODIES:
            _store(one)
        else:
            data = FOLDER.parents[2] / "shared" / "data"
            (FOLDER / f"{one}.json").write_text(json.dumps(estimate_real(one, data)) + "\n")
