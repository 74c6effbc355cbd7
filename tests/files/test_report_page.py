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
from drake_pose.files.records import FrameRecord, SceneEstimate, summarize
from drake_pose.files.replay import make_replay
from drake_pose.files.report_page import draw_grid, make_report, plot_curves, plot_uri
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.estimate.scene import estimate_scene
from drake_pose.silhouette.pictures.scenes import Scene
from tests.body.models import link_poses
from tests.jobs.scenes import NAMES, camera, read_rows


class Page:
    """A parsed page: tables, texts by id, and figures; every tag must be closed."""

    def __init__(self, text):
        text = re.sub(r"<!doctype[^>]*>", "", text, flags=re.IGNORECASE)
        text = re.sub(r"<(meta|img|br|link|hr)\b([^>]*?)/?>", r"<\1\2/>", text)
        self.root = ElementTree.fromstring(text.replace("&middot;", "."))
        every = [*self.root.iter()]
        self.tags = [one.tag for one in every]
        self.classes = [name for one in every for name in one.get("class", "").split()]
        self.by_id = {one.get("id"): "".join(one.itertext()) for one in every if one.get("id")}
        self.tables = [
            [["".join(cell.itertext()) for cell in row] for row in table.iter("tr")]
            for table in self.root.iter("table")
        ]
        self.plots = {}
        for figure in self.root.iter("figure"):
            if (drawn := figure.find("img[@class='plot']")) is not None:
                label = drawn.get("alt").split(" by frame")[0]
                self.plots[figure.get("data-joint") or label] = figure
        assert all(one.get("alt") for one in self.root.iter("img"))

    def table(self, *head):
        """Return the table whose header starts with these cells."""
        return next(table for table in self.tables if table[0][: len(head)] == [*head])


def require_plain_page(text, warnings=()):
    """Check that the answer is the first text, each warning stands once, and decimals are few."""
    page = Page(text)
    body = [part.strip() for part in page.root.find("body").itertext() if part.strip()]
    assert body[0] == page.by_id["answer"]
    shown = " ".join(body)
    for number, warning in enumerate(dict.fromkeys(warnings), 1):
        assert page.by_id[f"warning-{number}"] == warning
        assert shown.count(warning) == 1
    assert f"warning-{len({*warnings}) + 1}" not in page.by_id
    assert not re.search(r"\d\.\d{4}|\de-\d", shown)
    return page


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
        text = "".join(page.plots[name].find("figcaption").itertext())
        values = np.degrees([float(pose[name]) for pose in poses])
        numbers = [float(number) for number in re.findall(r"-?\d+\.?\d*(?:e-?\d+)?", text)]
        np.testing.assert_allclose(numbers[:2], [values.min(), values.max()], atol=0.051)
    assert {"E_total", "Intersection over union of each camera", *NAMES} <= {*page.plots}
    ious = [f"{100.0 * np.mean([one['ious']['front'] for one in records]):.1f} %"]
    assert page.table("camera")[1][3:4] == ious
    mean = np.mean(errors)
    assert page.by_id["answer"] == (
        f"2 of 2 joints determined in 3 of 3 frames; mean error {mean:.1f} % of the silhouette."
    )
    assert page.table("camera")[1][:3] == ["front", "3", "3"]
    # Pictures are of the worst, the middle and the best frame.
    links = [one.get("href") for one in page.root.iter("a")]
    in_order = sorted(poses, key=lambda pose: -float(pose["error"]))
    names = [f"overlay/front/{pose['frame']}.png" for pose in in_order]
    assert [one for one in links if one.startswith("overlay/")] == names
    for bar in (one for one in page.root.iter("rect") if one.get("class") != "limits"):
        assert 0.0 <= float(bar.get("x")) <= 100.0 - float(bar.get("width"))
    assert "No warnings." in page.by_id["warnings"]


def test_page_is_self_contained_and_its_links_exist(result):
    text = (result / "report.html").read_text()
    page = Page(text)
    assert "http" not in re.sub(r"data:image/\w+;base64,[\w+/=]*", "", text)
    assert not {"script", "link", "iframe"} & {*page.tags}
    drawn = cv2.imread(str(next(result.glob("overlay/front/*.png"))))
    assert "img" in page.tags
    for image in page.root.iter("img"):
        data = base64.b64decode(image.get("src").partition("base64,")[2])
        small = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert small.shape[0] <= min(drawn.shape[0], 400)
    for link in (one.get("href") for one in page.root.iter("a")):
        assert link.removeprefix("#") in page.by_id or (result / link).is_file(), link


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
    more = {"method": "person", "warnings": ["camera '<b>left</b>' agrees badly"]}
    job = {"scene": "/data/<script>", "model": "person.urdf"}
    cameras = {name: camera(name) for name in ("<b>left</b>", "right & low")}
    scene = Scene(Path("nowhere"), cameras, tuple(records), masks, True)
    estimate = SceneEstimate(
        model.position_names, model.position_kinds, records,
        summarize(job, records, True, more), None,
    )  # fmt: skip
    return model, scene, estimate


def test_page_of_a_thousand_frames_is_small_and_escapes_names(report):
    text = make_report(Path("nowhere"), *report)
    assert len(text) < 2_500_000
    page = require_plain_page(text, report[2].summary["warnings"])
    assert page.by_id["answer"].startswith("Pose found in 980 of 1000 frames; mean error 10.0 %")
    (row,) = (row for row in page.table("joint") if row[0] == "left_thigh_stretch")
    assert row[1:4] == ["20.0", "± 20.0", "mm"]
    assert not {"b", "script"} & {*page.tags}
    _, left, right = page.table("camera")
    assert [left[0], right[0]] == ["<b>left</b>", "right & low"]
    assert left[6] == "warning 1"
    assert right[1:3] == ["987", "955"]
    assert "camera '<b>left</b>' agrees badly" in page.by_id["warnings"]


def part(whole, frames, errors=None, **changes):
    """Return the estimate of some frames, with joint errors by frame."""
    records = {frame: whole.records[frame] for frame in frames}
    for frame, off in (errors or {}).items():
        records[frame] = replace(records[frame], joint_errors=off)
    names = {name: {"mean": 3.0, "largest": 3.0} for off in (errors or {}).values() for name in off}
    return replace(whole, records=records, summary=whole.summary | {"joint_errors": names})


def test_page_of_one_frame_has_a_table_and_no_plots(report):
    """The table has estimate, interval and measured position; a frame without a pose has no row."""
    model, scene, whole = report
    name = "left_forearm_x"
    for frame, off in (("0000", {name: -4.0}), ("0100", {})):
        page = Page(make_report(Path("nowhere"), model, scene, part(whole, [frame], {frame: off})))
        assert not {*page.plots} & {name, "E_total"}
        rows = [row for table in page.tables for row in table if row[0] == name]
        assert len(rows) == len(off)
        for row in rows:
            value = np.degrees(whole.records[frame].q[model.position_index(name)])
            numbers = [
                float(number) for number in re.findall(r"-?\d+\.\d+", " ".join([*row[1:3], row[7]]))
            ]
            unit = np.degrees(0.02)
            expected = [value, value - unit, value + unit, value + 4.0]
            np.testing.assert_allclose(numbers, expected, atol=0.051)
            assert row[3:5] == ["deg", "no"]


def plotted(values, **more):
    """Return the axes of a plot with one curve, and the curve."""
    names = [str(k) for k in range(len(values))]
    (axes,) = plot_curves(names, [("one", values)], **{"joined": True, **more}).axes
    return axes, axes.get_lines()[0]


def test_a_plot_drawn_onto_another_is_the_same_as_a_new_one():
    frames, rng = [f"{k:03d}" for k in range(40)], np.random.default_rng(0)
    for values, limits in ((rng.normal(size=(4, 40)), (-3.0, 90.0)), (rng.random((4, 40)), None)):
        given = {
            "values": [("measured", values[0]), ("one", values[1])],
            "joined": True,
            "limits": limits,
            "intervals": (values[2], values[3], rng.random(40) < 0.5),
        }
        first = plot_curves(frames, [("one", 1e3 * values[1])], joined=True, limits=(0.0, 1.0))
        again = plot_curves(frames, **given, onto=first)
        assert plot_uri(again) == plot_uri(plot_curves(frames, **given))


def test_plots_show_only_limits_that_are_near():
    values = np.sin(np.linspace(0.0, 20.0, 5000))
    values[2500], values[1000:1100] = 3.0, np.nan
    axes, curve = plotted(values, limits=(-1, 4))
    np.testing.assert_array_equal(curve.get_ydata(), values)
    np.testing.assert_array_equal(curve.get_xdata(), np.arange(5000))
    assert [line.get_ydata()[0] for line in axes.get_lines()[1:]] == [-1, 4]
    low, high = axes.get_ylim()
    assert low < -1 < 4 < high
    # Distant limits do not change the scale.
    axes, _ = plotted(np.linspace(0.0, 1.0, 50), limits=(-90, 90))
    assert np.ptp(axes.get_ylim()) < 1.3
    assert len(axes.get_lines()) == 1
    axes, _ = plotted(np.array([0.3, 0.4]), least=0.0)
    assert axes.get_ylim()[0] == 0.0


def test_stills_are_dots_and_intervals_are_at_their_frames():
    _, curve = plotted(np.array([1.0, np.nan]), joined=False)
    assert curve.get_linestyle() == "None"
    known = np.array([True, False, True])
    low, high = np.array([0.0, 1.0, 2.0]), np.array([1.0, 3.0, 5.0])
    axes, _ = plotted(np.ones(3), intervals=(low, high, known))
    of_known, of_open = ([s.tolist() for s in one.get_segments()] for one in axes.collections)
    assert of_known == [[[0, 0], [0, 1]], [[2, 2], [2, 5]]]
    assert of_open == [[[1, 1], [1, 3]]]


def test_grid_joins_equal_neighbours():
    states = ["used", "used", "no-picture", "used"]
    (axes,) = draw_grid(["0", "1", "2", "3"], [("left", states), ("right", states)]).axes
    rows = [[path.get_extents() for path in one.get_paths()] for one in axes.collections]
    # The bars of a row are at its name, and rows do not overlap.
    assert [one.y0 + one.y1 for row in rows for one in row] == pytest.approx([0.0] * 3 + [2.0] * 3)
    assert rows[0][0].y1 < rows[1][0].y0
    spans = rows[0]
    assert [(one.x0, one.x1) for one in spans] == [(-0.5, 1.5), (1.5, 2.5), (2.5, 3.5)]
    first, second, third = axes.collections[0].get_facecolors().tolist()
    assert first == third != second


def played(page):
    """Return the Meshcat commands of a replay by (type, path)."""
    told = {}
    for text in re.findall(r"base64,([\w+/=]+)", page):
        with suppress(ValueError):
            command = msgpack.unpackb(base64.b64decode(text), strict_map_key=False)
            if isinstance(command, dict) and "type" in command:
                told[command["type"], command.get("path")] = command
    return told


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
        geometry = told["set_object", f"/drake/cameras/{one.name}"]["object"]["geometries"][0]
        data = geometry["data"]["attributes"]["position"]["array"].data
        p_W = np.frombuffer(data, np.float32).reshape(-1, 3).astype(float)
        pixels, depth = one.project(p_W[np.linalg.norm(p_W - one.X_WC[:3, 3], axis=1) > 1e-6])
        assert {tuple(row) for row in np.round(pixels, 2).tolist()} == corners
        assert 0.0 < depth.max() < 2.5
    # Meshcat's y is up; the body fills a good part of its field of view of 75 degrees.
    view = told["set_property", "/Cameras/default/rotated/<object>"]["value"]
    eye, target = (np.array([x, -z, y]) for x, y, z in (view, told["set_target", None]["value"]))
    pinhole = PinholeCamera(
        "view", 1000, 1000, *[500.0 / np.tan(np.radians(37.5))] * 2, 499.5, 499.5,
        look_at(eye, target),
    )  # fmt: skip
    seen = []
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
    assert (pixels >= -0.5).all()
    assert (pixels <= 999.5).all()
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
    (ghost,) = (
        one["object"]["geometries"][0]["data"]["attributes"]["position"]["array"].data
        for (kind, path), one in told.items()
        if kind == "set_object" and "measured" in path
    )
    points = np.frombuffer(ghost, np.float32).reshape(-1, 3) - [0.3, 0.0, 0.0]
    np.testing.assert_allclose(np.linalg.norm(points / [1, 2, 1], axis=1), 0.1, atol=0.003)
