import base64
import json
import re
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import cv2
import msgpack
import numpy as np
import pytest
import trimesh
from pydrake.geometry import Meshcat, MeshcatParams

from drake_pose.body import bundled_model, load_model
from drake_pose.camera.models import ParallelCamera, PinholeCamera, look_at
from drake_pose.errors import weight_of, weighted
from drake_pose.files.page import Page, estimate_page, next_steps, plot, without_folders
from drake_pose.files.records import FrameRecord, SceneEstimate, describe_warnings, summarize
from drake_pose.files.replay import make_replay
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.estimate.scene import estimate_scene
from drake_pose.silhouette.pictures.scenes import Scene
from tests.body.models import link_poses
from tests.jobs.scenes import NAMES, camera, read_rows


class ParsedPage:
    """A parsed page: tables, texts by id, and figures by title; every tag must be closed."""

    def __init__(self, text):
        text = re.sub(r"<!doctype[^>]*>", "", text, flags=re.IGNORECASE)
        self.root = ElementTree.fromstring(re.sub(r"<img\b([^>]*)>", r"<img\1/>", text))
        every = [*self.root.iter()]
        self.tags = [one.tag for one in every]
        self.by_id = {one.get("id"): "".join(one.itertext()) for one in every if one.get("id")}
        self.tables = [
            [["".join(cell.itertext()) for cell in row] for row in table.iter("tr")]
            for table in self.root.iter("table")
        ]
        titled = [one for one in self.root.iter("figure") if one.find("h3") is not None]
        self.plots = {one.find("h3").text: one for one in titled}
        self.links = [one.get("href") for one in self.root.iter("a")]
        assert all(one.get("alt") for one in self.root.iter("img"))

    def table(self, *head):
        """Return the table whose header starts with these cells."""
        return next(table for table in self.tables if table[0][: len(head)] == [*head])


def require_plain_page(text, warnings=()):
    """Check what holds for all pages.

    The answer is the first text; each warning stands once; numbers have few decimals and are known;
    no cell is a dash; no path of the machine is shown.
    """
    page, again = ParsedPage(text), ParsedPage(text)
    for drawn in again.root.iter("svg"):
        drawn[:] = []  # Labels of axes.
    body = [part.strip() for part in again.root.find("body").itertext() if part.strip()]
    assert body[0] == page.by_id["answer"]
    shown = " ".join(body)
    for warning in dict.fromkeys(map(without_folders, warnings)):
        assert shown.count(warning) == 1
    assert not re.search(r"\d\.\d{4}|\de-\d|\bnan\b|(?<![\w.<])/(tmp|work|home|root)/", shown)
    assert not {"-", "–", ""} & {cell for table in page.tables for row in table for cell in row}
    return page


def test_paths_of_the_machine_are_not_shown():
    for text, shown in (
        ("/data/a b/masks/0.png: is black", "a b/masks/0.png: is black"),
        ("in '/data/set/cameras.yaml' (line 3)", "in 'cameras.yaml' (line 3)"),
        ("12 mm/s and 3/4, see ros/front.yaml", "12 mm/s and 3/4, see ros/front.yaml"),
    ):
        assert without_folders(text) == shown


def test_weights_of_warnings_order_them_and_only_one_changes_the_headline(tmp_path):
    notes = [weighted(text, "note") for text in ("mesh is not watertight", "the model is large")]
    texts = [notes[0], "a camera moved", weighted("exchanged", "wrong"), notes[1]]
    for kept in (texts, texts[:2], texts[:1]):
        told = describe_warnings([*kept, *kept])
        assert told["warnings"] == kept
        Page("t", "", "All right.", told, {}).write(tmp_path)
        page = require_plain_page((tmp_path / "report.html").read_text(), kept)
        assert page.by_id["answer"].startswith("Wrong answer likely") == (kept is texts)
        heads, count = [one.text for one in page.root.iter("h2")], len({*map(weight_of, kept)})
        assert ("What to do next" in heads) == (kept is texts)
        assert heads[-count:] == ["Wrong answer likely", "To check", "Notes"][-count:]


def test_files_are_named_with_their_use_and_frame(tmp_path):
    for name in ("cameras.yaml", "mujoco.xml", "arm_calibrated.urdf", "cameras_2.yaml", "x.png"):
        (tmp_path / name).write_text("")
    for name in ("lerobot", "ros"):
        (tmp_path / name).mkdir()
    world = dict(next_steps(tmp_path, {"cameras": {"front": {}}}))
    files = "cameras.yaml arm_calibrated.urdf lerobot/ ros/ mujoco.xml cameras_2.yaml"
    assert " ".join(world) == files
    masks = {"mask_count": 2, "cameras": {"front": {}}}
    assert dict(next_steps(tmp_path, masks))["cameras.yaml"] == "the cameras as they were given"
    wrist = dict(next_steps(tmp_path, {"cameras": {"wrist": {"link": "hand"}}}))
    for name, of_world, of_link in (
        ("cameras.yaml", "the robot's world", "frame of link hand"),
        ("mujoco.xml", "worldbody", "body hand"), ("ros/", "the robot's world", "link hand"),
    ):  # fmt: skip
        assert of_world in world[name]
        assert of_link in wrist[name]
        assert of_world not in wrist[name]


@pytest.fixture(scope="module")
def result(tiny_scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("report") / "out"
    settings = EstimateSettings()
    estimate_scene(tiny_scene.folder, tiny_scene.model, out, settings, replay=False)
    return out


def test_page_agrees_with_poses_and_summary(result):
    page = require_plain_page((result / "report.html").read_text())
    poses = read_rows(result / "poses.csv")
    records = json.loads((result / "summary.json").read_text())["frames"].values()
    errors = [100.0 * float(pose["error"]) for pose in poses]
    for row, pose, error in zip(page.table("frame", "pose")[1:], poses, errors, strict=True):
        assert row[:2] == [pose["frame"], "found"]
        assert float(row[2].rstrip(" %")) == pytest.approx(error, abs=0.051)
    for name in NAMES:
        values = np.degrees([float(pose[name]) for pose in poses])
        (row,) = (row for row in page.table("joint") if row[0] == name)
        numbers = [float(number) for number in re.findall(r"-?\d+\.\d+", row[1])]
        np.testing.assert_allclose(numbers, [values.min(), values.max()], atol=0.051)
        (path,) = (one for one in page.plots[name].iter("path") if "cestimate" in one.get("class"))
        drawn = np.array([float(y) for y in re.findall(r"[ML][\d.]+ ([\d.]+)", path.get("d"))])
        slope, offset = np.polyfit(values, drawn, 1)
        assert slope < 0.0
        np.testing.assert_allclose(slope * values + offset, drawn, atol=0.1)
    assert {"E_total [%]", "IoU [%]", *NAMES} == {*page.plots}
    ious = f"{100.0 * np.mean([one['ious']['front'] for one in records]):.1f} %"
    assert page.table("camera")[1][:4] == ["front", "3", "3", ious]
    assert page.by_id["answer"] == (
        f"Pose found in 3 of 3 frames; body and silhouettes differ by {np.mean(errors):.1f} % of "
        "their area. All 2 joints are determined in all frames."
    )
    # Pictures are of the middle frame, with its modes, then of the worst and the best.
    in_order = [pose["frame"] for pose in sorted(poses, key=lambda pose: -float(pose["error"]))]
    shown = [one for one in page.links if one.endswith(".png")]
    assert shown[:2] == [f"overlay/front/{in_order[1]}.png", f"overlay_modes/{in_order[1]}.png"]
    assert shown[2:] == [f"overlay/front/{in_order[k]}.png" for k in (0, 2)]
    for part in page.root.iter("rect"):
        assert 0.0 <= float(part.get("x")) <= 100.0 - float(part.get("width"))
    assert "No warnings." in page.by_id["warnings"]


def test_page_is_self_contained_and_its_links_exist(result):
    text = (result / "report.html").read_text()
    page = ParsedPage(text)
    assert "http" not in re.sub(r"data:image/\w+;base64,[\w+/=]*", "", text)
    assert not {"script", "link", "iframe"} & {*page.tags}
    for image in page.root.iter("img"):
        data = base64.b64decode(image.get("src").partition("base64,")[2])
        small = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert max(small.shape) <= 900
    assert page.links
    for link in page.links:
        assert (result / link).exists(), link


@pytest.fixture(scope="module")
def report():
    """A person's estimate with gaps, frames without a pose, and names to be escaped."""
    model = load_model(bundled_model("person").with_name("person_shape.urdf"), check=False)
    rng = np.random.default_rng(2)
    records, masks = {}, {}
    walk = np.cumsum(rng.normal(0.0, 0.02, (1000, len(model.position_names))), axis=0)
    unit = np.where(np.array(model.position_kinds) == "angle", np.degrees(1.0), 1.0)
    for k in range(1000):
        frame = f"{k:04d}"
        found = not 100 <= k < 120
        q = np.clip(walk[k], model.lower, model.upper)
        q[model.position_index("left_thigh_stretch")] = 0.02
        low, high = unit * (q - 0.02), unit * (q + 0.02)
        joints = {
            name: {"determined": k % 70 > 5, "low": float(low[n]), "high": float(high[n])}
            for n, name in enumerate(model.position_names)
        }
        ious = {"<b>left</b>": 0.8 + 0.001 * (k % 50)} | ({"right & low": 0.6} if k % 40 else {})
        told = {"joints": joints, "ious": ious} if found else {}
        E_total = 0.1 if found else None
        records[frame] = FrameRecord(frame, q if found else q * np.nan, None, E_total, 0.1, **told)
        masks["<b>left</b>", frame] = Path()
        if k % 80:
            masks["right & low", frame] = Path()
    more, warnings = {"method": "person"}, ["camera '<b>left</b>' agrees badly"]
    job = {"scene": "/data/<script>", "model": "person.urdf"}
    cameras = {name: camera(name) for name in ("<b>left</b>", "right & low")}
    scene = Scene(Path("nowhere"), cameras, tuple(records), masks, True)
    summary = summarize(job, records, True, more, warnings)
    names = model.position_names, model.position_kinds
    return model, scene, SceneEstimate(*names, records, summary, None)


def page_text(folder, *estimate):
    """Return the text of an estimate's page."""
    estimate_page(folder, *estimate).write(folder)
    return (folder / "report.html").read_text()


def test_page_of_a_thousand_frames_is_small_and_escapes_names(report, tmp_path):
    text = page_text(tmp_path, *report)
    assert len(text) < 2_500_000
    page = require_plain_page(text, report[2].summary["warnings"])
    answer = page.by_id["answer"]
    assert answer.startswith("Pose found in 980 of 1000 frames; body and silhouettes differ by 10.")
    (row,) = (row for row in page.table("joint") if row[0] == "left_thigh_stretch")
    assert row[1:3] == ["20.0 mm", "± 20.0 mm"]
    assert not {"b", "script"} & {*page.tags}
    _, left, right = page.table("camera")
    assert [left[0], right[0]] == ["<b>left</b>", "right & low"]
    assert right[1:3] == ["987", "955"]
    assert "camera '<b>left</b>' agrees badly" in page.by_id["warnings"]


def part(whole, frames, errors=None, **changes):
    """Return the estimate of some frames, with joint errors by frame."""
    records = {frame: whole.records[frame] for frame in frames}
    for frame, off in (errors or {}).items():
        records[frame] = replace(records[frame], joint_errors=off)
    names = {name: {"mean": 3.0, "largest": 3.0} for off in (errors or {}).values() for name in off}
    told = {"joint_errors": names, **describe_warnings(())}
    return replace(whole, records=records, summary=whole.summary | told)


def test_page_of_one_frame_has_a_table_and_no_plots(report, tmp_path):
    """The table has estimate, interval and measured position; a frame without a pose has no row."""
    model, scene, whole = report
    name = "left_forearm_x"
    for frame, off in (("0000", {name: -4.0}), ("0100", {})):
        told = part(whole, [frame], {frame: off})
        page = require_plain_page(page_text(tmp_path, model, scene, told), [])
        assert not page.plots
        rows = [row for table in page.tables for row in table if row[0] == name]
        assert len(rows) == len(off)
        for row in rows:
            value, half = np.degrees([whole.records[frame].q[model.position_index(name)], 0.02])
            assert row[1] == f"{value:.1f} deg"
            assert row[2] == f"{value - half:.1f} to {value + half:.1f} deg"
            assert row[3] == "no"
            assert row[5:] == [f"{value + 4.0:.1f} deg", "3.0, max. 3.0 deg"]


def drawn_paths(**given):
    """Return (class, points) of each path of a plot of four values; V gives the second y."""
    known = {"curves": [("estimate", np.array([0.0, 1.0, np.nan, 3.0]))], "labels": [*"abcd"]}
    root = ElementTree.fromstring(plot(**(known | {"about": "x"} | given)))
    return {
        one.get("class"): [float(x) for x in re.findall(r"-?\d+\.?\d*", one.get("d"))]
        for one in root.iter("path")
        if one.get("class") != "axis"
    }


def test_plots_have_gaps_dots_bands_and_limits_that_are_near():
    joined = drawn_paths()["curve cestimate"]
    # M x y h0 L x y, and after the gap M x y h0.
    assert len(joined) == 8
    assert len(drawn_paths(joined=False)["curve cestimate dots"]) == 9
    low, high = np.array([0.0, np.nan, 1.0, 2.0]), np.array([1.0, np.nan, 2.0, 3.0])
    band = drawn_paths(bands=[("known", low, high)])["known"]
    assert len(band) == 9
    assert band[1] > band[2]
    assert "limit" in drawn_paths(limits=(-1.0,))
    assert "limit" not in drawn_paths(limits=(-90.0, np.inf))


def played(page):
    """Return the Meshcat commands of a replay by (type, path)."""
    told = {}
    for text in re.findall(r"base64,([\w+/=]+)", page):
        with suppress(ValueError):
            command = msgpack.unpackb(base64.b64decode(text), strict_map_key=False)
            if isinstance(command, dict) and "type" in command:
                told[command["type"], command.get("path")] = command
    return told


def points_of(command):
    """Return the points (n, 3) of a command's object."""
    data = command["object"]["geometries"][0]["data"]["attributes"]["position"]["array"].data
    return np.frombuffer(data, np.float32).reshape(-1, 3).astype(float)


def test_replay_shows_body_cameras_and_measured_ghost(tiny_scene):
    model = load_model(tiny_scene.model, check=False)
    q, off = np.array([*tiny_scene.truth.values()]), np.array([0.3, -0.1])
    X_WB = np.repeat(np.eye(4)[None], len(q), axis=0)
    X_WB[:, :3, 3] = (0.5, -0.2, 0.1)
    left = replace(camera("left"), center_x=60.0)
    flat = ParallelCamera("flat", 200, 160, 100.0, 99.5, 79.5, camera("flat", 60.0).X_WC)
    told = played(make_replay(model, q, X_WB, [left, flat], 2.0, q + off))
    corners = {(u - 0.5, v - 0.5) for u in (0, 200) for v in (0, 160)}
    for one in (left, flat):
        p_W = points_of(told["set_object", f"/drake/cameras/{one.name}"])
        pixels, depth = one.project(p_W[np.linalg.norm(p_W - one.X_WC[:3, 3], axis=1) > 1e-6])
        assert {tuple(row) for row in np.round(pixels, 2).tolist()} == corners
        assert 0.0 < depth.max() < 2.5
    # Meshcat's y is up; the body fills a good part of its field of view of 75 degrees.
    view = told["set_property", "/Cameras/default/rotated/<object>"]["value"]
    eye, target = (np.array([x, -z, y]) for x, y, z in (view, told["set_target", None]["value"]))
    focal, seen = 500.0 / np.tan(np.radians(37.5)), []
    X_WC = look_at(eye, target)
    pinhole = PinholeCamera("view", 1000, 1000, focal, focal, 499.5, 499.5, X_WC)
    tracks = {
        one["path"]: {track["name"]: track["keys"] for track in one["clip"]["tracks"]}
        for one in told["set_animation", None]["animations"]
    }
    for k, row in enumerate(q):
        for positions, measured in ((row, False), (row + off, True)):
            poses = link_poses(model, positions)
            for link, mesh in model.link_meshes.items():
                X_WL = X_WB[k] @ poses[link]
                if not measured:
                    seen += [mesh.vertices @ X_WL[:3, :3].T + X_WL[:3, 3]]
                    continue
                # Ten steps per frame; the body stands still until just before the next frame.
                keys = tracks[f"/drake/measured/{link}"][".position"]
                found = {key["time"]: key["value"] for key in keys}
                for step in (10 * k, 10 * k + 9):
                    np.testing.assert_allclose(found[step], X_WL[:3, 3], atol=1e-9)
    pixels, depth = pinhole.project(np.concatenate(seen))
    assert depth.min() > 0.0
    assert -0.5 <= pixels.min() <= pixels.max() <= 999.5
    assert np.ptp(pixels, axis=0).max() > 300.0
    # The view is from the side of the first camera.
    directions = [place - target for place in (eye, left.X_WC[:3, 3])]
    directions = [one / np.linalg.norm(one) for one in directions]
    assert directions[0] @ directions[1] > np.cos(np.radians(30.0))


def test_replay_of_many_triangles_is_small_and_accurate(tmp_path):
    ball = trimesh.creation.icosphere(6, radius=0.1)
    ball.export(tmp_path / "ball.obj", include_normals=True)
    (tmp_path / "ball.urdf").write_text(
        '<robot name="ball"><link name="base"><visual><origin xyz="0.3 0 0"/><geometry>'
        '<mesh filename="ball.obj" scale="1 2 1"/></geometry></visual></link></robot>'
    )
    model = load_model(tmp_path / "ball.urdf", check=False)
    q = model.default_positions[None]
    page = make_replay(model, q, np.eye(4)[None], [camera("left")], 1.0, q, most_triangles=2000)
    empty = Meshcat(MeshcatParams(host="localhost", port=0)).StaticHtml()
    assert len(page) - len(empty) < 0.4e6
    told = played(page)
    (path,) = (one for one in told if one[0] == "set_object" and "measured" in one[1])
    points = points_of(told[path]) - [0.3, 0.0, 0.0]
    np.testing.assert_allclose(np.linalg.norm(points / [1, 2, 1], axis=1), 0.1, atol=0.003)
