import numpy as np
import pytest

from drake_pose.camera.camera_files import load_cameras, save_cameras
from drake_pose.camera.models import ParallelCamera, PinholeCamera
from drake_pose.errors import CameraError

EYE = "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
SIDES = "width: 64, height: 48, center_x: 31.5, center_y: 23.5"
GOOD = f"{{{SIDES}, focal_x: 60, focal_y: 61, X_WC: {EYE}}}"


def write(folder, text):
    path = folder / "cameras.yaml"
    path.write_text(text)
    return path


def test_round_trip_is_exact(tmp_path):
    rng = np.random.default_rng(0)
    X_WC = np.eye(4)
    X_WC[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    X_WC[:3, :3] *= np.linalg.det(X_WC[:3, :3])
    X_WC[:3, 3] = rng.normal(size=3)
    written = {
        "a": PinholeCamera("a", 64, 48, 60.0, 1e-7, 1 / 3, 23.5, X_WC, near=1e-3),
        "b": ParallelCamera("b", 700, 701, 226.0, 350.0, -12.25, X_WC),
    }
    save_cameras(tmp_path / "c.yaml", written)
    read = load_cameras(tmp_path / "c.yaml")
    assert list(read) == ["a", "b"]
    for name, camera in read.items():
        assert type(camera) is type(written[name])
        np.testing.assert_array_equal(camera.kernel_parameters(), written[name].kernel_parameters())
        np.testing.assert_array_equal(camera.X_WC, written[name].X_WC)


def test_projection_may_be_spelled_out(tmp_path):
    text = f"7: {{projection: parallel, {SIDES}, pixels_per_metre: 1e2, X_WC: {EYE}}}"
    camera = load_cameras(write(tmp_path, text))["7"]
    assert isinstance(camera, ParallelCamera)
    assert camera.pixels_per_metre == 100.0


def test_principal_points_may_be_counted_as_drake_does(tmp_path):
    for kind in ("focal_x: 60, focal_y: 61", "projection: parallel, pixels_per_metre: 9"):
        text = f"{{{kind}, pixel_centers: drake, {SIDES}, X_WC: {EYE}}}"
        camera = load_cameras(write(tmp_path, f"cam: {text}"))["cam"]
        assert (camera.center_x, camera.center_y) == (31.0, 23.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"cam: {{{GOOD[1:-1]}, pixel_centers: middle}}", "'cam'.*integers.*drake.*'middle'"),
        ("", "mapping from camera names"),
        ("[1, 2]", "mapping from camera names"),
        ("cam: 3", "'cam'.*mapping from field names"),
        ("cam: [", "not a YAML file"),
        ("cam: !!python/object/apply:os.system [ls]", "not a YAML file"),
        (f"cam: {GOOD}\ncam: {GOOD}", "given twice"),
        (f"1: {GOOD}\n'1': {GOOD}", "given twice"),
        (f"../up: {GOOD}", "camera's name"),
        (f"? [1, 2]\n: {GOOD}", "not a YAML file"),
        (f"cam: {{{SIDES}, focal_x: 60, X_WC: {EYE}}}", "'cam'.*needs focal_y"),
        (f"cam: {{{SIDES}, projection: parallel, X_WC: {EYE}}}", "'cam'.*needs pixels_per_metre"),
        (GOOD.join(["cam: ", ""]).replace("focal_x", "fx: 1, focal_x"), "'cam'.*unknown field fx"),
        ("cam: {projection: fisheye}", "'cam'.*projection"),
        ("cam: {projection: [1]}", "'cam'.*projection"),
        (f"cam: {GOOD}".replace("width: 64", "width: .nan"), "'cam'.*width"),
        (f"cam: {GOOD}".replace("focal_y: 61", "focal_y: [61]"), "'cam'.*focal_y"),
        (f"cam: {GOOD}".replace("[0, 1, 0, 0]", "[0, -1, 0, 0]"), "'cam'.*X_WC.*reflection"),
        (f"cam: {GOOD}".replace("[0, 0, 0, 1]", "[0, 0, 1]"), "'cam'.*X_WC.*4 x 4"),
        ("[" * 5000, "YAML|deeply"),
    ],
)
def test_bad_files_are_refused(tmp_path, text, message):
    path = write(tmp_path, text)
    with pytest.raises(CameraError, match=message) as caught:
        load_cameras(path)
    assert str(path) in str(caught.value)
    assert len(str(caught.value)) < 1000


def test_files_that_cannot_be_read_or_written(tmp_path):
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00\x80")
    (tmp_path / "large.yaml").write_text("# " + "x" * (1 << 21))
    files = {
        "missing.yaml": "missing",
        ".": "folder",
        "binary.yaml": "mapping",
        "large.yaml": "larger",
    }
    for name, reason in files.items():
        with pytest.raises(CameraError, match=reason) as caught:
            load_cameras(tmp_path / name)
        assert str(tmp_path / name) in str(caught.value)
    camera = PinholeCamera("a", 64, 48, 60.0, 60.0, 31.0, 23.0, np.eye(4))
    with pytest.raises(CameraError, match="nowhere"):
        save_cameras(tmp_path / "nowhere" / "c.yaml", [camera])


def test_alias_bombs_are_refused_quickly(tmp_path):
    lines = ["a0: &a0 [[1]]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 40)]
    with pytest.raises(CameraError, match="a0"):
        load_cameras(write(tmp_path, "\n".join(lines)))
    lines = [f"cam: {{{SIDES}, focal_x: 1, focal_y: 1, X_WC: *a39}}", *lines]
    with pytest.raises(CameraError):
        load_cameras(write(tmp_path, "\n".join([*lines[1:], lines[0]])))
