"""An object in pictures by a user's segmentation network (ONNX), run by OpenCV."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Floats, Mask, Picture
from drake_pose.camera.models import LARGEST_SIDE
from drake_pose.errors import SettingsError
from drake_pose.regular_files import read_regular
from drake_pose.silhouette.segmentation.mask_pictures import ALL

# Where an ONNX file's messages hold others, by field: from its model down to what is told of data
# in other files (onnx.proto).
_HELD = {
    "model": {7: "graph", 25: "function"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "function": {7: "node", 11: "attribute"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
    "tensor": {13: "entry"},
}


class SegmentationNetwork:
    """A network (an ONNX file) that says for each pixel which class it is of.

    Its first output is (1, classes, h, w), scores or probabilities of classes; (1, 1, h, w) or
    (1, h, w), the object's probability or its logit; or (1, h, w) of whole numbers, classes.

    Args:
        classes: the numbers of the classes that are the object; ``all``: each but 0. None are
            needed where there are two classes at most.
        size: width and height that pictures are brought to [pixel]; None: they stay as they are.
        mean, std: of red, green and blue; the network takes ``(picture / 255 - mean) / std``.
        bgr: whether it takes blue, green, red.

    Raises SettingsError: OpenCV cannot read the file, a class is no number, or a size or standard
    deviation is out of its range.
    """

    def __init__(
        self,
        file: Path,
        classes: Sequence[str] = (),
        size: Sequence[int] | None = None,
        mean: Sequence[float] = (0.0, 0.0, 0.0),
        std: Sequence[float] = (1.0, 1.0, 1.0),
        bgr: bool = False,
    ) -> None:
        self._file, self._classes = file, tuple(classes)
        self._size, self._mean, self._std, self._bgr = size, mean, std, bgr
        if size is not None and not all(1 <= side <= LARGEST_SIDE for side in size):
            raise SettingsError(
                f"a network's size needs a width and a height of 1 to {LARGEST_SIDE} pixels"
            )
        if min(std) <= 0.0:
            raise SettingsError("standard deviations of a network's input must be positive")
        for name in classes:
            if name != ALL and not name.isdecimal():
                raise SettingsError(f"{file}: a network's classes are numbers, not '{name}'")
        if not file.is_file():
            raise SettingsError(f"{file}: there is no such network")
        try:
            others = _other_files(read_regular(file))
        except (OSError, LookupError, UnicodeDecodeError) as error:
            raise SettingsError(f"{file}: cannot be read, or is no ONNX file: {error}") from error
        for name in others:
            if not (file.parent / name).resolve().is_relative_to(file.parent.resolve()):
                raise SettingsError(
                    f"{file}: its weights are in another folder, '{name}'; a network may read "
                    "files beside it alone: put them there, and save it anew"
                )
        try:
            self._network = cv2.dnn.readNetFromONNX(str(file))
        except cv2.error as error:
            raise SettingsError(f"{file}: OpenCV cannot read this network: {error.err}") from error

    def find(self, picture: Picture) -> Mask:
        """The object (H, W) in a picture (H, W, 3) red, green, blue.

        Raises SettingsError: the network does not take such pictures, or gives another output.
        """
        values = (picture.astype(np.float32) / 255.0 - np.asarray(self._mean)) / self._std
        if self._size is not None:
            values = np.asarray(cv2.resize(values, self._size, interpolation=cv2.INTER_LINEAR))
        values = values[:, :, ::-1] if self._bgr else values
        self._network.setInput(np.ascontiguousarray(values.transpose(2, 0, 1)[None], np.float32))
        try:
            output = np.asarray(self._network.forward())
        except cv2.error as error:
            raise SettingsError(
                f"{self._file}: does not take a picture of {values.shape[1]} x {values.shape[0]} "
                f"pixels (give its size with --network-size): {error.err}"
            ) from error
        # Scores are brought to the picture's size, not classes: the edge lies between pixels.
        height, width = picture.shape[:2]
        score = cv2.resize(self._score(output), (width, height), interpolation=cv2.INTER_LINEAR)
        return np.asarray(score > 0.0)

    def _score(self, output: NDArray[np.generic]) -> Floats:
        """(h, w) positive where the object is more likely than anything else."""
        if output.ndim not in (3, 4) or output.shape[0] != 1:
            raise SettingsError(
                f"{self._file}: its output has the shape {output.shape}, but must be (1, classes, "
                "height, width) or (1, height, width)"
            )
        layers = (output[0] if output.ndim == 4 else output).astype(np.float32)
        if not np.isfinite(layers).all():
            raise SettingsError(
                f"{self._file}: its output is not finite; is the input as it must be?"
            )
        if len(layers) > 1:
            mine = np.isin(np.arange(len(layers)), self._numbers(len(layers)))
            if mine.all():
                raise SettingsError(
                    f"{self._file}: all of its {len(layers)} classes are said to be the object"
                )
            return np.asarray(layers[mine].max(axis=0) - layers[~mine].max(axis=0))
        layer = layers[0]
        least, most = layer.min(), layer.max()
        if (layer == np.rint(layer)).all() and least >= 0.0 and (self._classes or most > 1.0):
            return np.isin(layer, self._numbers(int(most) + 1, "several")).astype(np.float32) - 0.5
        return np.asarray(layer - (0.5 if least >= 0.0 and most <= 1.0 else 0.0))

    def _numbers(self, count: int, known: str = "") -> list[int]:
        """The chosen classes' numbers, of this many classes, or of several."""
        if ALL in self._classes:
            return list(range(1, count))
        if not self._classes and (known or count != 2):
            raise SettingsError(
                f"{self._file}: has {known or count} classes; say which is the object: "
                "--class NUMBER"
            )
        numbers = [int(name) for name in self._classes] or [1]
        if not known and max(numbers) >= count:
            raise SettingsError(
                f"{self._file}: has the classes 0 to {count - 1}, not {max(numbers)}"
            )
        return numbers


def _other_files(content: bytes) -> set[str]:
    """The files that an ONNX file's tensors name as theirs; LookupError, UnicodeDecodeError."""
    names, waiting = set(), [("model", memoryview(content))]
    while waiting:
        kind, message = waiting.pop()
        held, known = list(_messages(message)), _HELD.get(kind, {})
        if kind == "entry" and (1, b"location") in held:
            names.add(bytes(dict(held).get(2, b"")).decode())
        waiting += [(known[field], one) for field, one in held if field in known]
    return names


def _messages(message: memoryview) -> Iterator[tuple[int, memoryview]]:
    """A Protocol Buffers message's fields of bytes, by number; LookupError: it is none."""
    place = 0

    def number() -> int:
        nonlocal place
        value = shift = 0
        while True:
            byte = message[place]
            value, shift, place = value | (byte & 127) << shift, shift + 7, place + 1
            if byte < 128:
                return value

    while place < len(message):
        field, wire = divmod(number(), 8)
        if wire == 2:
            size = number()
            yield field, message[place : place + size]
            place += size
        elif wire == 0:
            number()
        else:
            place += {1: 8, 5: 4}[wire]
