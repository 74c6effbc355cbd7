"""An object in pictures by a user's segmentation network (ONNX), run by OpenCV."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.errors import SettingsError
from drake_pose.silhouette.segmentation.mask_pictures import ALL

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Array = NDArray[np.float32]


@dataclass(frozen=True)
class NetworkInput:
    """How a picture is put into a network: ``(picture / 255 - mean) / std``.

    Args:
        size: width and height that pictures are brought to [pixel]; None: they stay as they are.
        mean, std: of red, green and blue.
        bgr: whether the network takes blue, green, red.

    Raises:
        SettingsError: a size or standard deviation that is not positive.
    """

    size: tuple[int, ...] | None = None
    mean: tuple[float, ...] = (0.0, 0.0, 0.0)
    std: tuple[float, ...] = (1.0, 1.0, 1.0)
    bgr: bool = False

    def __post_init__(self) -> None:
        if self.size is not None and min(self.size) < 1:
            raise SettingsError("a network's size needs a width and a height of one pixel or more")
        if min(self.std) <= 0.0:
            raise SettingsError("standard deviations of a network's input must be positive")


class SegmentationNetwork:
    """A network that says for each pixel which class it is of.

    Its first output is (1, classes, h, w), scores or probabilities of classes; (1, 1, h, w) or
    (1, h, w), the object's probability or its logit; or (1, h, w) of whole numbers, classes.

    Args:
        file: an ONNX file.
        taken: how pictures are put into it.
        classes: the numbers of the classes that are the object; ``all``: each but 0. None are
            needed where there are two classes at most.

    Raises:
        SettingsError: OpenCV cannot read the file, or a class is no number.
    """

    def __init__(
        self, file: Path, taken: NetworkInput | None = None, classes: Sequence[str] = ()
    ) -> None:
        self._file, self._taken = file, taken or NetworkInput()
        for name in classes:
            if name != ALL and not name.isdecimal():
                raise SettingsError(f"{file}: a network's classes are numbers, not '{name}'")
        self._classes = tuple(classes)
        if not file.is_file():
            raise SettingsError(f"{file}: there is no such network")
        try:
            self._network = cv2.dnn.readNetFromONNX(str(file))
        except cv2.error as error:
            raise SettingsError(f"{file}: OpenCV cannot read this network: {error.err}") from error

    def find(self, picture: Picture) -> Mask:
        """The object (H, W) in a picture (H, W, 3) red, green, blue.

        Raises:
            SettingsError: the network does not take such pictures, or its output is of another
                form, or has no such class.
        """
        taken = self._taken
        values = (picture.astype(np.float32) / 255.0 - taken.mean) / taken.std
        if taken.size is not None:
            values = np.asarray(cv2.resize(values, taken.size, interpolation=cv2.INTER_LINEAR))
        values = values[:, :, ::-1] if taken.bgr else values
        self._network.setInput(np.ascontiguousarray(values.transpose(2, 0, 1)[None], np.float32))
        try:
            output = np.asarray(self._network.forward())
        except cv2.error as error:
            raise SettingsError(
                f"{self._file}: does not take a picture of {values.shape[1]} x {values.shape[0]} "
                f"pixels (give its size with --network-size): {error.err}"
            ) from error
        score = self._score(output)
        # Scores are brought to the picture's size, not classes: the edge lies between pixels.
        height, width = picture.shape[:2]
        return np.asarray(cv2.resize(score, (width, height), interpolation=cv2.INTER_LINEAR) > 0.0)

    def _score(self, output: NDArray[np.generic]) -> Array:
        """(h, w) positive where the object is more likely than anything else."""
        if output.ndim not in (3, 4) or output.shape[0] != 1:
            raise SettingsError(
                f"{self._file}: its output has the shape {output.shape}, but must be (1, classes, "
                "height, width) or (1, height, width)"
            )
        layers = output[0] if output.ndim == 4 else output
        if not np.isfinite(layers.astype(np.float64)).all():
            raise SettingsError(
                f"{self._file}: its output is not finite; is the input as it must be?"
            )
        if len(layers) > 1:
            return self._best(layers.astype(np.float32))
        layer = layers[0]
        whole = np.issubdtype(layer.dtype, np.integer) or (layer == np.rint(layer)).all()
        if whole and layer.min() >= 0 and (self._classes or layer.max() > 1):
            chosen = layer > 0 if ALL in self._classes else np.isin(layer, self._numbers())
            return np.where(chosen, 0.5, -0.5).astype(np.float32)
        probable = layer.min() >= 0.0 and layer.max() <= 1.0
        return np.asarray(layer - (0.5 if probable else 0.0), dtype=np.float32)

    def _best(self, layers: Array) -> Array:
        """The object's best score less the others' best, of scores (classes, h, w)."""
        count = len(layers)
        numbers = range(1, count) if ALL in self._classes else self._numbers(count)
        mine = np.isin(np.arange(count), list(numbers))
        if mine.all():
            raise SettingsError(
                f"{self._file}: all of its {count} classes are said to be the object"
            )
        return np.asarray(layers[mine].max(axis=0) - layers[~mine].max(axis=0), dtype=np.float32)

    def _numbers(self, count: int | None = None) -> list[int]:
        """The chosen classes' numbers."""
        if not self._classes and count == 2:
            return [1]
        if not self._classes:
            known = f"{count} classes" if count else "several classes"
            raise SettingsError(
                f"{self._file}: has {known}; say which is the object: --class NUMBER"
            )
        numbers = [int(name) for name in self._classes]
        if count is not None and max(numbers) >= count:
            raise SettingsError(
                f"{self._file}: has the classes 0 to {count - 1}, not {max(numbers)}"
            )
        return numbers
