"""Picture files against Pillow and OpenCV; videos by PyAV and checked against OpenCV's decoder."""

import cv2
import numpy as np
import pytest
from PIL import Image

from drake_pose.camera.picture_files import Video, picture_size, read_picture
from drake_pose.errors import SceneError
from tests.camera.recordings import number_of, write_video

PICTURE = np.random.default_rng(0).integers(0, 256, (40, 60, 3)).astype(np.uint8)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_size_of_whole_files_and_refusal_of_damaged_ones(tmp_path, suffix):
    path = tmp_path / f"0001{suffix}"
    cv2.imwrite(str(path), PICTURE)
    assert picture_size(path) == read_picture(path).shape[1::-1] == (60, 40)
    whole = path.read_bytes()
    damaged = [b"", b"no picture", whole[:20], whole[:-30], bytes(len(whole))]
    if suffix == ".png":
        damaged.append(whole[:200] + bytes([whole[200] ^ 255]) + whole[201:])
    for content in damaged:
        path.write_bytes(content)
        for read in (picture_size, read_picture):
            with pytest.raises(SceneError, match=f"0001{suffix}"):
                read(path)


def test_deep_and_turned_pictures_are_decoded_and_have_no_size(tmp_path):
    rng, deep, turned = np.random.default_rng(0), tmp_path / "deep.png", tmp_path / "turned.jpg"
    for shape in ((9, 11), (9, 11, 3), (9, 11, 4)):
        values = rng.integers(0, 1 << 16, shape, dtype=np.uint16)
        cv2.imwrite(str(deep), values)
        upper = np.dstack([values >> 8] * 3) if len(shape) == 2 else values[:, :, 2::-1] >> 8
        np.testing.assert_array_equal(read_picture(deep), upper)
    cv2.imwrite(str(deep), values >> 4)
    with pytest.raises(SceneError, match=r"deep\.png: has 16 bits .*, but no value above 40"):
        read_picture(deep)
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(PICTURE).save(turned, exif=exif)
    assert read_picture(turned).shape == (60, 40, 3)
    assert picture_size(deep) is picture_size(turned) is None


@pytest.mark.parametrize("codec", ["libx264", "libsvtav1", "mpeg4"])
def test_images_are_read_in_any_order(tmp_path, codec):
    path = write_video(tmp_path / "a.mp4", range(23), codec=codec)
    video, plain = Video(path), cv2.VideoCapture(str(path))
    np.testing.assert_allclose(video.times, 0.1 * np.arange(23), atol=1e-9)
    order = [*range(23), *np.random.default_rng(0).permutation(23).tolist(), 22, 22, 0]
    assert [number_of(video.read(k)) for k in order] == order
    assert (video.warnings, video.promised, video.rate_hz) == ([], 23, 10.0)
    for k in range(0 if codec == "libsvtav1" else 23):  # OpenCV has no decoder of AV1.
        np.testing.assert_array_equal(plain.read()[1][:, :, ::-1], video.read(k))
    with pytest.raises(SceneError, match=r"a\.mp4: has pictures 0 to 22 only"):
        video.read(23)


@pytest.mark.parametrize("suffix", ["mp4", "mov", "mkv", "avi"])
def test_times_are_those_in_the_file(tmp_path, suffix):
    """They may begin late and have a variable rate; AVI has none."""
    regular = 0.1 * np.arange(9)
    late = np.array([0.2, 0.24, 0.28, 0.5, 0.54, 0.6, 0.7, 1.7, 1.8])
    given, codec = (regular + 0.2, "mpeg4") if suffix == "avi" else (late, "libx264")
    video = Video(write_video(tmp_path / f"a.{suffix}", range(9), given, codec=codec))
    # AVI has no order of B-frames, so that its last time may be wrong.
    expected = regular if suffix == "avi" else late
    np.testing.assert_allclose(video.times[:8], expected[:8], atol=1e-3)
    assert [number_of(video.read(k)) for k in (0, 7, 3)] == [0, 7, 3]


def test_rotation_metadata_is_applied(tmp_path):
    path = write_video(tmp_path / "a.mp4", range(3))
    one, far, data = 1 << 16, 1 << 30, path.read_bytes()
    upright = np.array([one, 0, 0, 0, one, 0, 0, 0, far], dtype=">i4").tobytes()
    turned = np.array([0, one, 0, -one, 0, 0, 0, 0, far], dtype=">i4").tobytes()
    where = data.index(upright, data.index(b"tkhd"))
    path.write_bytes(data[:where] + turned + data[where + len(turned) :])
    found, shown = Video(path).read(0), cv2.VideoCapture(str(path)).read()[1]
    np.testing.assert_array_equal(found, shown[:, :, ::-1])
    assert (found[:, -8:, 0].mean() > 150) & (found[:8, :32, 0].mean() < 100)


def test_truncated_videos_are_read_up_to_their_end(tmp_path):
    for name, flag in (("a.mp4", "faststart"), ("b.mp4", "disable_chpl")):
        path = write_video(tmp_path / name, range(60), movflags=flag)
        path.write_bytes(path.read_bytes()[: int(0.8 * path.stat().st_size)])
    video = Video(tmp_path / "a.mp4")
    last = len(video.times) - 1
    assert 10 < last < 59
    assert video.warnings[0].endswith(f"is truncated: it ends after {last + 1} of 60 pictures")
    assert number_of(video.read(last)) == last
    with pytest.raises(SceneError, match=f"is truncated: it has pictures 0 to {last} only"):
        video.read(last + 1)
    # A truncated file whose index was at the end is unreadable.
    for name in ("b.mp4", "none.mp4"):
        with pytest.raises(SceneError, match=rf"{name}: not a video that PyAV can read"):
            Video(tmp_path / name)
