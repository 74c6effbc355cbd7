"""Removal of lens distortion from pictures: the job of `drake-pose undistort`."""

from pathlib import Path

from drake_pose.camera.camera_files import dump_cameras, load_camera_file
from drake_pose.camera.models import PinholeCamera
from drake_pose.camera.picture_files import find_pictures, read_picture
from drake_pose.camera.sources import CAMERAS
from drake_pose.errors import CameraError
from drake_pose.files.folder import write_file
from drake_pose.files.overlay import encode_png


def undistort_pictures(
    folder: str | Path, cameras: str | Path, out: str | Path
) -> dict[tuple[str, str], Path]:
    """Write undistorted pictures and their cameras.

    Args:
        folder: folder with `images/<camera>/<frame>.png` (or .jpg).
        cameras: camera file of any supported format, with distortion.
        out: folder for `images/<camera>/<frame>.png` and `cameras.yaml`.

    Returns the written pictures by (camera, frame).

    Raises:
        CameraError: a camera is not in the file, or a picture cannot be read or has another size.
        SceneError: a camera's folder holds no pictures.
        OutputError: a file cannot be written.
    """
    known, root = load_camera_file(cameras, distorted=True), Path(folder) / "images"
    if not root.is_dir():
        raise CameraError(f"{folder}: no such folder; it needs images/<camera>/<frame>.png")
    names = sorted(path.name for path in root.iterdir() if path.is_dir())
    for name in names:
        if not isinstance(known.cameras.get(name), PinholeCamera):
            raise CameraError(
                f"{cameras}: has no pinhole camera '{name}'; it has: {', '.join(known.cameras)}"
            )
    used = {name: known.cameras[name] for name in names}
    text = dump_cameras(used, known.links, known.unplaced)
    write_file(Path(out), CAMERAS, text.encode())
    written = dict[tuple[str, str], Path]()
    for name in names:
        for frame, path in find_pictures(root / name, name).items():
            picture = read_picture(path, CameraError)
            if name in known.lenses:
                picture = known.lenses[name].undistort(picture)
            place = f"images/{name}/{frame}.png"
            write_file(Path(out), place, encode_png(picture))
            written[name, frame] = Path(out) / place
    return written
