"""Image sources: folders, videos, devices, and their specifications."""

import pickle
import time
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml

from drake_pose.camera.camera_files import save_cameras
from drake_pose.camera.models import circle_of_cameras
from drake_pose.camera.sources import (
    DeviceSource,
    SourceSpecification,
    load_background_pictures,
    load_sources,
    open_source,
)
from drake_pose.errors import SceneError
from tests.camera.recordings import write_film

WIDTH, HEIGHT = 32, 24


def picture(value):
    """Return an image (blue, green, red) with the given red value."""
    seen = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    seen[:, :, 2] = value
    return seen


def write_folder(folder, names, suffix=".png"):
    folder.mkdir(parents=True, exist_ok=True)
    for k, name in enumerate(names):
        cv2.imwrite(str(folder / f"{name}{suffix}"), picture(10 * k))
    return folder


def specify(folder, kind="folder", **more):
    given = {"width": WIDTH, "height": HEIGHT, "rate_hz": 10.0, "background": "empty", **more}
    return SourceSpecification("front", kind, str(folder), **given)


def read_all(source):
    found = []
    while (one := source.read()) is not None:
        found.append(one)
    assert source.ended
    return found


class TestFolder:
    def test_images_come_in_order_at_the_rate(self, tmp_path):
        """Frames of other folders, and no others, tell of missing ones."""
        own, other = ["a9", "a10", "a12"], ["a9", "a10", "a11", "a12"]
        own, other = (
            write_folder(tmp_path / "own", own),
            write_folder(tmp_path / "b", other, ".jpg"),
        )
        for beside, times in (((), [5.0, 5.1, 5.2]), ((str(other),), [5.0, 5.1, 5.3])):
            source = open_source(specify(own, offset=5.0, beside=beside))
            found = read_all(source)
            assert [one.frame for one in found] == ["a9", "a10", "a12"]
            assert [one.time for one in found] == pytest.approx(times)
            assert [one.picture[0, 0].tolist() for one in found] == [
                [10 * k, 0, 0] for k in range(3)
            ]
            assert source.dropped == len(source.problems) == len(beside)
        assert "camera 'front'" in source.problems[0]
        assert "frame a11" in source.problems[0]

    def test_time_stamps_order_the_frames(self, tmp_path):
        folder = write_folder(tmp_path, ["9", "10", "11", "12", "extra"])
        rows = ["009,0.0", "10,0.11", "11,0.11", "12,0.05", "13,0.4"]
        (folder / "timestamps.csv").write_text("\n".join(["frame,time", *rows]) + "\n")
        source = open_source(specify(folder, rate_hz=None))
        assert source.rate_hz == pytest.approx(1 / 0.11)
        assert [(one.frame, one.time) for one in read_all(source)] == [("9", 0.0), ("10", 0.11)]
        assert source.dropped == 4
        text = "\n".join(source.problems)
        assert "frame 11 has the same time stamp as frame 10" in text
        assert "frame 12 has a time stamp before frame 10" in text
        assert "no picture of frame 13" in text
        assert "no time of frame extra" in text

    @pytest.mark.parametrize("suffix", [".png", ".jpg"])
    def test_a_corrupt_image_costs_only_itself(self, tmp_path, suffix):
        folder = write_folder(tmp_path, ["0", "1", "2", "3"], suffix)
        whole = (folder / f"1{suffix}").read_bytes()
        (folder / f"1{suffix}").write_bytes(whole[:-30])
        cv2.imwrite(str(folder / f"2{suffix}"), np.zeros((5, 7, 3), np.uint8))
        source = open_source(specify(folder))
        assert [one.frame for one in read_all(source)] == ["0", "3"]
        assert source.dropped == 2
        what = "the JPEG picture is truncated" if suffix == ".jpg" else "is truncated, damaged"
        assert what in source.problems[0]
        assert "7 x 5" in source.problems[1]

    def test_masks_are_binary(self, tmp_path):
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[4:9, 3:6] = 200
        many = np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH) % 256
        written = {"0.png": mask, "1.jpg": mask, "2.png": 0 * mask, "3.png": many}
        for name, one in (written | {"4.png": np.full_like(mask, 255)}).items():
            cv2.imwrite(str(tmp_path / name), one)
        source = open_source(specify(tmp_path, background=None))
        found = [one.picture for one in read_all(source)]
        assert [one.dtype for one in found] == [bool, bool, bool]
        # An empty mask is valid.
        for one, expected in zip(found, (mask > 0, mask > 0, np.zeros_like(mask)), strict=True):
            np.testing.assert_array_equal(one, expected)
        assert "must have two" in source.problems[0]
        assert "full" in source.problems[1]

    @pytest.mark.parametrize(
        ("names", "more", "stamps", "reason"),
        [
            ([], {}, None, "no picture"),
            (["0"], {"rate_hz": None}, None, "rate_hz"),
            (["0"], {"width": 7, "height": 5}, None, r"32 x 24.*calibrated for 7 x 5"),
            (["0"], {}, "frame\n0\n", "columns"),
            (["0"], {}, "frame,time\n0,soon\n", "line 2"),
            (["0"], {}, "frame,time\n0,1\n0,2\n", "frame 0 twice"),
            (["0"], {}, "frame,time\n1,1\n", "no time of any picture"),
            (["0"], {}, "frame,time\n", "no time of any picture"),
        ],
    )
    def test_unusable_folders_are_refused(self, tmp_path, names, more, stamps, reason):
        folder = write_folder(tmp_path, names)
        if stamps is not None:
            (folder / "timestamps.csv").write_text(stamps)
        with pytest.raises(SceneError, match=reason):
            open_source(specify(folder, **more))


def write_video(path, count, size=(WIDTH, HEIGHT)):
    return write_film(path, [np.full(size[::-1], 25 * k) for k in range(count)], 12.5)


class TestVideo:
    def test_times_are_the_files_own_or_the_given_rate(self, tmp_path):
        path = write_video(tmp_path / "v.avi", 6)
        source = open_source(specify(path, "video", rate_hz=None))
        assert source.rate_hz == pytest.approx(12.5)
        found = read_all(source)
        assert [one.time for one in found] == pytest.approx(0.08 * np.arange(6))
        assert [one.picture.mean() for one in found] == pytest.approx(25 * np.arange(6), abs=4)
        assert not source.problems
        found = read_all(open_source(specify(path, "video", rate_hz=50.0)))
        assert [one.time for one in found] == pytest.approx(0.02 * np.arange(6))

    def test_missing_frames_of_a_truncated_video_are_counted(self, tmp_path):
        path = write_video(tmp_path / "v.avi", 10)
        whole = path.read_bytes()
        path.write_bytes(whole[: 9 * len(whole) // 10])
        source = open_source(specify(path, "video"))
        found = read_all(source)
        assert 3 < len(found) < 10
        assert source.dropped == 10 - len(found)
        assert f"ends after {len(found)} of 10 pictures" in source.problems[0]

    def test_masks_in_a_video_are_thresholded_and_grey_images_refused(self, tmp_path):
        path = write_video(tmp_path / "v.avi", 11)
        source = open_source(specify(path, "video", background=None))
        found = read_all(source)
        assert [int(one.frame) for one in found] == [0, 1, 2, 8, 9, 10]
        assert [bool(one.picture.all()) for one in found] == [int(one.frame) > 5 for one in found]
        assert source.dropped == 5
        assert "picture 3: 100% of it is neither dark nor light" in source.problems[0]


class FakeCamera(SimpleNamespace):
    """A stand-in for cv2.VideoCapture: a device that fails now and then."""

    opened = 0

    def __init__(self, place):
        FakeCamera.opened += 1
        assert place == 7
        works, shown = FakeCamera.opened != 1, iter([(True, picture(FakeCamera.opened))] * 3)
        super().__init__(isOpened=lambda: works, set=lambda *_: True, release=lambda: None)
        self.read = lambda: time.sleep(0.01) or next(shown, (False, None))


def wait_for(condition, timeout=10.0):
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.005)


class TestDevice:
    @pytest.fixture
    def device(self, monkeypatch):
        """A function that opens a source whose camera fails a number of times first."""
        monkeypatch.setattr(cv2, "VideoCapture", FakeCamera)
        opened = []

        def open_after(tries, **more):
            FakeCamera.opened = tries
            camera = specify("7", "device", **more)
            opened.append(DeviceSource(camera, pauses=(0.02, 10.0)))
            return opened[0]

        yield open_after
        opened[0].close()
        assert opened[0].ended

    def test_the_latest_image_is_kept_and_the_camera_reopened(self, device):
        source = device(0)
        # It cannot be opened at first, then provides three images at a time, and fails again.
        wait_for(lambda: FakeCamera.opened >= 4)
        one = source.read()
        assert int(one.frame) >= 5, "older images are dropped"
        assert abs(one.time - time.monotonic()) < 5.0
        assert not source.ended
        for k, expected in enumerate(("cannot be opened", "answers again", "stopped")):
            assert expected in source.problems[k]

    def test_a_wrong_size_ends_the_source(self, device):
        source = device(1, width=640, height=480)
        wait_for(lambda: source.ended)
        assert source.read() is None
        assert "32 x 24" in source.problems[0]


VIDEO = {"kind": "video", "location": "a"}
FOLDER = {"kind": "folder", "rate_hz": 10}
ENTRIES = {
    name: FOLDER | {"location": f"images/{name}", "background": f"empty/{name}"}
    for name in ("camera_1", "camera_0")
}


class TestSourcesFile:
    @pytest.fixture
    def studio(self, tmp_path):
        cameras = circle_of_cameras(2, size=(WIDTH, HEIGHT), face_camera=False)
        save_cameras(tmp_path / "cameras.yaml", cameras)
        for name in cameras:
            write_folder(tmp_path / "images" / name, ["0", "1"])
            write_folder(tmp_path / "empty" / name, ["0"])
        return tmp_path

    @staticmethod
    def load(studio, entries):
        (studio / "sources.yaml").write_text(yaml.safe_dump(entries, sort_keys=False))
        return load_sources(studio)

    def test_sources_have_the_order_of_the_cameras(self, studio):
        found = self.load(studio, ENTRIES)
        assert list(found) == ["camera_0", "camera_1"]
        one = found["camera_0"]
        assert (one.width, one.height, one.rate_hz) == (WIDTH, HEIGHT, 10.0)
        assert one.beside == (str(studio / "images" / "camera_1"),)
        assert load_sources(studio / "sources.yaml") == found
        assert pickle.loads(pickle.dumps(one)) == one
        assert len(read_all(open_source(one))) == 2
        (empty,) = load_background_pictures(one)
        assert empty.shape == (HEIGHT, WIDTH, 3)

    def test_device_may_have_a_number_or_an_address(self, studio):
        devices = [{"kind": "device", "location": place, "masks": True} for place in (0, "rtsp://")]
        found = self.load(studio, {f"camera_{k}": one for k, one in enumerate(devices)}).values()
        assert [(one.location, one.live, one.gives_masks) for one in found] == [
            ("0", True, True), ("rtsp://", True, True),
        ]  # fmt: skip

    def test_invalid_entries_are_named(self, studio):
        for change, reason in (
            ({"camera_9": {}}, "'camera_9' is not in cameras.yaml"),
            ({"camera_1": VIDEO | {"kind": "film", "masks": True}}, "kind must be"),
            ({"camera_1": VIDEO | {"colour": 1}}, "unknown field colour"),
            ({"camera_1": VIDEO}, "masks: true"),
            ({"camera_1": VIDEO | {"masks": True, "background": "b"}}, "either"),
            ({"camera_1": VIDEO | {"masks": True, "rate_hz": -1}}, "rate_hz"),
        ):
            with pytest.raises(SceneError, match=reason) as error:
                self.load(studio, ENTRIES | change)
            assert "sources.yaml" in str(error.value)
        with pytest.raises(SceneError, match=r"'camera_1' is not in sources.yaml"):
            self.load(studio, {"camera_0": ENTRIES["camera_0"]})

    def test_an_unusable_background_is_named(self, studio):
        missing = {"camera_0": ENTRIES["camera_0"] | {"background": "nothing"}}
        cv2.imwrite(str(studio / "empty/camera_1/0.png"), np.zeros((5, 7, 3), np.uint8))
        found = self.load(studio, ENTRIES | missing)
        for name, reason in (("camera_0", "empty-room"), ("camera_1", "7 x 5")):
            with pytest.raises(SceneError, match=reason):
                load_background_pictures(found[name])
