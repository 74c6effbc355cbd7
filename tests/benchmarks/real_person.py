"""Date's search on a real person: python -m tests.benchmarks.real_person SCENE MODEL OUT.

SCENE has masks and joint_centres.csv, whose head, wrists and ankles replace the skin features that
masks do not show; MODEL is a person with the same lengths (urdf/person/make_person.py). OUT is the
folder of the resulting image.
"""

import csv
import json
import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from drake_pose.body import landmark_positions, load_landmarks, load_model
from drake_pose.papers.tables import draw_panels, save_figure
from drake_pose.person.date.pose import estimate_pose
from drake_pose.person.date.skeleton import LIMBS, load_skeleton
from drake_pose.silhouette.pictures.scenes import load_scene

ENDS = ("left_wrist", "right_wrist", "left_ankle", "right_ankle")
MIDDLES = ("left_elbow", "right_elbow", "left_knee", "right_knee")
# Colours without and with a search for elbows and knees.
COLOURS = {False: (220, 60, 40), True: (40, 110, 230)}
SHOWN = "0020"


def skeleton_of(path):
    """Return the skeleton of a person whose limbs end at wrists and ankles."""
    model = load_model(path, check=False)
    skeleton, names = load_skeleton(model), load_landmarks(model.path)
    q = np.zeros(len(skeleton.lower))
    marks = dict(zip(names, landmark_positions(model, names, q), strict=True))
    X_WN = skeleton.poses(q)

    def inside(node, place):
        return X_WN[node, :3, :3].T @ (place - X_WN[node, :3, 3])

    limbs = {
        name: replace(limb, end_L=inside(limb.lower_node, marks[end]))
        for (name, limb), end in zip(skeleton.limbs.items(), ENDS, strict=True)
    }
    face = inside(skeleton.nodes["head"], 0.5 * (marks["head_top"] + marks["neck"]))
    return replace(skeleton, limbs=limbs, face_H=face)


def main(folder, model, out):
    truth, scene = defaultdict(lambda: defaultdict(lambda: np.full(3, np.nan))), load_scene(folder)
    with (folder / "joint_centres.csv").open(newline="") as stream:
        for row in csv.DictReader(stream):
            truth[int(row["frame"])][row["joint"]] = np.array([float(row[k]) for k in "xyz"])
    skeleton, cameras = skeleton_of(model), list(scene.cameras.values())
    states, errors = {}, defaultdict(list)
    for name in scene.frames:
        at = truth[int(name)]
        features = np.array([0.5 * (at["head_top"] + at["neck"]), *(at[end] for end in ENDS)])
        if np.isnan(features).any():
            continue
        waists = {"paper's": None, "true": 0.5 * (at["left_hip"] + at["right_hip"])}
        masks = [scene.read(camera.name, name) for camera in cameras]
        drawn = [np.where(one[..., None], (255,) * 3, (120,) * 3).astype(np.uint8) for one in masks]
        for method in ((waist, search) for waist in waists for search in COLOURS):
            if method not in states:
                # Start upright, facing the direction given by the shoulders.
                across, states[method] = (
                    at["left_shoulder"] - at["right_shoulder"],
                    np.zeros(len(skeleton.lower)),
                )
                states[method][skeleton.head_angles[0]] = np.arctan2(-across[0], across[1])
            evidence = (features, None, cameras, masks)
            states[method], limbs = estimate_pose(
                skeleton, states[method], *evidence, search=method[1], waist=waists[method[0]]
            )
            found = np.array([limbs[limb][1] for limb in LIMBS])
            errors[method].append(np.linalg.norm(found - [at[one] for one in MIDDLES], axis=1))
            for camera, picture in zip(cameras, drawn, strict=True) if method[0] == "true" else ():
                lines = [np.rint(camera.project(one)[0]).astype(np.int32) for one in limbs.values()]
                cv2.polylines(picture, lines, False, COLOURS[method[1]], 7)
        if name == SHOWN:
            save_figure(
                draw_panels([[one] for one in drawn], list(scene.cameras)), out / "limbs.png"
            )
    for method, rows in errors.items():
        elbows, knees = 1e3 * np.nanmean(np.reshape(rows, (-1, 2, 2)), axis=(0, 2))
        print(json.dumps({"method": method, "elbows_mm": round(elbows), "knees_mm": round(knees)}))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:4]))
