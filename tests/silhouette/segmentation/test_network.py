"""Networks of one layer, made here, that tell blue from the rest."""

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from drake_pose.errors import SettingsError
from drake_pose.silhouette.pictures.masks import intersection_over_union
from drake_pose.silhouette.segmentation.network import SegmentationNetwork

SIZE = (80, 60)
WEIGHTS = np.array([[-1.0, -1.0, 3.0], [1.0, 1.0, -3.0], [0.0, 0.0, 0.0]], np.float32)
# The rows of the weights that are a network's layers, and what comes after them.
KINDS = {
    "scores": ([1, 0], []),
    "three": ([1, 2, 0], []),
    "logit": ([0], []),
    "probability": ([0], [helper.make_node("Sigmoid", ["y0"], ["y"])]),
    "classes": ([1, 2, 0], [helper.make_node("ArgMax", ["y0"], ["y"], axis=1, keepdims=0)]),
    "infinite": ([2], [helper.make_node("Log", ["y0"], ["y"])]),
    "a number": ([0], [helper.make_node("ReduceMean", ["y0"], ["y"], keepdims=0)]),
}


def network(path, kind):
    """Weighs the colours of every pixel: blue against the rest."""
    order, after = KINDS[kind]
    constant = numpy_helper.from_array(WEIGHTS[order][:, :, None, None], "W")
    first = helper.make_node("Conv", ["x", "W"], ["y0" if after else "y"], kernel_shape=[1, 1])
    graph = helper.make_graph(
        [first, *after],
        "blue",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 3, 60, 80])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, None, None, None])],
        [constant],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))
    return path


@pytest.fixture
def still():
    """A blue box with a hole before a yellow table, and the truth."""
    true = np.zeros((120, 160), bool)
    true[30:90, 40:110] = True
    true[50:60, 60:80] = False
    return np.where(true[:, :, None], (60, 80, 190), (200, 180, 70)).astype(np.uint8), true


@pytest.mark.parametrize(
    ("kind", "classes"),
    [
        ("scores", ()), ("three", ("2",)), ("three", ("2", "1")), ("three", ("all",)),
        ("logit", ()), ("probability", ()), ("classes", ("2",)), ("classes", ("all",)),
    ],
)  # fmt: skip
def test_the_object_is_found_by_every_kind_of_output(still, tmp_path, kind, classes):
    picture, true = still
    found = SegmentationNetwork(network(tmp_path / "n.onnx", kind), classes, SIZE).find(picture)
    assert intersection_over_union(found, true) > 0.92


def test_colours_are_brought_to_what_the_network_takes(still, tmp_path):
    """Twice blue less red and green, as shares of 255, is more than 0."""
    picture, true = still
    file = network(tmp_path / "n.onnx", "scores")
    swapped = SegmentationNetwork(file, size=SIZE, bgr=True).find(picture)
    assert intersection_over_union(swapped, ~true) > 0.95
    # Blue must be more than (its mean + red / 9 + green / 9) then, and is at 190 of 255.
    for mean, is_found in ((0.5, True), (0.75, False)):
        moved = SegmentationNetwork(file, size=SIZE, mean=(0, 0, mean), std=(3, 3, 1)).find(picture)
        assert (moved & true).any() == is_found
        assert not (moved & ~true).any()


@pytest.mark.parametrize("held", ["beside", "outside", "outside, in a node's graph"])
def test_a_network_reads_no_file_of_another_folder(still, tmp_path, held):
    picture, true = still
    (tmp_path / "net").mkdir()
    file = network(tmp_path / "net" / "net.onnx", "scores")
    model = onnx.load(str(file))
    (tensor,) = model.graph.initializer
    location = "weights.bin" if held == "beside" else "../weights.bin"
    (file.parent / location).write_bytes(tensor.raw_data)
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value=location)
    if "node" in held:
        hidden = helper.make_graph([], "hidden", [], [], [tensor])
        model.graph.node.append(helper.make_node("If", ["x"], ["z"], then_branch=hidden))
        model.graph.ClearField("initializer")
    file.write_bytes(model.SerializeToString())
    if held == "beside":
        found = SegmentationNetwork(file, size=SIZE).find(picture)
        assert intersection_over_union(found, true) > 0.95
    else:
        with pytest.raises(SettingsError, match=r"net\.onnx.*another folder, '\.\./weights\.bin'"):
            SegmentationNetwork(file, size=SIZE)


@pytest.mark.parametrize(
    ("kind", "change", "words"),
    [
        ("three", {"classes": ()}, "3 classes; say which"),
        ("three", {"classes": ("3",)}, "classes 0 to 2, not 3"),
        ("three", {"classes": ("robot",)}, "numbers, not 'robot'"),
        ("three", {"classes": ("0", "1", "2")}, "all of its 3 classes"),
        ("three", {"std": (1.0, 0.0, 1.0)}, "must be positive"),
        ("three", {"file": "none.onnx"}, "no such network"),
        ("three", {"file": "picture.png"}, r"picture\.png: OpenCV cannot read this network"),
        ("three", {"file": "cut.onnx"}, r"cut\.onnx: cannot be read, or is no ONNX file"),
        ("three", {"size": (0, 60)}, "width and a height of 1 to"),
        ("three", {"size": (1_000_000, 60)}, "width and a height of 1 to"),
        ("classes", {"classes": ()}, "several classes; say which"),
        ("infinite", {"classes": ()}, "not finite"),
        ("a number", {"classes": ()}, r"has the shape .*must be \(1, classes"),
    ],
)
def test_networks_that_do_not_fit_are_refused(still, tmp_path, kind, change, words):
    network(tmp_path / "net.onnx", kind)
    (tmp_path / "picture.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    (tmp_path / "cut.onnx").write_bytes(b"\x3a\xff")
    values = {"file": "net.onnx", "classes": ("2",), "size": SIZE} | change
    values["file"] = tmp_path / values["file"]
    with pytest.raises(SettingsError, match=words):
        SegmentationNetwork(**values).find(still[0])
