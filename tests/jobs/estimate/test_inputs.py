"""Inputs of an estimate: pose trees, held joints, starts, measured positions; and refusals."""

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from pydrake.multibody.tree import BodyIndex

from drake_pose.body import bundled_model, load_model
from drake_pose.camera.camera_files import save_cameras
from drake_pose.camera.episode import JointLog
from drake_pose.camera.models import circle_of_cameras
from drake_pose.errors import DrakePoseError, SceneError, SettingsError, UnknownNameError
from drake_pose.files.overlay import draw_overlay
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.estimate.inputs import (
    EstimateInputs,
    draw_parts,
    follows_person,
    leave_out_links,
    make_placement_search,
    make_tree,
    missing_for_person,
    read_inputs,
)
from drake_pose.search import MultiStartSearch, PaperSearch, PoseEstimate, RootPlacementSearch
from drake_pose.silhouette.outline import TreeSurfaces
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.silhouette.pictures.scenes import load_scene
from tests.jobs.scenes import (
    JOINT,
    LINK,
    NAMES,
    URDF,
    camera,
    edit_camera,
    write_masks,
    write_truth,
)
from tests.person.persons_in_view import posed
from tests.search.arms import crane


@pytest.fixture(scope="module")
def model(tiny_scene):
    return load_model(tiny_scene.model)


@pytest.fixture(scope="module")
def scene(tiny_scene):
    return load_scene(tiny_scene.folder)


def poses_of(model, q):
    """Return Drake's poses (4, 4) by link."""
    context = model.plant.CreateDefaultContext()
    model.plant.SetPositions(context, q)
    bodies = [model.plant.get_body(BodyIndex(k)) for k in range(model.plant.num_bodies())]
    return {one.name(): one.EvalPoseInWorld(context).GetAsMatrix4() for one in bodies}


@pytest.mark.parametrize("turns", [None, "fixed", "free", {"x": (-180.0, 180.0)}])
def test_another_root_stands_as_in_the_model_by_default(model, turns):
    """Its rotation is relative to Drake's at the default positions; its position is given."""
    place = np.array([0.3, -0.2, 0.7])
    settings = EstimateSettings(
        root="jib", root_position=tuple(place), root_rotation=turns, hold={"lift": 30.0}
    )
    tree = make_tree(model, settings, place)
    assert tree.root == "jib"
    assert tree.held == {model.position_index("lift"): np.radians(30.0)}
    known = poses_of(model, np.where(np.array(NAMES) == "lift", 0.0, model.default_positions))
    X_WN = tree.node_poses(tree.default_values())[0]
    np.testing.assert_allclose(X_WN[:3, 3], place, atol=1e-12)
    if turns is not None:
        np.testing.assert_allclose(X_WN[:3, :3], known["jib"][:3, :3], atol=1e-9)
    assert tree.turns_root_freely == (turns in (None, "free"))


def test_own_root_turns_only_where_the_world_does_not_hold_it(model):
    own = make_tree(model, EstimateSettings())
    assert (own.root, own.held) == (model.pose_tree().root, {})
    with pytest.raises(UnknownNameError, match="swing"):
        make_tree(model, EstimateSettings(hold={"swing": 3.0}))
    with pytest.raises(SettingsError, match=r"root rotation needs a root.*base, boom, jib"):
        make_tree(replace_world(model), EstimateSettings(root_rotation="free"))


def replace_world(model):
    """Return the crane with its bolt turning, so that the world is the tree's root."""
    path = model.path.with_name("swivel.urdf")
    limits = '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
    bolt = '<joint name="bolt" type="fixed"><parent link="world"/><child link="base"/>'
    path.write_text(URDF.replace(bolt + "</joint>", bolt.replace("fixed", "revolute") + limits))
    return load_model(path)


def test_a_body_that_turns_freely_is_searched_from_its_middle():
    """Unless a root is given; one that cannot turn is searched as the model has it."""
    hand = load_model(bundled_model("hand"), check=False)
    place = np.array([0.1, 0.2, 0.3])
    search = make_placement_search(hand, EstimateSettings(), place, scale_unknown=True)
    neighbours = {n.name: len(n.children) + (n.parent >= 0) for n in search.tree.nodes}
    assert neighbours[search.tree.nodes[0].name] == max(neighbours.values())
    assert search.tree.turns_root_freely
    assert search.scale_unknown
    np.testing.assert_allclose(
        search.tree.node_poses(search.tree.default_values())[0][:3, 3], place
    )
    for more in ({"root": "forearm"}, {"root": "forearm", "root_rotation": "fixed"}):
        settings = EstimateSettings(root_position="unknown", **more)
        other = make_placement_search(hand, settings, None, scale_unknown=False)
        assert other.tree.nodes[0].name == "forearm"
        assert not other.scale_unknown
    with pytest.raises(SettingsError, match="method beam"):
        make_placement_search(hand, EstimateSettings(method="paper"), None, False)


def test_joints_of_links_that_are_left_out_are_held_at_their_defaults(tmp_path):
    """But not one that moves a link that is left, and given values have precedence."""
    tool = JOINT.format(name="tilt", parent="jib", child="tool", z=0.4, lower=0.5, upper=2.0)
    rail = JOINT.format(name="slide", parent="base", child="rail", z=0.1, lower=0.2, upper=0.4)
    rail = rail.replace("revolute", "prismatic")
    twin = JOINT.format(name="twin", parent="base", child="other", z=0.1, lower=-1.6, upper=1.6)
    twin = twin.replace("</joint>", '<mimic joint="lift"/></joint>')
    links = [LINK.format(name=one, z=0.1, size="0.1 0.1 0.2") for one in ("tool", "rail", "other")]
    path = tmp_path / "tools.urdf"
    path.write_text(URDF.replace("</robot>", "".join([*links, tool, rail, twin, "</robot>"])))
    model = load_model(path)
    left, settings = leave_out_links(
        model, EstimateSettings(unseen=("tool", "rail"), hold={"luff": 3.0})
    )
    defaults = dict(zip(model.position_names, model.default_positions, strict=True))
    assert settings.hold == {
        "luff": 3.0, "tilt": pytest.approx(np.degrees(defaults["tilt"])),
        "slide": pytest.approx(defaults["slide"]),
    }  # fmt: skip
    assert defaults["tilt"] >= 0.5
    assert not {"tool", "rail"} & {*left.link_meshes}
    # The boom is not seen, but its joint also moves the other arm.
    _, settings = leave_out_links(model, EstimateSettings(unseen=("boom",)))
    assert settings.hold == {}
    with pytest.raises(UnknownNameError, match="hook"):
        leave_out_links(model, EstimateSettings(unseen=("hook",)))


def plain_inputs(scene, model, **more):
    known = {"tracked": False, "search": None, "truth": None} | more
    return EstimateInputs(scene, model, scene.frames, **known)


def test_joint_errors_are_modulo_full_turns(scene, model, tmp_path):
    """As for a UR5 with limits of 360 degrees: 331.5 degrees measured, -28.5 estimated."""
    truth = JointLog(("luff", "swing"), None, np.radians([[331.5, 178.0]]), ("0",))
    inputs = plain_inputs(scene, crane(tmp_path), truth=truth)
    errors = inputs.joint_errors("0000", np.radians([177.0, -28.0]))
    assert errors == pytest.approx({"luff": 0.5, "swing": -1.0})
    assert inputs.joint_errors("0001", np.zeros(2)) == {}
    assert plain_inputs(scene, model).joint_errors("0000", np.zeros(2)) == {}


def test_tracking_of_a_single_parallel_camera_waits_for_rest(scene, model, tiny_scene):
    hand = load_model(bundled_model("hand"), check=False)
    placed = make_placement_search(hand, EstimateSettings(), None, True)
    known = MultiStartSearch(make_tree(model, EstimateSettings()))
    assert plain_inputs(scene, model, search=known).tracking() is None
    settings = plain_inputs(scene, model, search=known, tracked=True).tracking()
    assert (settings.root_moves, settings.scale_unknown, settings.rest_time) == (False, False, None)
    bare = replace(scene, scale_unknown=True)
    settings = plain_inputs(bare, hand, search=placed, tracked=True).tracking()
    assert (settings.root_moves, settings.scale_unknown, settings.rest_time) == (True, True, 1.0)
    moves = [
        plain_inputs(scene, one, search=search).base_moves
        for one, search in ((model, None), (model, known), (hand, placed))
    ]
    assert moves[:2] == [False, False]
    turned = EstimateSettings(root="jib", root_position=(0, 0, 0), root_rotation="free")
    other = MultiStartSearch(make_tree(model, turned, np.zeros(3)))
    assert plain_inputs(scene, model, search=other).base_moves


def test_records_compare_the_masks_with_the_body(scene, model, tiny_scene):
    q = tiny_scene.truth["0000"] + [0.2, 0.0]
    tree, front = model.pose_tree(), scene.cameras["front"]
    values = tree.values_from_positions(q)
    truth = JointLog(NAMES, None, np.array([tiny_scene.truth["0000"]]), ("0",))
    inputs = plain_inputs(scene, model, truth=truth, search=MultiStartSearch(tree))
    mask, outlines = scene.read("front", "0000"), TreeSurfaces(tree).at(values)
    X_WN = tree.node_poses(values)
    parts = draw_parts(outlines, X_WN, [front])
    whole = draw_parts(outlines, X_WN, [front], by_part=False)
    body = LabelRenderer(model, front).mask(q)
    assert (parts["front"] >= 0).mean() == pytest.approx(body.mean(), rel=0.01)
    np.testing.assert_array_equal(whole["front"] == 0, parts["front"] >= 0)
    assert set(np.unique(whole["front"])) == {-1, 0}
    assert set(np.unique(parts["front"])) == {-1, 0, 1, 2}
    error = np.count_nonzero(mask ^ body) / mask.sum()
    pose = PoseEstimate(True, q, np.eye(4), values, np.nan, 1.0, "end", seconds=3.0)
    record, drawn = inputs.record_frame(
        "0000", pose, {"front": mask}, parts, {"front": mask}, runs=7
    )
    assert record.E_total == pytest.approx(error, abs=0.01)
    assert record.ious["front"] == pytest.approx(
        (mask & body).sum() / (mask | body).sum(), abs=0.01
    )
    assert record.joint_errors == pytest.approx({"lift": np.degrees(0.2), "luff": 0.0})
    assert (record.runs, record.seconds, record.base) == (7, 3.0, None)
    title = f"front  frame 0000  E_total {100.0 * record.E_total:.1f} %"
    expected = draw_overlay(mask, parts["front"] >= 0, parts["front"], title)
    np.testing.assert_array_equal(drawn["overlay/front/0000.png"], expected)
    searched = replace(pose, J=30.0, area=100.0)
    assert inputs.record_frame("0000", searched, {"front": mask}, parts, {})[0].E_total == 0.3
    lost, _ = inputs.record_frame("0000", replace(pose, found=False), {"front": mask}, {}, {})
    assert (lost.E_total, lost.found, lost.joint_errors) == (None, False, {})
    # Without masks there is nothing to compare with.
    assert inputs.record_frame("0000", pose, {}, parts, {})[0].E_total is None


def read(scene, truth=None, cameras=None, **settings):
    return read_inputs(scene.folder, scene.model, EstimateSettings(**settings), truth, cameras)


def test_settings_choose_the_search(own_scene):
    centres = own_scene.folder / "centres.csv"
    centres.write_text("frame,joint,x,y,z\n" + "".join(f"{k},hook,0,{k},1\n" for k in range(3)))
    assert isinstance(read(own_scene).search, MultiStartSearch)
    assert isinstance(read(own_scene, method="paper").search, PaperSearch)
    assert isinstance(read(own_scene, root_position="unknown").search, RootPlacementSearch)
    found = read(own_scene, root="jib", root_position=(centres, "hook"), frames=("1", "2"))
    assert {k: one.tolist() for k, one in found.root_positions.items()} == {
        "0001": [0.0, 1.0, 1.0], "0002": [0.0, 2.0, 1.0],
    }  # fmt: skip
    found = read(own_scene, root="jib", root_position=(0.0, 0.1, 0.9))
    tree = found.search.tree
    assert found.root_positions is None
    np.testing.assert_allclose(tree.node_poses(tree.default_values())[0][:3, 3], [0.0, 0.1, 0.9])
    assert found.frames == tuple(own_scene.truth)
    assert read(own_scene, every=2).frames == ("0000", "0002")
    # Frames are tracked if they are a sequence.
    assert not found.tracked
    (own_scene.folder / "scene.yaml").write_text("sequence: true\n")
    assert read(own_scene).tracked
    assert not read(own_scene, track=False).tracked
    moved = own_scene.folder / "moved.yaml"
    save_cameras(moved, [camera("front", 10.0)])
    (front,) = read(own_scene, cameras=moved).scene.cameras.values()
    np.testing.assert_allclose(front.X_WC, camera("front", 10.0).X_WC, atol=1e-9)


def test_measured_positions_are_those_of_the_scene_or_given(own_scene, tmp_path):
    assert read(own_scene).truth is None
    write_truth(own_scene)
    assert read(own_scene).truth.names == NAMES
    table = own_scene.folder / "joint_angles.csv"
    table.write_text("frame,lift\n1,0.5\n")
    (text,) = read(own_scene, frames=("0",)).warnings
    assert "has no row of an estimated frame" in text
    assert read(own_scene, frames=("0", "1")).warnings == ()
    # One of another model is ignored, unless it is given.
    table.write_text("frame,A1\n0,0.5\n")
    assert (read(own_scene).truth, read(own_scene).warnings) == (None, ())
    with pytest.raises(UnknownNameError, match="'A1'"):
        read(own_scene, truth=table)
    table.unlink()
    table.symlink_to("gone")
    with pytest.raises(SceneError, match=r"joint_angles\.csv"):
        read(own_scene)


@pytest.fixture
def film(own_scene):
    """A sequence with pictures of all frames, a mask of the first one, and a start."""
    for mask in sorted(own_scene.folder.glob("masks/front/*.png")):
        picture = np.full((160, 200, 3), 90, np.uint8)
        path = own_scene.folder / "images" / "front" / mask.name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), picture)
        if mask.stem != "0000":
            mask.unlink()
    (own_scene.folder / "scene.yaml").write_text("sequence: true\nframe_rate_hz: 10\n")
    write_truth(own_scene, own_scene.folder / "start.csv")
    return own_scene


def test_a_track_starts_at_known_positions(film):
    start = film.folder / "start.csv"
    found = read(film, start=start)
    for frame, q in film.truth.items():
        np.testing.assert_allclose(found.starts[frame], q)
    assert {*read(film, start=start, frames=("1", "2")).starts} == {"0001", "0002"}
    assert read(film).starts == {}
    assert found.pictures("0001")["front"].mean() == 90.0
    # Columns that are missing get the default; rows by time belong to the frames' times.
    start.write_text("frame,lift\n0,0.5\n")
    lower = load_model(film.model).default_positions
    np.testing.assert_allclose(read(film, start=start).starts["0000"], [0.5, lower[1]])
    start.write_text("time,lift,luff\n0,0.1,-0.2\n0.2,0.3,-0.2\n")
    found = read(film, start=start)
    np.testing.assert_allclose(found.starts["0001"], [0.2, -0.2], atol=1e-9)
    assert {*read(film, start=start, frames=("0", "1")).starts} == {"0000", "0001"}
    # The camera must show the body where the track starts.
    hidden = film.folder / "hidden.csv"
    hidden.write_text("frame,lift,luff\n0,0.5,0\n")
    edit_camera(film.folder / "cameras.yaml", "front", focal_x=1e5, focal_y=1e5)
    with pytest.raises(DrakePoseError, match="larger than the"):
        read(film, start=hidden)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"frames": ("1:2",)}, r"first frame, '0001'.*masks/front/0001\.png"),
        ({"start": "late.csv"}, r"late\.csv.*'0000'"),
        ({"start": "start.csv", "track": False}, "frames are not tracked"),
        ({"track": False}, "'0001' has pictures but no mask"),
        ({"start": "stills.csv"}, "frames are not tracked"),
    ],
)
def test_a_track_without_a_start_is_refused(film, more, words):
    (film.folder / "late.csv").write_text("frame,lift\n1,0.5\n")
    if more.get("start") == "stills.csv":
        shutil.copy(film.folder / "start.csv", film.folder / "stills.csv")
        shutil.rmtree(film.folder / "images")
        (film.folder / "scene.yaml").write_text("sequence: false\n")
    if "start" in more:
        more = more | {"start": film.folder / more["start"]}
    with pytest.raises((SceneError, SettingsError), match=words):
        read(film, **more)


@pytest.fixture(scope="module")
def studio(tmp_path_factory, person):
    """A scene of a person before four cameras."""
    folder = tmp_path_factory.mktemp("studio")
    cameras = circle_of_cameras(4, size=(160, 120), face_camera=False)
    save_cameras(folder / "cameras.yaml", cameras)
    write_masks(folder, person, cameras.values(), [posed(person)] * 3)
    return folder


def test_persons_before_several_cameras_are_captured(studio, person, model):
    """By name, or if no option of the search is given; a sequence if asked for by name."""
    scene, alone = load_scene(studio), load_scene(studio).of_cameras(["camera_0"])
    by_name = EstimateSettings(method="person")
    for given, body, settings, expected in (
        (scene, person, EstimateSettings(), True),
        (scene, person, by_name, True),
        (alone, person, EstimateSettings(), False),
        (replace(scene, scale_unknown=True), person, EstimateSettings(), False),
        (scene, model, EstimateSettings(), False),
        (scene, person, EstimateSettings(method="beam"), False),
        (scene, person, EstimateSettings(hold={"left_forearm_x": -20.0}), False),
        (replace(alone, unknown_folders=("b",)), person, by_name, "camera_0; cameras.yaml lacks b"),
        (replace(scene, scale_unknown=True), person, by_name, "two or more calibrated"),
        (scene, model, by_name, "left_ankle"),
    ):
        if isinstance(expected, str):
            with pytest.raises(DrakePoseError, match=expected):
                follows_person(given, body, settings)
        else:
            assert follows_person(given, body, settings) == expected
    read_of = {k: read_inputs(studio, person.path, EstimateSettings(method=k), None)
               for k in ("auto", "person")}  # fmt: skip
    assert {k: (one.search, one.tracked) for k, one in read_of.items()} == {
        "auto": (None, False), "person": (None, True),
    }  # fmt: skip
    with pytest.raises(SettingsError, match="leave start out"):
        EstimateSettings(method="person", start=studio / "start.csv")


def test_models_of_persons_have_landmarks_and_a_root_that_moves(person, model, tmp_path):
    assert missing_for_person(person) == ""
    assert "left_ankle" in missing_for_person(model)
    (tmp_path / "crane.urdf").write_text(URDF)
    shutil.copy(person.path.with_name("landmarks.yaml"), tmp_path)
    assert missing_for_person(load_model(tmp_path / "crane.urdf")).startswith("one root")


def test_a_person_is_captured_from_masks_not_pictures(studio, person, tmp_path):
    scene = shutil.copytree(studio, tmp_path / "scene")
    for mask in sorted(scene.glob("masks/*/*.png")):
        picture = scene / "images" / mask.parent.name / mask.name
        picture.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(mask, picture)
        if mask.stem != "0000" and mask.parent.name != "camera_0":
            mask.unlink()
    (scene / "scene.yaml").write_text("sequence: true\n")
    for start in (None, scene / "start.csv"):
        with pytest.raises(SceneError, match=r"frame 0001-0002 has pictures, but masks of fewer"):
            read_inputs(scene, person.path, EstimateSettings(start=start), None)
