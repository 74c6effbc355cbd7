"""Pages of results against the files and numbers that they show."""

import base64
import re
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from drake_pose.camera.models import circle_of_cameras
from drake_pose.errors import weight_of, weighted
from drake_pose.files.page import (
    Page,
    bar,
    estimate_answer,
    estimate_page,
    next_steps,
    p_value,
    picture,
    picture_files,
    plot,
    without_folders,
)
from drake_pose.files.records import SceneEstimate, describe_warnings, summarize
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.estimate.scene import estimate_scene
from drake_pose.silhouette.pictures.scenes import Scene
from tests.files.bodies import interval, record, three_joints
from tests.jobs.scenes import read_rows


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

    def table(self, head):
        """Return the table whose first column has this head."""
        return next(table for table in self.tables if table[0][0] == head)


def require_plain_page(text, warnings=()):
    """Check what holds for all pages.

    The answer is the first text; each warning stands once; numbers have few decimals and are known;
    no cell is a dash; no path of the machine is shown.
    """
    page = ParsedPage(text)
    plain = ParsedPage(re.sub("<text.*?</text>", "", text))  # Without labels of axes.
    body = [part.strip() for part in plain.root.find("body").itertext() if part.strip()]
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
    files = "cameras.yaml arm_calibrated.urdf lerobot/ ros/ mujoco.xml cameras_2.yaml"
    for name in (*files.split(), "x.png"):
        (tmp_path / name).mkdir() if name[-1] == "/" else (tmp_path / name).write_text("")
    world = dict(next_steps(tmp_path, {"cameras": {"front": {}}}))
    assert " ".join(world) == files
    masks = {"mask_count": 2, "cameras": {"front": {}}}
    assert dict(next_steps(tmp_path, masks))["cameras.yaml"] == "the cameras as they were given"
    wrist = dict(next_steps(tmp_path, {"cameras": {"wrist": {"link": "hand"}}}))
    frames = {"cameras.yaml": ("the robot's world", "frame of link hand")}
    frames |= {"mujoco.xml": ("worldbody", "body hand"), "ros/": ("the robot's world", "link hand")}
    for name, (of_world, of_link) in frames.items():
        assert (of_world in world[name], of_link in wrist[name]) == (True, True)
        assert of_world not in wrist[name]


def test_plots_are_drawn_to_scale():
    """Values of 6 % beyond the ends fill the height from 8 to 108, the steps 60 to 632."""
    nan, labels = np.nan, ["a", "b", "c", "d<"]
    curves = [("estimate", np.array([0.0, 1.0, nan, 3.0])), ("0", np.array([nan, 2.0, 2.0, nan]))]
    bands = [("known", np.array([0.0, nan, 1.0, 2.0]), np.array([1.0, nan, 2.0, 3.0]))]
    drawn = plot(curves, labels, "x", bands=bands, limits=(-3.0, 6.1, -2.9, np.inf))
    assert str(drawn) == (
        '<svg class="plot" viewBox="0 0 640 130" role="img" aria-label="x">'
        '<path class="axis" d="M60 102.6H632"/><text x="55" y="106.6" text-anchor="end">-3</text>'
        '<path class="axis" d="M60 58.0H632"/><text x="55" y="62.0" text-anchor="end">0</text>'
        '<path class="axis" d="M60 13.4H632"/><text x="55" y="17.4" text-anchor="end">3</text>'
        '<path class="known" stroke-width="10.0" '
        'd="M131.5 58.0V43.1M417.5 43.1V28.2M560.5 28.2V13.4"/>'
        '<path class="limit" d="M60 102.6H632"/><path class="limit" d="M60 101.2H632"/>'
        '<path class="curve cestimate" d="M131.5 58.0h0L274.5 43.1M560.5 13.4h0"/>'
        '<path class="curve c0" d="M274.5 28.2h0L417.5 28.2"/>'
        '<text x="131.5" y="124" text-anchor="middle">a</text>'
        '<text x="417.5" y="124" text-anchor="middle">c</text>'
        '<text x="560.5" y="124" text-anchor="middle">d&lt;</text></svg>'
    )
    dots = str(plot([("0", np.array([5.0, 7.0]))], [*"ab"], "x", joined=False, least=0.0))
    assert '<path class="curve c0 dots" d="M203.0 40.6h0M489.0 13.7h0"/>' in dots
    # The lowest value is 0, without a margin.
    assert re.findall(r'y="([\d.]+)" text-anchor="end">([\d.]+)<', dots) == [
        ("112.0", "0"), ("64.8", "3.5"), ("17.7", "7"),
    ]  # fmt: skip
    many = np.full(900, 5.0)
    bands = [("known", many, many + 0.1)]
    assert 'stroke-width="1.0"' in plot([("0", many)], 900 * ["a"], "x", bands=bands)
    flat = str(plot([("0", np.zeros(2))], [*"ab"], "x"))
    assert re.findall(r'y="([\d.]+)" text-anchor="end">(\d)<', flat) == [("62.0", "0")]


def test_bars_have_their_parts_between_the_limits():
    parts = [("known", -5.0, 15.0), ("estimate", 29.9, 30.0), ("open", -20.0, 50.0)]
    drawn = bar(np.array([-10.0, 30.0]), [*parts, ("open", np.nan, 2.0)], " deg")
    assert re.sub("<svg.*?>", "<svg>", drawn) == (
        '-10<svg><rect class="known" x="12.5" width="50.0" height="8"/>'
        '<rect class="estimate" x="99.0" width="1.0" height="8"/>'
        '<rect class="open" x="0.0" width="100.0" height="8"/></svg>30 deg'
    )
    infinite = {(2, 2): "2 mm", (-np.inf, np.inf): "none mm", (2, np.inf): "2 to none mm"}
    for limits, shown in infinite.items():
        assert bar(np.array(limits, float), parts, " mm") == shown
    assert [p_value(p) for p in (0.0009, 0.001, 0.25)] == ["< 0.001", "0.001", "0.250"]


def test_pictures_are_shrunk_to_a_side(tmp_path):
    for name, size in (("wide.png", (300, 1000)), ("b.png", (40, 30)), ("c.png", (40, 30))):
        cv2.imwrite(str(tmp_path / name), np.full((*size, 3), 90, np.uint8))
    (tmp_path / "bad.png").write_bytes(b"none")
    for name, size in (("wide.png", (270, 900)), ("b.png", (40, 30))):
        shown = str(picture((tmp_path / name).read_bytes(), "a <b>"))
        assert 'alt="a &lt;b&gt;"' in shown
        data = base64.b64decode(re.search('base64,(.*?)"', shown)[1])
        assert cv2.imdecode(np.frombuffer(data, np.uint8), 1).shape[:2] == size
    places = {name: name.upper() for name in ("lost.png", "bad.png", "b.png", "wide.png", "c.png")}
    found = picture_files(tmp_path, places, most=3)
    assert [caption for _, caption, _ in found] == ["B.PNG", "WIDE.PNG"]
    assert found[0][0].startswith('<a href="b.png"><img')


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return three_joints(tmp_path_factory.mktemp("model"))


def estimate_of(model, *records, **more):
    """Return the estimate of some records."""
    job = {"scene": "/data/<script>", "method": "beam", **more}
    told = summarize(job, {one.frame: one for one in records}, True)
    names, kinds = model.position_names, model.position_kinds
    return SceneEstimate(names, kinds, {one.frame: one for one in records}, told, None)


KNOWN = {"bend": interval(True, 60.0, 80.0), "reach": interval(True, 3.1, 3.2)}


def test_answers_name_joints_that_are_not_determined(model):
    unsure = KNOWN | {"reach": interval(False, 3.0, 3.4)}
    lost, found, open_one = (
        record(None, "0"), record(0.1, "1", joints=KNOWN), record(0.3, "2", joints=unsure)
    )  # fmt: skip
    fits = "body and silhouettes differ by {} % of their area."
    for records, answer, left in (
        ((lost,), "No pose was found.", []),
        ((lost, record(None, "b")), "No pose was found in 2 frames.", []),
        ((found,), f"Pose found; {fits.format('10.0')} All 2 joints are determined.", []),
        ((lost, found), f"Pose found in 1 of 2 frames; {fits.format('10.0')} All 2 joints are "
         "determined in all frames.", []),
        ((found, open_one), f"Pose found in 2 of 2 frames; {fits.format('20.0')} 1 of 2 joints are "
         "determined in all frames; do not rely on the others: reach.", ["reach"]),
        ((record(0.1, "3"),), f"Pose found; {fits.format('10.0')} Which joints are determined was "
         "not computed.", []),
        # A joint without an estimate in one frame is not determined.
        ((found, record(0.1, "4", joints={"bend": KNOWN["bend"]})), f"Pose found in 2 of 2 frames; "
         f"{fits.format('10.0')} 1 of 2 joints are determined in all frames; do not rely on the "
         "others: reach.", ["reach"]),
    ):  # fmt: skip
        assert estimate_answer(estimate_of(model, *records)) == (answer, left)


def page_of(folder, model, scene, *records, **more):
    """Return the parsed page of an estimate."""
    estimate_page(folder, model, scene, estimate_of(model, *records, **more)).write(folder)
    return require_plain_page((folder / "report.html").read_text())


def test_tables_and_plots_of_an_estimate(model, tmp_path):
    """Angles are in degrees, lengths in millimetres; frames without a pose have no numbers."""
    frames, left, right = [*"0123"], "<b>left</b>", "right & low"
    cameras = dict(zip((left, right), circle_of_cameras(2).values(), strict=False))
    masks = {(left, k): Path() for k in frames} | {(right, "0"): Path()}
    images = {(right, k): Path() for k in "012"}
    scene = Scene(Path("s"), cameras, tuple(frames), masks, True, images=images)
    q = [[np.radians(bend), 3.1, np.radians(turn)] for bend, turn in ((60, 0), (90, 20), (80, 0))]
    unsure = KNOWN | {"bend": interval(False, 57.0, 90.0)}
    more = (
        {"ious": {left: 0.9, right: 0.7}, "joint_errors": {"bend": 2.0}, "joints": KNOWN},
        {"ious": {left: 0.8}, "joint_errors": {"bend": -4.0}, "joints": unsure},
        {"joints": KNOWN, "stopped_by": "tracked"},
    )
    records = [
        record(0.1 * (k + 1), "013"[k], q=np.array(q[k]), **own) for k, own in enumerate(more)
    ]
    records.insert(2, record(None, "2", q=np.full(3, np.nan)))
    page = page_of(tmp_path, model, scene, *records)
    for head, rows in {
        "frame": ["0 found 10.0 % <b>left</b>, right & low", "1 found 20.0 % <b>left</b>",
                  "2 none no pose none", "3 found 30.0 % none"],
        "camera": ["<b>left</b> 4 2 85.0 % 80.0 % in frame 1",
                   "right & low 3 2 70.0 % 70.0 % in frame 0"],
        "joint": ["bend 60.0 to 90.0 deg ± 10.0 deg 2 of 3 frames 57.3114.6 deg "
                  "58.0 to 94.0 deg 3.0, max. 4.0 deg",
                  "reach 3100.0 mm ± 50.0 mm 3 of 3 frames 30003400 mm not known not measured",
                  "turn 0.0 to 20.0 deg not computed not computed -180180 deg not known "
                  "not measured"],
    }.items():  # fmt: skip
        assert [" ".join(row) for row in page.table(head)[1:]] == rows
    assert [*page.plots] == ["bend", "turn", "E_total [%]", "IoU [%]"]
    text = (tmp_path / "report.html").read_text()
    for words in ("2 cameras, tracked by colour in 1 frames, 2 searched by beam", "Mean 20.0 %"):
        assert words in text
    assert not {"b", "script"} & {*page.tags}
    # One frame has intervals instead of numbers of frames, and no plots.
    plain = Scene(Path("s"), {left: cameras[left]}, ("1",), {}, True)
    alone = page_of(tmp_path, model, plain, records[1])
    assert not alone.plots
    assert alone.table("joint")[1][1:4] == ["90.0 deg", "57.0 to 90.0 deg", "no"]
    assert alone.table("joint")[2][1:4] == ["3100.0 mm", "3100.0 to 3200.0 mm", "yes"]
    assert "1 camera, searched by beam" in (tmp_path / "report.html").read_text()
    assert len(page_of(tmp_path, model, plain, records[2]).table("joint")) == 1


def test_a_written_page_agrees_with_the_other_files_and_is_self_contained(tiny_scene, tmp_path):
    out = tmp_path / "out"
    estimate_scene(tiny_scene.folder, tiny_scene.model, out, EstimateSettings(), replay=False)
    text, poses = (out / "report.html").read_text(), read_rows(out / "poses.csv")
    page, errors = require_plain_page(text), [100.0 * float(one["error"]) for one in poses]
    found = [float(row[2].rstrip(" %")) for row in page.table("frame")[1:]]
    np.testing.assert_allclose(found, errors, atol=0.051)
    # Pictures are of the middle frame, with its modes, then of the worst and the best.
    in_order = [pose["frame"] for pose in sorted(poses, key=lambda pose: -float(pose["error"]))]
    names = [f"overlay/front/{in_order[1]}", f"overlay_modes/{in_order[1]}"]
    names += [f"overlay/front/{in_order[k]}" for k in (0, 2)]
    assert [one for one in page.links if one.endswith(".png")] == [f"{one}.png" for one in names]
    assert all((out / link).exists() for link in page.links)
    assert "http" not in re.sub(r"base64,[\w+/=]*", "", text)
    assert not {"script", "link", "iframe"} & {*page.tags}
    assert "No warnings." in page.by_id["warnings"]
