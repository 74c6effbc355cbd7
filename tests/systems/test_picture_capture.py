"""Groups of pictures by time stamps, recorded and live captures, and regions in pictures."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator, SimulatorStatus
from pydrake.systems.sensors import ImageLabel16I, ImageRgba8U

from drake_pose.camera.models import circle_of_cameras
from drake_pose.camera.sources import FrameSource, SourceSpecification, TimedPicture
from drake_pose.errors import CameraError, SettingsError, UnknownNameError
from drake_pose.person.views import edge_spacing, see_silhouette
from drake_pose.silhouette.pictures.label_renderer import label_image_to_mask, mask_to_label_image
from drake_pose.silhouette.segmentation import learn_background, person_region
from drake_pose.systems.cameras import build_camera_rig
from drake_pose.systems.person import SilhouetteSensor
from drake_pose.systems.picture_capture import PictureCapture, Synchroniser
from tests.person.persons_in_view import posed
from tests.systems.bench import Bench

SIZE = (40, 30)
PERIOD = 0.1
CAMERAS = circle_of_cameras(3, size=SIZE, face_camera=False)


def group_all(synchroniser, recorded, delays):
    """Add pictures in the order of arrival, and return the groups."""
    arrivals = sorted(
        (time + delay, camera, time, k)
        for camera, stream in recorded.items()
        for (time, k), delay in zip(stream, delays[camera], strict=True)
    )
    found = []
    for _, camera, time, k in [*arrivals, (0.0, None, 0.0, 0)]:
        if camera is None:
            for name in recorded:
                synchroniser.finish(name)
        else:
            synchroniser.add(camera, time, k)
        while (group := synchroniser.take()) is not None:
            found.append(group)
    return found


def brute_force(recorded, tolerance):
    """Group the pictures by scanning all of them for each group."""
    rest = {name: list(stream) for name, stream in recorded.items()}
    found = []
    while any(rest.values()):
        begin = min(time for stream in rest.values() for time, _ in stream)
        group = {}
        for name, stream in rest.items():
            near = [one for one in stream if one[0] - begin <= tolerance]
            if near:
                group[name] = near[0][1]
                stream.remove(near[0])
        found.append((begin, group))
    return found


@pytest.mark.parametrize("seed", range(4))
def test_groups_match_brute_force(seed):
    generator = np.random.default_rng(seed)
    recorded = {
        f"c{k}": [(float(t), i) for i, t in enumerate(np.cumsum(generator.exponential(0.1, 80)))]
        for k in range(generator.integers(2, 5))
    }
    # Pictures arrive late and interleaved, but in order for each camera.
    delays = {name: np.sort(generator.random(80)) for name in recorded}
    synchroniser = Synchroniser(recorded, 0.04, 1e9)
    assert group_all(synchroniser, recorded, delays) == brute_force(recorded, 0.04)
    assert not synchroniser.changes


def test_a_camera_that_stops_is_awaited_then_ignored_until_it_returns():
    synchroniser = Synchroniser(["a", "b"], 0.05, 0.25)
    synchroniser.add("a", 0.0, "a0")
    synchroniser.add("b", 0.01, "b0")
    assert synchroniser.take()[1] == {"a": "a0", "b": "b0"}
    for k in (1, 2, 3):
        synchroniser.add("a", 0.1 * k, f"a{k}")
        assert synchroniser.take() is None
    assert synchroniser.waiting("a") == 3
    assert synchroniser.take(now=0.349) is None
    assert synchroniser.take(now=0.35)[0] == pytest.approx(0.1)
    assert synchroniser.changes == [("b", 0.01, True)]
    # It is not awaited again, and not reported twice.
    assert synchroniser.take()[1] == {"a": "a2"}
    assert synchroniser.take()[1] == {"a": "a3"}
    assert synchroniser.take() is None
    assert len(synchroniser.changes) == 1
    # A picture of a finished group, or one that is not later than the last, is dropped.
    assert not synchroniser.add("b", 0.31, "b3")
    assert synchroniser.add("b", 0.41, "b4")
    assert not synchroniser.add("b", 0.41, "b4")
    assert synchroniser.late == {"a": 0, "b": 2}
    assert synchroniser.changes[1:] == [("b", 0.41, False)]
    assert synchroniser.take() is None, "a is waited for"
    synchroniser.add("a", 0.4, "a4")
    assert synchroniser.take()[1] == {"a": "a4", "b": "b4"}


class Recording(FrameSource):
    """A source of recorded pictures, whose values are their indices."""

    def __init__(self, camera, times, masks=False, kind="video"):
        background = None if masks else "empty"
        super().__init__(
            SourceSpecification(camera, kind, "-", *SIZE, 1 / PERIOD, background=background)
        )
        self._rest, self.closed = list(enumerate(times)), False

    @property
    def ended(self):
        return not self._rest

    def close(self):
        self.closed = True

    def _read(self):
        if not self._rest:
            return None
        k, time = self._rest.pop(0)
        picture = np.full((*SIZE[::-1], 3), (k, 100, 200), dtype=np.uint8)
        if self.specification.gives_masks:
            picture = np.indices(SIZE[::-1])[0] <= k
        return TimedPicture(time, f"{k}", picture)


def recordings(*times):
    """Return a recording for each of the first cameras."""
    return {name: Recording(name, own) for name, own in zip(CAMERAS, times, strict=False)}


def play(capture, end=10.0):
    """Return the simulation's status; time and each camera's picture of updates with new frames."""
    simulator, found = Simulator(capture), []
    names = [name for name in CAMERAS if capture.HasOutputPort(f"color_image_{name}")]

    def look(context):
        run = Bench(capture, context)
        if run["fresh"][0]:
            images = [run[f"color_image_{name}"] for name in names]
            shown = [int(image.data[0, 0, 0]) if image.size() else None for image in images]
            found.append((float(run["time"][0]), *shown))

    simulator.set_monitor(look)
    return simulator.AdvanceTo(end), found


def test_all_recorded_frames_are_shown_and_the_end_terminates():
    times = [7.0 + PERIOD * k for k in range(5)]
    sources = recordings(times, [time + 0.02 for time in times])
    capture = PictureCapture(sources, CAMERAS)
    assert capture.period == pytest.approx(PERIOD)
    assert not capture.live
    status, found = play(capture)
    assert status.reason() == SimulatorStatus.ReturnReason.kReachedTerminationCondition
    assert [row[1:] for row in found] == [(k, k) for k in range(5)]
    assert [row[0] for row in found] == pytest.approx([PERIOD * k for k in range(5)])
    assert not capture.take_reports()
    counts = {"used": 5, "dropped": 0, "late": 0, "changes": []}
    assert capture.counts() == {"camera_0": counts, "camera_1": counts}
    capture.close()
    assert sources["camera_0"].closed


def test_images_equal_the_sources():
    sources = recordings([0.0]) | {"camera_1": Recording("camera_1", [0.0], masks=True)}
    run = Bench(PictureCapture(sources, CAMERAS))
    assert np.isnan(run["time"][0])
    run.advance(0.5 * PERIOD)
    assert (run["color_image_camera_0"].data == (0, 100, 200, 255)).all()
    rows = label_image_to_mask(run["label_image_camera_1"]).sum(axis=1)
    assert rows.tolist() == [SIZE[0]] + 29 * [0]
    # A picture is shown in the update at which it is due, in spite of rounding.
    times = [7.0 + PERIOD * k for k in (0, 1, 2, 3, 4, 5.4)]
    run = Bench(PictureCapture(recordings(times), CAMERAS))
    for k, shown in enumerate((0, 1, 2, 3, 4, 4, 5)):
        run.advance((k + 0.01) * PERIOD)
        assert run["color_image_camera_0"].data[0, 0, 0] == shown


def test_a_camera_that_stops_and_returns_loses_only_its_own_pictures():
    times = [PERIOD * k for k in range(20)]
    rest = [time for time in times if not 0.45 < time < 1.45]
    capture = PictureCapture(recordings(times, rest), CAMERAS)
    _, found = play(capture)
    assert [row[1] for row in found] == list(range(20))
    assert [row[0] for row in found if row[2] is not None] == pytest.approx(rest)
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
    _, found = play(capture, 0.45)
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
    assert capture.live
    simulator, times = Simulator(capture), []
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
        assert np.isnan(capture.counts()["camera_1"]["changes"][0]["time"])
        assert set(capture.frames[1]) == {"camera_0"}
        assert 100 < len(times) < 130, "it was waited for, but not for ever"


def test_sources_of_no_camera_and_no_sources_are_refused():
    with pytest.raises(UnknownNameError, match="stranger"):
        PictureCapture({"stranger": Recording("stranger", [0.0])}, CAMERAS)
    with pytest.raises(SettingsError, match="at least one camera"):
        PictureCapture({}, CAMERAS)


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
    assert sensor.system.wanted == (f"{kind}_image",)
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
    # A label image is preferred.
    empty = mask_to_label_image(np.zeros((120, 160), dtype=bool))
    assert not sensor.give(label_image=empty)["silhouette"].region.any()


def test_pictures_of_another_size_or_without_background_are_refused(rig):
    camera, background = rig[2:]
    other = learn_background([np.zeros((4, 5, 3), np.uint8)])
    with pytest.raises(SettingsError, match=r"'camera_0'.*background 5 x 4"):
        SilhouetteSensor(camera, other)
    for known, image, error, word in (
        (None, {"color_image": ImageRgba8U(160, 120)}, SettingsError, "give a background model"),
        (background, {"color_image": ImageRgba8U(80, 60)}, CameraError, r"80 x 60.*160 x 120"),
        (None, {"label_image": ImageLabel16I(80, 60)}, CameraError, "'camera_0': its label image"),
    ):
        with pytest.raises(error, match=word):
            Bench(SilhouetteSensor(camera, known)).give(**image)["silhouette"]
