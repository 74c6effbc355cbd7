import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from drake_pose.body.formats.packages import bundled_model
from drake_pose.body.model import ArticulatedModel, load_model
from drake_pose.files.records import FrameRecord, JointRecord, PoseRow, SceneEstimate
from drake_pose.files.report_page import (
    BOX,
    HEIGHT,
    WIDTH,
    draw_grid,
    make_report,
    plot_curves,
)
from drake_pose.files.settings import EstimateSettings
from drake_pose.files.summary import summarize
from drake_pose.jobs.estimate.scene import estimate_scene
from drake_pose.silhouette.pictures.scenes import Scene
from tests.jobs.scenes import NAMES, TinyScene, camera, read_rows

VOID = {"meta", "img", "br", "link", "hr"}


class Page(HTMLParser):
    """Reads a page back: its tables by id or order, texts by id, links, and what it draws."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tables: list[list[list[str]]] = []
        self.by_id: dict[str, str] = {}
        self.links: list[str] = []
        self.sources: list[str] = []
        self.joints: dict[str, str] = {}
        self.classes: list[str] = []
        self.tags: list[str] = []
        self.labels: list[str] = []
        self._open: list[tuple[str, str | None]] = []
        self._joint: str | None = None
        self.feed(text)
        assert not self._open, "a tag is not closed"

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        values = dict(attributes)
        self.tags.append(tag)
        if tag not in VOID:
            self._open.append((tag, values.get("id")))
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")
        elif tag == "a":
            self.links.append(str(values["href"]))
        elif tag == "img":
            self.sources.append(str(values["src"]))
            assert values["alt"]
        elif tag == "svg":
            assert values.get("aria-hidden") or values.get("aria-label")
        if values.get("data-joint"):
            self._joint = values["data-joint"]
        if values.get("aria-label"):
            self.labels.append(str(values["aria-label"]))
        self.classes += (values.get("class") or "").split()

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attributes)
        self.handle_endtag(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self._open.pop()[0] == tag

    def handle_data(self, data: str) -> None:
        for _, name in self._open:
            if name:
                self.by_id[name] = self.by_id.get(name, "") + data
        tags = [tag for tag, _ in self._open]
        if {"td", "th"} & set(tags):
            self.tables[-1][-1][-1] += data
        if "figcaption" in tags and self._joint:
            self.joints[self._joint] = data.strip()
            self._joint = None


@pytest.fixture(scope="module")
def result(tiny_scene: TinyScene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("report") / "out"
    settings = EstimateSettings(interval=20.0)
    estimate_scene(tiny_scene.folder, tiny_scene.model, out, settings, replay=False)
    return out


def test_page_says_what_the_tables_say(result: Path) -> None:
    page = Page((result / "report.html").read_text())
    poses = read_rows(result / "poses.csv")
    frames = next(table for table in page.tables if table[0][:2] == ["frame", "pose"])
    assert [row[0] for row in frames[1:]] == [row["frame"] for row in poses]
    for row, pose in zip(frames[1:], poses, strict=True):
        assert row[1] == "found"
        assert float(row[2].rstrip(" %")) == pytest.approx(100.0 * float(pose["error"]), abs=0.051)
    assert set(page.joints) == set(NAMES)
    for name, text in page.joints.items():
        values = np.degrees([float(pose[name]) for pose in poses])
        numbers = [float(number) for number in re.findall(r"-?\d+\.?\d*(?:e-?\d+)?", text)]
        np.testing.assert_allclose(numbers[:2], [values.min(), values.max()], rtol=1e-3)
    assert page.by_id["found"] == "3 of 3"
    cameras = next(table for table in page.tables if table[0][0] == "camera")
    assert cameras[1][:3] == ["front", "3", "3"]
    assert "None." in page.by_id["warnings"]


def test_page_needs_nothing_but_itself_and_its_links_lead_somewhere(result: Path) -> None:
    text = (result / "report.html").read_text()
    page = Page(text)
    assert "http" not in re.sub(r"data:image/jpeg;base64,[\w+/=]*", "", text)
    assert not {"script", "link", "iframe"} & set(page.tags)
    assert page.sources
    assert all(source.startswith("data:image/jpeg;base64,") for source in page.sources)
    for link in page.links:
        assert link.removeprefix("#") in page.by_id or (result / link).is_file(), link


def long_report(frames: int) -> tuple[ArticulatedModel, Scene, SceneEstimate]:
    """A person in many frames: two cameras, gaps, frames not found, names that are no HTML."""
    model = load_model(bundled_model("person").with_name("person_shape.urdf"), check=False)
    rng = np.random.default_rng(2)
    rows, records, masks = [], {}, {}
    walk = np.cumsum(rng.normal(0.0, 0.02, (frames, len(model.position_names))), axis=0)
    unit = np.where(np.array(model.position_kinds) == "angle", np.degrees(1.0), 1.0)
    for k in range(frames):
        frame = f"{k:04d}"
        found = not 100 <= k < 120
        q = np.clip(walk[k], model.lower, model.upper)
        q[model.position_index("left_thigh_stretch")] = 0.02
        rows.append(PoseRow(frame, q if found else q * np.nan, None, 0.1 if found else np.nan, 0.1))
        low, high = unit * (q - 0.02), unit * (q + 0.02)
        joints = {
            name: JointRecord(k % 70 > 5, float(low[n]), float(high[n]))
            for n, name in enumerate(model.position_names)
        }
        ious = {"<b>left</b>": 0.8 + 0.001 * (k % 50)} | ({"right & low": 0.6} if k % 40 else {})
        records[frame] = FrameRecord(
            found, 0.1 if found else None, 0.1, joints=joints if found else {},
            ious=ious if found else {},
        )  # fmt: skip
        masks["<b>left</b>", frame] = Path()
        if k % 80:
            masks["right & low", frame] = Path()
    more = {"method": "person", "warnings": ["camera '<b>left</b>' agrees badly"]}
    job = {"scene": "/data/<script>", "model": "person.urdf"}
    cameras = {name: camera(name) for name in ("<b>left</b>", "right & low")}
    scene = Scene(Path("nowhere"), cameras, tuple(records), masks, True)
    estimate = SceneEstimate(
        model.position_names, model.position_kinds, tuple(rows), records,
        summarize(job, records, True, more), None,
    )  # fmt: skip
    return model, scene, estimate


@pytest.fixture(scope="module")
def report() -> tuple[ArticulatedModel, Scene, SceneEstimate]:
    return long_report(1000)


def test_a_thousand_frames_stay_small_and_names_are_shown_as_they_are(report) -> None:
    text = make_report(Path("nowhere"), *report)
    assert len(text) < 2_500_000
    page = Page(text)
    assert page.by_id["found"] == "980 of 1000"
    still = next(table for table in page.tables if table[0][0] == "joint")
    assert still[1][:2] == ["left_thigh_stretch", "0.0200"]
    assert not {"b", "script"} & set(page.tags)
    cameras = next(table for table in page.tables if table[0][0] == "camera")
    assert [row[0] for row in cameras[1:]] == ["<b>left</b>", "right & low"]
    assert cameras[1][6] == "see the warnings"
    assert cameras[2][1:3] == ["987", "955"]
    assert "camera '<b>left</b>' agrees badly" in page.by_id["warnings"]


@pytest.mark.parametrize("k", [0, 100])
def test_a_frame_or_none_is_enough(report, k: int) -> None:
    model, scene, whole = report
    records = {f"{k:04d}": whole.records[f"{k:04d}"]}
    one = replace(whole, rows=whole.rows[k : k + 1], records=records)
    assert bool(Page(make_report(Path("nowhere"), model, scene, one)).joints) is (k == 0)


def coordinates(path: str) -> np.ndarray:
    return np.array(
        [[float(n) for n in pair] for pair in re.findall(r"[ML]([\d.-]+) ([\d.-]+)", path)]
    )


def test_curves_break_at_gaps_and_keep_their_peaks() -> None:
    values = np.sin(np.linspace(0.0, 20.0, 5000))
    values[2500], values[1000:1100] = 3.0, np.nan
    plot = plot_curves(
        [str(k) for k in range(5000)], [("one", values)], joined=True, limits=(-1, 4)
    )
    path = plot.curves[0][1]
    assert path.count("M") == 2
    assert path.count("L") < 1500
    points = coordinates(path)
    assert ((points >= 0.0) & (points <= [WIDTH, HEIGHT])).all()
    peak = points[np.argmin(points[:, 1])]
    left, _, width, _ = BOX
    assert peak[0] == pytest.approx(left + width * 2500 / 4999, abs=0.2)
    # Both limits are shown, and no point lies outside them but as the picture's scale says.
    assert len(plot.limits) == 2
    assert plot.limits[1] < peak[1] < plot.limits[0]


def test_limits_that_are_far_do_not_flatten_the_curve() -> None:
    values = np.linspace(0.0, 1.0, 50)
    plot = plot_curves(
        [str(k) for k in range(50)], [("one", values)], joined=True, limits=(-90, 90)
    )
    points = coordinates(plot.curves[0][1])
    assert np.ptp(points[:, 1]) > 0.7 * BOX[3]
    assert plot.limits == ()


def test_stills_are_dots() -> None:
    plot = plot_curves(["a", "b"], [("one", np.array([1.0, np.nan]))], joined=False)
    assert plot.curves[0][1].count("h0") == 1
    assert plot.dots


def test_grid_joins_neighbours_of_one_state() -> None:
    states = ["used", "used", "no-picture", "used"]
    grid = draw_grid(["0", "1", "2", "3"], [("left", states)])
    runs = grid.rows[0][2]
    assert [run[2] for run in runs] == ["used", "no-picture", "used"]
    assert runs[0][1] == pytest.approx(2 * runs[1][1], abs=0.02)
