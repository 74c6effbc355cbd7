import numpy as np
import pytest

from drake_pose.body import landmark_positions, load_landmarks
from drake_pose.camera.models import circle_of_cameras
from drake_pose.errors import ModelError, SettingsError
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.fit.evidence import find_edge_points
from drake_pose.fit.surfaces import with_radius_scales
from drake_pose.person.capture import capture_person
from drake_pose.person.pose_tracker import NOISE, fit_shape, shape_values
from drake_pose.silhouette.pictures.scenes import load_scene
from drake_pose.silhouette.scoring import draw_mask
from tests.jobs.scenes import read_rows
from tests.person.persons_in_view import SIDES, stepping

PAIRS = {"thigh": -0.03, "shin": 0.03, "upper_arm": 0.025, "forearm": -0.02}
LENGTHS = {"trunk_stretch": 0.03}
LENGTHS |= {f"{side}_{part}_stretch": way for part, way in PAIRS.items() for side in SIDES}


def joint_errors(person, scene, frames, positions):
    """Return the errors of the joint centres in some frames at positions (frames, nq) [mm]."""
    landmarks, places = load_landmarks(person.path), {}
    for frame, q in zip(frames, positions, strict=True):
        found = landmark_positions(person, landmarks, q)
        places |= {(int(frame), name): p for name, p in zip(landmarks, found, strict=True)}
    return [
        1e3 * np.linalg.norm(places[key] - [float(row[axis]) for axis in "xyz"])
        for row in read_rows(scene.path / "joint_centres.csv")
        if (key := (int(row["frame"]), row["joint"])) in places and key[1] != "head_top"
    ]


@pytest.fixture(scope="module")
def cameras():
    return circle_of_cameras(5, size=(320, 240), face_camera=False)


class TestShape:
    def test_lengths_and_radius_scales_are_found(self, shaped_person, cameras):
        fit = ContourFit(shaped_person.pose_tree(), noise=NOISE)
        order = [shaped_person.position_index(name) for name in fit.kinematics.names]
        factors = {"trunk": 1.1, "thigh": 1.2, "shin": 0.9}
        radius_scales = np.ones(len(fit.outlines))
        for k, node in enumerate(fit.tree.nodes):
            for part, factor in factors.items():
                if part in node.name:
                    radius_scales[k] = factor
        outlines = with_radius_scales(fit.outlines, radius_scales)
        frames, starts = [], []
        for phase in np.linspace(0.0, 2 * np.pi, 6, endpoint=False):
            q = stepping(shaped_person, phase, knees=45.0)
            starts.append(q[order])
            worn = q.copy()
            for name, stretch in LENGTHS.items():
                worn[shaped_person.position_index(name)] = stretch
            X_WN = fit.kinematics.poses(worn[order])
            masks = [draw_mask(outlines, c.X_CW @ X_WN, c) for c in cameras.values()]
            frames.append((list(cameras.values()), [find_edge_points(m, 3.0) for m in masks]))
        shape = fit_shape(fit, frames, np.array(starts))
        found = dict(zip(fit.kinematics.names, shape.values, strict=True))
        off = np.array([found[name] - stretch for name, stretch in LENGTHS.items()])
        assert np.abs(off).max() < 0.02
        assert np.abs(off).mean() < 0.5 * np.mean(np.abs(list(LENGTHS.values())))
        for part, factor in factors.items():
            assert shape.radius_scales[part] == pytest.approx(factor, abs=0.05), part
        off = np.array([x - LENGTHS.get(name, 0.0) for name, x in shape.lengths.items()])
        assert 0.05 < off @ np.linalg.solve(shape.covariance, off) / len(off) < 2.0

    def test_model_of_fixed_lengths_is_refused(self, person):
        assert not shape_values(person.pose_tree()).any()
        with pytest.raises(ModelError, match="shape joints"):
            fit_shape(ContourFit(person.pose_tree()), [], np.zeros((0, 23)))


class TestCapture:
    @pytest.mark.parametrize(("frames", "word"), [([], "one frame"), ([0, 1], "two cameras")])
    def test_recordings_without_frames_or_persons_are_refused(
        self, shaped_person, cameras, frames, word
    ):
        empty = {name: np.zeros((240, 320), dtype=bool) for name in cameras}
        with pytest.raises(SettingsError, match=word):
            capture_person(shaped_person.pose_tree(), cameras, lambda _: empty, frames)

    @pytest.mark.parametrize("frame", ["0025", "0040"], ids=["leg", "turned about"])
    def test_still_of_unknown_proportions_is_not_mistaken_for_another_pose(
        self, shaped_person, shared_data, frame
    ):
        """With average proportions a wrong leg, or a person turned about, fits better."""
        scene = load_scene(shared_data / "human_four_views")
        masks = {name: scene.read(name, frame) for name in scene.cameras}
        captured = capture_person(
            shaped_person.pose_tree(), scene.cameras, lambda _: masks, [0], is_sequence=False
        )
        assert np.nanmax(joint_errors(shaped_person, scene, [frame], captured.q)) < 120.0

    @pytest.mark.slow
    def test_wrong_pose_of_one_still_does_not_spoil_the_common_shape(
        self, shaped_person, shared_data
    ):
        """A still turned about by 180 degrees can turn others through the common shape."""
        scene = load_scene(shared_data / "human_four_views")
        frames = scene.frames[::5]
        captured = capture_person(
            shaped_person.pose_tree(), scene.cameras,
            lambda k: {name: scene.read(name, frames[k]) for name in scene.cameras},
            range(len(frames)), is_sequence=False,
        )  # fmt: skip
        assert captured.inlier_ratios.min() > 0.88
        assert np.ptp(np.unwrap(captured.q[:, shaped_person.position_index("head_y")])) < np.pi / 2

    @pytest.mark.slow
    def test_real_person_of_unknown_proportions(self, shaped_person, shared_data):
        scene = load_scene(shared_data / "human_four_views")
        frames = scene.frames[::8]

        def read(k):
            return {name: scene.read(name, frames[k]) for name in scene.cameras}

        captured = capture_person(
            shaped_person.pose_tree(), scene.cameras, read, range(len(frames))
        )
        assert np.mean(joint_errors(shaped_person, scene, frames, captured.q)) < 60.0
        assert captured.deviations.shape == captured.q.shape
        angles = [k for k, kind in enumerate(shaped_person.position_kinds) if kind == "angle"]
        assert (captured.deviations[:, angles] > 0.003).all()
        assert np.median(captured.deviations[:, angles]) < 0.15
        assert (captured.q >= shaped_person.lower - 1e-9).all()
        assert (captured.q <= shaped_person.upper + 1e-9).all()
        ious = []
        for k in (0, len(frames) // 2, len(frames) - 1):
            X_WN = captured.tree.node_poses(captured.tree.values_from_positions(captured.q[k]))
            for name, mask in read(k).items():
                camera = scene.cameras[name]
                body = draw_mask(captured.outlines, camera.X_CW @ X_WN, camera)
                ious.append((body & mask).sum() / (body | mask).sum())
        assert np.mean(ious) > 0.75
