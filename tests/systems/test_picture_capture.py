import numpy as np
import pytest
from pydrake.systems.analysis import Simulator, SimulatorStatus
from pydrake.systems.sensors import ImageLabel16I, ImageRgba8U

from drake_pose.camera.models import circle_of_cameras
from drake_pose.camera.sources import FrameSource, SourceSpecification, TimedPicture
from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.person.views import edge_spacing, see_silhouette
from drake_pose.silhouette.pictures.label_renderer import label_image_to_mask, mask_to_label_image
from drake_pose.silhouette.segmentation import learn_background, person_region
from drake_pose.systems.cameras import build_camera_rig
from drake_pose.systems.person import SilhouetteSensor
from drake_pose.systems.picture_capture import PictureCapture
from tests.person.persons_in_view import posed
from tests.systems.bench import Bench

SIZE = (40, 30)
PERIOD = 0.1
CAMERAS = circle_of_cameras(3, size=SIZE, face_camera=False)


class Recording(FrameSource):
    """A source of recorded pictures, whose values are their indices."""

    def __init__(self, camera, times, masks=False, kind="video"):
        background = None if masks else "empty"
        super().__init__(
            SourceSpecification(camera, kind, "-", *SIZE, 1 / PERIOD, background=background)
        )
        self._rest = [(k, time) for k, time in enumerate(times)]
        self.closed = False

    @property
    def ended(self):
        return not self._rest

    def close(self):
        self.closed = True

    def _read(self):
        if not self._rest:
            return None
        k, time = self._rest.pop(0)
        if self.specification.gives_masks:
            picture = np.zeros(SIZE[::-1], dtype=bool)
            picture[: k + 1] = True
        else:
            picture = np.full((*SIZE[::-1], 3), (k, 100, 200), dtype=np.uint8)
        return TimedPicture(time, f"{k}", picture)


def recordings(*times):
    """Return a recording for each of the first cameras."""
    return {name: Recording(name, own) for name, own in zip(CAMERAS, times, strict=False)}


def play(capture, names, end=10.0):
    """Return the time and each camera's picture for each update with new frames."""
    simulator = Simulator(capture)
    found = []

    def look(context):
        if capture.GetOutputPort("fresh").Eval(context)[0]:
            images = [capture.GetOutputPort(name).Eval(context) for name in names]
            shown = [int(image.data[0, 0, 0]) if image.size() else None for image in images]
            found.append((float(capture.GetOutputPort("time").Eval(context)[0]), *shown))

    simulator.set_monitor(look)
    return simulator.AdvanceTo(end), found


def test_all_recorded_frames_are_shown_and_the_end_terminates():
    times = [7.0 + PERIOD * k for k in range(5)]
    sources = recordings(times, [time + 0.02 for time in times])
    capture = PictureCapture(sources, CAMERAS)
    assert capture.period == pytest.approx(PERIOD)
    assert not capture.live
    status, found = play(capture, ["color_image_camera_0", "color_image_camera_1"])
    assert status.reason() == SimulatorStatus.ReturnReason.kReachedTerminationCondition
    assert [row[1:] for row in found] == [(k, k) for k in range(5)]
    assert [row[0] for row in found] == pytest.approx([PERIOD * k for k in range(5)])
    assert not capture.take_reports()
    assert capture.counts()["camera_1"]["used"] == 5
    capture.close()
    assert sources["camera_0"].closed


def test_images_equal_the_sources():
    sources = recordings([0.0]) | {"camera_1": Recording("camera_1", [0.0], masks=True)}
    run = Bench(PictureCapture(sources, CAMERAS)).advance(0.5 * PERIOD)
    assert (run["color_image_camera_0"].data == (0, 100, 200, 255)).all()
    mask = label_image_to_mask(run["label_image_camera_1"])
    assert mask.sum() == SIZE[0]
    assert mask[0].all()


def test_a_camera_that_stops_and_returns_loses_only_its_own_pictures():
    times = [PERIOD * k for k in range(20)]
    rest = [time for time in times if not 0.45 < time < 1.45]
    capture = PictureCapture(recordings(times, rest), CAMERAS)
    _, found = play(capture, ["color_image_camera_0", "color_image_camera_1"])
    assert [row[1] for row in found] == list(range(20))
    there = [row[0] for row in found if row[2] is not None]
    assert there == pytest.approx(rest)
    stopped, returned = capture.take_reports()
    assert "'camera_1' stopped at 0.40 s" in stopped
    assert "'camera_1' returned at 1.50 s" in returned
    changes = capture.counts()["camera_1"]["changes"]
    assert [change["what"] for change in changes] == ["stopped", "returned"]


def test_live_capture_shows_only_the_newest_frames():
    sources = recordings(*[[PERIOD * k for k in range(9)]] * 3)
    # Read twice before time 0, then at each update.
    clock = iter([100.0, 100.0, 100.0, 100.0, 100.35, 100.36, 101.0, 101.1]).__next__
    capture = PictureCapture(sources, CAMERAS, clock=clock)
    # Recordings that are played by the clock, as beside a live camera.
    capture.live = True
    _, found = play(capture, [f"color_image_{name}" for name in CAMERAS], 0.45)
    assert [row[1:] for row in found] == [(0, 0, 0), (3, 3, 3), (8, 8, 8)]
    assert capture.skipped == 2 + 4


class Device(Recording):
    """A live camera without pictures in its first reads."""

    def __init__(self, camera, clock, silent):
        super().__init__(camera, [], kind="device")
        self._clock, self._silent, self._count, self._shown = clock, silent, 0, None

    @property
    def ended(self):
        return False

    def _read(self):
        self._count += 1
        if self._count <= self._silent or self._shown == self._clock["now"]:
            return None
        self._shown = self._clock["now"]
        picture = np.full((*SIZE[::-1], 3), self._count % 200, dtype=np.uint8)
        return TimedPicture(self._clock["now"] - 0.01, "x", picture)


@pytest.mark.parametrize("silent", [3, 1000])
def test_live_cameras_may_open_slowly_or_never(silent):
    clock = {"now": 50.0}
    sources = {f"camera_{k}": Device(f"camera_{k}", clock, n) for k, n in enumerate((0, silent))}
    capture = PictureCapture(sources, CAMERAS, clock=lambda: clock["now"])
    simulator = Simulator(capture)
    times = []
    for k in range(200):
        clock["now"] += PERIOD
        simulator.AdvanceTo((k + 0.5) * PERIOD)
        if capture.frames is not None:
            times.append(capture.frames[0])
    reports = "\n".join(capture.take_reports())
    # The first frames wait once for the second camera.
    assert times[0] < (2 if silent == 3 else 6) * PERIOD
    if silent == 3:
        assert not reports
        assert set(capture.frames[1]) == {"camera_0", "camera_1"}
        assert len(times) > 190
    else:
        assert "'camera_1' gives no picture" in reports
        assert set(capture.frames[1]) == {"camera_0"}
        assert 100 < len(times) < 130, "it was waited for, but not for ever"


def test_invalid_arguments_are_refused():
    with pytest.raises(UnknownNameError, match="stranger"):
        PictureCapture({"stranger": Recording("stranger", [0.0])}, CAMERAS)
    device = {"camera_0": Recording("camera_0", [0.0], kind="device")}
    assert PictureCapture(device, CAMERAS).live


@pytest.fixture(scope="module")
def rig(person):
    cameras = circle_of_cameras(1, size=(160, 120), face_camera=False)
    rig = build_camera_rig(person, cameras)
    context = rig.diagram.CreateDefaultContext()
    rig.set_positions(context, posed(person, z=-9.0))
    empty = rig.picture(context, "camera_0")
    rig.set_positions(context, posed(person))
    return rig, context, cameras["camera_0"], learn_background([empty])


@pytest.mark.parametrize("kind", ["label", "color"])
def test_a_silhouette_sensor_sees_what_drakes_sensors_show(rig, kind):
    rig, context, camera, background = rig
    sensor = Bench(SilhouetteSensor(camera, background if kind == "color" else None))
    assert sensor["silhouette"] is None
    nothing = ImageLabel16I() if kind == "label" else ImageRgba8U()
    assert sensor.give(**{f"{kind}_image": nothing})["silhouette"] is None
    image = rig.diagram.GetOutputPort(f"{kind}_image_camera_0").Eval(context)
    found = sensor.give(**{f"{kind}_image": image})["silhouette"]
    region = rig.mask(context, "camera_0")
    if kind == "color":
        region = person_region(rig.picture(context, "camera_0"), background)
    expected = see_silhouette(region, edge_spacing(camera))
    np.testing.assert_array_equal(found.region, region)
    np.testing.assert_array_equal(found.edge.uv, expected.edge.uv)
    assert len(found.edge.uv) > 20


def test_an_empty_mask_and_a_missing_background(rig):
    mask = np.zeros((120, 160), dtype=bool)
    sensor = Bench(SilhouetteSensor(rig[2])).give(label_image=mask_to_label_image(mask))
    assert not sensor["silhouette"].region.any()
    unknown = Bench(SilhouetteSensor(rig[2])).give(color_image=ImageRgba8U(160, 120))
    with pytest.raises(SettingsError, match="give a background model or connect label_image"):
        unknown["silhouette"]
