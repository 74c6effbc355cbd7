import subprocess
import sys

import numpy as np
from pydrake.geometry import RenderLabel
from pydrake.systems.sensors import ImageLabel16I

from drake_pose.silhouette.pictures.label_images import label_image_to_mask, mask_to_label_image

MASK = np.random.default_rng(0).random((20, 30)) < 0.3


def test_round_trip():
    image = mask_to_label_image(MASK)
    assert isinstance(image, ImageLabel16I)
    assert (image.width(), image.height()) == (30, 20)
    np.testing.assert_array_equal(label_image_to_mask(image), MASK)
    np.testing.assert_array_equal(label_image_to_mask(image.data), MASK)


def test_labels_can_be_chosen():
    labels = np.full((4, 5), int(RenderLabel.kEmpty), dtype=np.int16)
    labels[1, 2], labels[3, 3] = 7, 9
    assert np.argwhere(label_image_to_mask(labels)).tolist() == [[1, 2], [3, 3]]
    assert np.argwhere(label_image_to_mask(labels, [9])).tolist() == [[3, 3]]


def test_importing_the_room_loads_neither_numba_nor_drake():
    code = (
        "import sys, drake_pose.silhouette, drake_pose.camera;"
        "print([m for m in ('numba', 'pydrake', 'cv2') if m in sys.modules])"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"
