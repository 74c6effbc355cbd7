"""Videos read by number and by time; encoded by PyAV and checked against OpenCV's decoder."""

import sys

import cv2
import numpy as np
import pytest

from drake_pose.camera.picture_files import TimedVideo, VideoPictures, read_picture
from drake_pose.errors import SceneError
from tests.camera.recordings import number_of, write_video


@pytest.mark.parametrize("codec", ["libx264", "libsvtav1", "mpeg4"])
def test_images_are_read_in_any_order(tmp_path, codec):
    path = write_video(tmp_path / "a.mp4", range(23), codec=codec)
    video, plain = TimedVideo(path), VideoPictures(path)
    np.testing.assert_allclose(video.times, 0.1 * np.arange(23), atol=1e-9)
    order = [*range(23), *np.random.default_rng(0).permutation(23).tolist(), 22, 22, 0]
    assert [number_of(video.read(k)) for k in order] == order
    assert (video.warnings, plain.count) == ([], 23)
    for k in (3, 22, 0):
        np.testing.assert_array_equal(plain.read(k), video.read(k))
    with pytest.raises(SceneError, match=r"a\.mp4: has pictures 0 to 22 only"):
        video.read(23)
    with pytest.raises(SceneError, match=r"a\.mp4: has (no picture 23|pictures 0 to 22)"):
        plain.read(23)
    assert (number_of(plain.read(5)), plain.rate_hz) == (5, pytest.approx(10.0, rel=0.1))


def test_times_follow_a_variable_frame_rate(tmp_path):
    times = [0.0, 0.04, 0.08, 0.3, 0.34, 1.5]
    video = TimedVideo(write_video(tmp_path / "a.mkv", range(6), times))
    np.testing.assert_allclose(video.times, times, atol=1e-3)
    assert [number_of(video.read(k)) for k in (5, 0, 3)] == [5, 0, 3]


@pytest.mark.parametrize("suffix", ["mp4", "mov", "mkv", "avi"])
def test_a_video_may_begin_late(tmp_path, suffix):
    """Its times are those in the file; AVI has none. OpenCV counts pictures from 0 on in MKV."""
    times = 0.2 + 0.1 * np.arange(9)
    codec = "mpeg4" if suffix == "avi" else "libx264"
    path = write_video(tmp_path / f"a.{suffix}", range(9), times, codec=codec)
    video = TimedVideo(path)
    late = 0.2 * (suffix != "avi")
    # AVI has no order of B-frames, so that its last time may be wrong.
    np.testing.assert_allclose(video.times[:8], 0.1 * np.arange(8) + late, atol=1e-3)
    assert [number_of(video.read(k)) for k in (0, 7, 3)] == [0, 7, 3]
    if suffix != "avi":
        plain = VideoPictures(path)
        assert ([number_of(plain.read(k)) for k in range(plain.count)]) == [*range(9)]
        assert plain.time == pytest.approx(0.8)


def test_deep_pictures_are_decoded_once(tmp_path, monkeypatch):
    calls, decode = [], cv2.imdecode
    monkeypatch.setattr(cv2, "imdecode", lambda *how: calls.append(how) or decode(*how))
    rng, path = np.random.default_rng(0), tmp_path / "a.png"
    for shape in ((9, 11), (9, 11, 3), (9, 11, 4)):
        values = rng.integers(0, 1 << 16, shape, dtype=np.uint16)
        cv2.imwrite(str(path), values)
        found = read_picture(path, SceneError)
        upper = np.dstack([values >> 8] * 3) if len(shape) == 2 else values[:, :, 2::-1] >> 8
        np.testing.assert_array_equal(found, upper)
    assert len(calls) == 3
    cv2.imwrite(str(path), values >> 4)
    with pytest.raises(SceneError, match=r"a\.png: has 16 bits per pixel, but no value above 40"):
        read_picture(path, SceneError)


def test_rotation_metadata_is_applied(tmp_path):
    path = write_video(tmp_path / "a.mp4", range(3))
    one, far, data = 1 << 16, 1 << 30, path.read_bytes()
    upright = np.array([one, 0, 0, 0, one, 0, 0, 0, far], dtype=">i4").tobytes()
    turned = np.array([0, one, 0, -one, 0, 0, 0, 0, far], dtype=">i4").tobytes()
    where = data.index(upright, data.index(b"tkhd"))
    path.write_bytes(data[:where] + turned + data[where + len(turned) :])
    found, shown = TimedVideo(path).read(0), cv2.VideoCapture(str(path)).read()[1]
    np.testing.assert_array_equal(found, shown[:, :, ::-1])
    assert (found[:, -8:, 0].mean() > 150) & (found[:8, :32, 0].mean() < 100)


def test_truncated_videos_are_read_up_to_their_end(tmp_path):
    for name, flag in (("a.mp4", "faststart"), ("b.mp4", "disable_chpl")):
        path = write_video(tmp_path / name, range(60), movflags=flag)
        path.write_bytes(path.read_bytes()[: int(0.8 * path.stat().st_size)])
    video = TimedVideo(tmp_path / "a.mp4")
    last = len(video.times) - 1
    assert 10 < last < 59
    assert video.warnings[0].endswith(f"is truncated: it ends after {last + 1} of 60 pictures")
    assert number_of(video.read(last)) == last
    with pytest.raises(SceneError, match=f"is truncated: it has pictures 0 to {last} only"):
        video.read(last + 1)
    # A truncated file whose index was at the end is unreadable.
    for name in ("b.mp4", "none.mp4"):
        with pytest.raises(SceneError, match=rf"{name}: not a video that PyAV can read"):
            TimedVideo(tmp_path / name)


def test_a_missing_library_names_its_extra(tmp_path, monkeypatch):
    path = write_video(tmp_path / "a.mp4", range(2), codec="libsvtav1")
    monkeypatch.setitem(sys.modules, "av", None)
    for reader in (TimedVideo, VideoPictures):
        with pytest.raises(SceneError, match=r"a\.mp4: .* pip install 'drake_pose\[episodes\]'"):
            reader(path)
