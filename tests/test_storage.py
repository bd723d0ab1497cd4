"""Tensors in files: what is written comes back, and what is damaged is refused in one sentence."""

import json
import math
import struct

import pytest
import torch
from safetensors.torch import load_file, save_file

from skyproof.errors import NotFiniteError, StoredFileError
from skyproof.storage import read_tensors, write_tensors

TENSORS = {
    "weights": torch.rand(2, 3, 4, 5, generator=torch.Generator().manual_seed(0)),
    "count": torch.tensor(7),
    "mask": torch.tensor([True, False]),
    "none": torch.zeros(0, 4),
}


def test_tensors_and_record_come_back(tmp_path):
    path = tmp_path / "new" / "x.safetensors"
    record = {"step": 3, "identity": {"names": ["T-U", "ä"], "rate": 0.1}, "best": None}
    write_tensors(path, TENSORS, record)
    tensors, read = read_tensors(path, "make it again")
    assert read == record
    assert tensors.keys() == TENSORS.keys()
    assert all(torch.equal(tensors[name], TENSORS[name]) for name in TENSORS)
    assert all(tensors[name].dtype == TENSORS[name].dtype for name in TENSORS)


def test_what_is_read_lies_in_memory_as_what_is_made(tmp_path):
    # Where it does not, a product of matrices differs in its last bit.
    tensors = {name: torch.ones(count) for name, count in (("a", 55), ("b", 3000), ("c", 7))}
    write_tensors(tmp_path / "x.safetensors", tensors)
    read, _ = read_tensors(tmp_path / "x.safetensors", "make it again")
    assert [tensor.data_ptr() % 64 for tensor in read.values()] == [0, 0, 0]


def test_without_a_record_the_bytes_are_those_of_safetensors_alone(tmp_path):
    write_tensors(tmp_path / "ours.safetensors", TENSORS)
    save_file(TENSORS, tmp_path / "theirs.safetensors")
    ours = (tmp_path / "ours.safetensors").read_bytes()
    assert ours == (tmp_path / "theirs.safetensors").read_bytes()
    assert read_tensors(tmp_path / "theirs.safetensors", "make it again")[1] == {}


def test_a_tensor_in_another_memory_layout_is_stored_plainly(tmp_path):
    weights = TENSORS["weights"].to(memory_format=torch.channels_last).requires_grad_()
    write_tensors(tmp_path / "x.safetensors", {"weights": weights})
    assert torch.equal(load_file(tmp_path / "x.safetensors")["weights"], TENSORS["weights"])


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda path: path.unlink(), "is missing"),
        (lambda path: path.write_bytes(b""), "is damaged"),
        (lambda path: path.write_bytes(path.read_bytes()[:-4]), "is damaged"),
        (lambda path: save_file(TENSORS, path, {"record": "{"}), "has a record that is not JSON"),
        (
            lambda path: save_file(TENSORS, path, {"record": "[1]"}),
            "has a record that cannot be used",
        ),
        (lambda path: save_file({"x": torch.tensor([math.nan])}, path), "holds numbers that are"),
    ],
)
def test_a_missing_or_damaged_file_is_refused_with_the_remedy(tmp_path, damage, said):
    path = tmp_path / "x.safetensors"
    write_tensors(path, TENSORS, {"step": 1})
    damage(path)
    with pytest.raises(StoredFileError, match=rf"x\.safetensors {said}.*; train it again\.$"):
        read_tensors(path, "train it again")


@pytest.mark.parametrize(
    ("tensors", "record"),
    [({"x": torch.tensor([1.0, math.inf])}, None), (TENSORS, {"score": math.nan})],
)
def test_numbers_that_are_not_finite_are_not_stored(tmp_path, tensors, record):
    path = tmp_path / "x.safetensors"
    with pytest.raises(NotFiniteError, match=r"x\.safetensors would hold"):
        write_tensors(path, tensors, record)
    assert not path.exists()


def test_a_type_that_torch_cannot_copy_is_one_sentence(tmp_path):
    header = {"a": {"dtype": "F4", "shape": [4], "data_offsets": [0, 2]}}
    text = json.dumps(header).encode()
    (tmp_path / "a.safetensors").write_bytes(struct.pack("<Q", len(text)) + text + b"\0\0")
    with pytest.raises(StoredFileError, match=r"a\.safetensors is damaged .*; copy it again"):
        read_tensors(tmp_path / "a.safetensors", "copy it again")


def test_small_floats_are_read_and_looked_through(tmp_path):
    path = tmp_path / "x.safetensors"
    save_file({"a": torch.ones(2).to(torch.float8_e4m3fn)}, path)
    assert read_tensors(path, "make it again")[0]["a"].float().tolist() == [1, 1]
    save_file({"a": torch.tensor([math.nan]).to(torch.float8_e4m3fn)}, path)
    with pytest.raises(StoredFileError, match="not finite"):
        read_tensors(path, "make it again")
