"""Images that encode their own numbers, and videos of them encoded by PyAV."""

from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np

SIDE, BITS = 64, 8
LENS = "width: 64, height: 64, focal_x: 70, focal_y: 75, center_x: 31.5, center_y: 30"
K = np.array([[70.0, 0.0, 31.5], [0.0, 75.0, 30.0], [0.0, 0.0, 1.0]])


def numbered(k: int, width: int = SIDE) -> np.ndarray:
    """Return an image (64, width, 3) whose stripes are the bits of its number, red at the top."""
    stripes = np.repeat([20 + 200 * (k >> b & 1) for b in range(BITS)], width // BITS)
    picture = np.tile(stripes.astype(np.uint8)[None, :, None], (SIDE, 1, 3))
    picture[: SIDE // 4] = 230, 20, 20
    return picture


def number_of(picture: np.ndarray) -> int:
    """Return the number encoded in a possibly lossy image, which must be upright and in colour."""
    red, _, blue = picture[:8].reshape(-1, 3).mean(axis=0)
    assert red > 150 > 100 > blue, "the top is not red"
    row = picture[SIDE // 2, :, 1].reshape(BITS, -1).mean(axis=1)
    return int(sum(1 << b for b in range(BITS) if row[b] > 120))


def write_pictures(
    path: Path,
    pictures: Sequence[np.ndarray],
    times: Sequence[float],
    codec: str,
    container_options: dict[str, str] | None = None,
    rate: int = 30,
    **options: str,
) -> None:
    """Write a video of images (H, W, 3) at times [s], with an encoder's options such as crf."""
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", options=container_options or {}) as container:
        stream = container.add_stream(codec, rate=rate, options=options)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 60000)
        for picture, time in zip(pictures, times, strict=True):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            frame.pts, frame.time_base = round(60000 * time), Fraction(1, 60000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def write_video(
    path: Path,
    numbers: Sequence[int],
    times: Sequence[float] | None = None,
    codec: str = "libx264",
    width: int = SIDE,
    **options: str,
) -> Path:
    """Write a video of numbered images at times [s]; by default at 10 Hz."""
    settings = {"g": "5"} | ({} if codec == "libsvtav1" else {"bf": "2"})
    if times is None:
        times = 0.1 * np.arange(len(numbers))
    pictures, container = [numbered(k, width) for k in numbers], {"movflags": "faststart"} | options
    write_pictures(path, pictures, times, codec, container, 10, **settings)
    return path


def write_film(path: Path, pictures: Sequence[np.ndarray], rate: float) -> Path:
    """Write a grey video of images (H, W) with a rate [Hz], each compressed by itself."""
    path.parent.mkdir(parents=True, exist_ok=True)
    kind = cv2.VideoWriter.fourcc(*"MJPG")
    writer = cv2.VideoWriter(str(path), kind, rate, pictures[0].shape[::-1])
    for picture in pictures:
        writer.write(np.dstack([picture.astype(np.uint8)] * 3))
    writer.release()
    return path


def write_table(path: Path, columns: Mapping[str, Any]) -> None:
    """Write a parquet table of columns by name."""
    import pyarrow.parquet

    path.parent.mkdir(parents=True, exist_ok=True)
    pyarrow.parquet.write_table(pyarrow.table(columns), path)


def png(number: int) -> bytes:
    """Return the PNG file of a numbered image."""
    return bytes(cv2.imencode(".png", numbered(number)[:, :, ::-1])[1])
