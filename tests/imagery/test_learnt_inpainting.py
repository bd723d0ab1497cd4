"""Networks that fill masks: ONNX serves, and whatever could run code or read files is refused."""

import pickle
import sys
import zipfile
from pathlib import Path

import pytest
import torch

from skyproof.errors import ConfigurationError, ImageryError
from skyproof.imagery.clearing.inpainting import apply_inpainting, inpainting_record
from skyproof.imagery.clearing.learnt_inpainting import LearntInpainting

onnx = pytest.importorskip("onnx", reason="needs the onnx extra")
pytest.importorskip("onnxruntime", reason="needs the onnx extra")

FLOAT = onnx.TensorProto.FLOAT
IMAGE = torch.randint(
    0, 256, (3, 50, 61), dtype=torch.uint8, generator=torch.Generator().manual_seed(0)
)
MASK = torch.zeros(50, 61, dtype=torch.bool)
MASK[10:20, 30:45] = True


def constant(name, values):
    """A tensor of a model."""
    return onnx.helper.make_tensor(name, FLOAT, [len(values)], values)


def write_model(path, nodes, *, constants=(), names=("image", "mask"), kind=FLOAT, opsets=()):
    """Writes a model of image and mask."""
    inputs = [
        onnx.helper.make_tensor_value_info(name, kind, [1, channels, "H", "W"])
        for name, channels in zip(names, (3, 1), strict=True)
    ]
    outputs = [onnx.helper.make_tensor_value_info("filled", FLOAT, None)]
    graph = onnx.helper.make_graph(nodes, "fill", inputs, outputs, list(constants))
    opsets = [onnx.helper.make_opsetid("", 17), *opsets]
    model = onnx.helper.make_model(graph, opset_imports=opsets, ir_version=8)
    path.write_bytes(model.SerializeToString())
    return path


def node(kind, inputs, outputs, **more):
    """An operator."""
    return onnx.helper.make_node(kind, inputs, outputs, **more)


def filling(path, value=0.6, **more):
    """Writes a network that fills with one value: image + mask * (value - image)."""
    nodes = [
        node("Sub", ["value", "image"], ["difference"]),
        node("Mul", ["mask", "difference"], ["change"]),
        node("Add", ["image", "change"], ["filled"]),
    ]
    return write_model(path, nodes, constants=[constant("value", [value])], **more)


def test_an_onnx_file_serves(tmp_path):
    learnt = LearntInpainting(filling(tmp_path / "network.onnx"))
    filled = apply_inpainting(learnt, IMAGE, MASK)
    assert (filled[:, MASK] == 153).all()
    assert torch.equal(filled[:, ~MASK], IMAGE[:, ~MASK])
    assert len(inpainting_record(learnt)["sha256"]) == 64


def test_sides_are_padded_to_multiples_of_eight(tmp_path):
    # The shape it gets is what it fills with: 56 x 64 of 50 x 61.
    nodes = [
        node("Shape", ["image"], ["shape"]),
        node("Cast", ["shape"], ["numbers"], to=FLOAT),
        node("Gather", ["numbers", "place"], ["height"]),
        node("Div", ["height", "hundred"], ["value"]),
        node("Mul", ["image", "zero"], ["nothing"]),
        node("Add", ["nothing", "value"], ["filled"]),
    ]
    place = onnx.helper.make_tensor("place", onnx.TensorProto.INT64, [1], [2])
    constants = [place, constant("hundred", [100.0]), constant("zero", [0.0])]
    learnt = LearntInpainting(write_model(tmp_path / "n.onnx", nodes, constants=constants))
    assert (apply_inpainting(learnt, IMAGE, MASK)[:, MASK] == round(0.56 * 255)).all()


def test_a_network_that_changes_the_size_is_refused(tmp_path):
    nodes = [node("MaxPool", ["image"], ["filled"], kernel_shape=[2, 2], strides=[2, 2])]
    learnt = LearntInpainting(write_model(tmp_path / "network.onnx", nodes))
    with pytest.raises(ImageryError, match=r"returned torch.float32 \(3, 28, 32\)"):
        apply_inpainting(learnt, IMAGE, MASK)


def test_a_network_that_fails_is_one_sentence(tmp_path):
    nodes = [node("MatMul", ["image", "image"], ["filled"])]
    learnt = LearntInpainting(write_model(tmp_path / "network.onnx", nodes))
    with pytest.raises(ImageryError, match="failed on a tile") as caught:
        apply_inpainting(learnt, IMAGE, MASK)
    assert "\n" not in str(caught.value)


class Canary:
    """What runs when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def pickled(path, canary):
    path.write_bytes(pickle.dumps(Canary(canary)))


def archived(path, canary):
    with zipfile.ZipFile(path, "w") as archive:
        for name in ("archive/data.pkl", "data/weights/weights_config.json", "archive/code/x.py"):
            archive.writestr(name, pickle.dumps(Canary(canary)))
        archive.writestr("archive/version", "3")


def saved(path, canary):
    torch.save(Canary(canary), path)


def scripted(path, canary):
    torch.jit.save(torch.jit.script(torch.nn.ReLU()), path)


@pytest.mark.parametrize("write", [pickled, archived, saved, scripted])
@pytest.mark.parametrize("name", ["network.pt2", "network.onnx"])
def test_nothing_in_a_pickle_runs(tmp_path, write, name):
    canary = tmp_path / "canary"
    write(tmp_path / name, canary)
    with pytest.raises(ImageryError, match=r"could run code and is not opened; export .* ONNX"):
        LearntInpainting(tmp_path / name)
    assert not canary.exists()


def test_weights_in_other_files_are_refused(tmp_path):
    secret = tmp_path / "secret"
    secret.write_bytes(b"\0" * 4)
    for location in (str(secret), "../secret", "secret"):
        raw = b"\0" * 4
        outside = onnx.helper.make_tensor("value", FLOAT, [1], raw, raw=True)
        onnx.external_data_helper.set_external_data(outside, location, 0, 4)
        outside.ClearField("raw_data")
        # In the graph, and in an operator of it.
        direct = [node("Add", ["image", "value"], ["filled"])]
        write_model(tmp_path / "direct.onnx", direct, constants=[outside])
        inner = [node("Constant", [], ["value"], value=outside), *direct]
        write_model(tmp_path / "inner.onnx", inner)
        for name in ("direct.onnx", "inner.onnx"):
            with pytest.raises(ImageryError, match="keeps weights in other files"):
                LearntInpainting(tmp_path / name)


def test_operators_of_others_are_refused(tmp_path):
    nodes = [node("Run", ["image"], ["filled"], domain="evil")]
    opsets = [onnx.helper.make_opsetid("evil", 1)]
    with pytest.raises(ImageryError, match=r"evil\.Run, which is not of the ONNX standard"):
        LearntInpainting(write_model(tmp_path / "network.onnx", nodes, opsets=opsets))


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"names": ("picture", "hole")}, r"other inputs \(picture: tensor\(float\), hole"),
        ({"kind": onnx.TensorProto.DOUBLE}, "other inputs|cannot be run"),
    ],
)
def test_a_network_of_another_signature_is_refused(tmp_path, more, words):
    first, second = more.get("names", ("image", "mask"))
    nodes = [node("Add", [first, second], ["sum"]), node("Cast", ["sum"], ["filled"], to=FLOAT)]
    with pytest.raises(ImageryError, match=words):
        LearntInpainting(write_model(tmp_path / "network.onnx", nodes, **more))


@pytest.mark.parametrize("content", [b"no network", b"", b"\x08\x08", b"\xff" * 100])
def test_a_file_that_is_no_network_is_refused(tmp_path, content):
    (tmp_path / "network.onnx").write_bytes(content)
    with pytest.raises(ImageryError, match=r"is no ONNX model|cannot be run as an ONNX model"):
        LearntInpainting(tmp_path / "network.onnx")
    with pytest.raises(ImageryError, match="is missing"):
        LearntInpainting(tmp_path / "other.onnx")


def test_a_missing_onnxruntime_is_one_sentence(tmp_path, monkeypatch):
    filling(tmp_path / "network.onnx")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ConfigurationError, match=r"pip install 'skyproof\[onnx\]'"):
        LearntInpainting(tmp_path / "network.onnx")
