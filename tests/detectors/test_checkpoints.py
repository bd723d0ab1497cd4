"""Checkpoints of others: read as data, whatever they are wrapped in, and never run."""

from __future__ import annotations

import argparse
import os
import warnings
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from skyproof.detectors.checkpoints import StandIn, networks_in, read_checkpoint, state_of
from skyproof.errors import StoredFileError


def network_of(content: Any) -> Any:
    """The first network in what a checkpoint holds, or that itself."""
    return next(iter(networks_in(content).values()), content)


class Network(nn.Module):
    """A class that the reader is not to build."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Conv2d(3, 4, 3), nn.BatchNorm2d(4))
        self.register_buffer("fleeting", torch.ones(2), persistent=False)
        self.register_buffer("kept", torch.arange(3))
        self.names = {0: "car"}


class Evil:
    """Stored so that opening it calls a function."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> tuple:
        return self.call


def same(found: dict[str, torch.Tensor], wanted: dict[str, torch.Tensor]) -> bool:
    return found.keys() == wanted.keys() and all(
        torch.equal(found[name], wanted[name]) for name in wanted
    )


def begun_with(prefix: str, network: nn.Module) -> dict[str, torch.Tensor]:
    return {prefix + name: value for name, value in network.state_dict().items()}


@pytest.mark.parametrize(
    "wrap",
    [
        lambda network: network,
        lambda network: {"model": network, "epoch": 3},
        lambda network: {"ema": network, "model": None},
        lambda network: network.state_dict(),
        lambda network: {
            "state_dict": network.state_dict(),
            "args": argparse.Namespace(lr=1.0),
            "best": Path("x"),
        },
        lambda network: {
            "model": OrderedDict(
                (f"module.{key}", value) for key, value in network.state_dict().items()
            )
        },
        lambda network: begun_with("_orig_mod.module.", network),
        lambda network: begun_with("module._orig_mod.module.", network),
        lambda network: begun_with("module.", network) | {"n_averaged": torch.tensor(5)},
        lambda network: {
            name.replace("layers.0.", "layers.0._orig_mod."): value
            for name, value in network.state_dict().items()
        },
        lambda network: {"ema": {"module": network.state_dict(), "updates": torch.tensor(7)}},
        lambda network: {"ema": {"decay": 0.999}, "model": {"state_dict": network.state_dict()}},
        lambda network: {
            "optimizer": {"state": {0: {"step": torch.ones(1), "exp_avg": torch.ones(9)}}},
            "loss": nn.Linear(1, 1),
            "nets": {"detector": begun_with("module.", network)},
        },
    ],
)
def test_weights_are_found_in_every_usual_wrapping(wrap: Any, tmp_path: Path) -> None:
    network = Network()
    torch.save(wrap(network), tmp_path / "x.pt")
    assert same(state_of(network_of(read_checkpoint(tmp_path / "x.pt"))), network.state_dict())


@pytest.mark.parametrize("place", ["ema.module", "state_dict_ema", "model_ema", "swa"])
def test_averaged_weights_go_first_if_they_are_whole(place: str) -> None:
    plain = Network().state_dict()
    for whole in (True, False):
        averaged: Any = {name: value + 1 for name, value in list(plain.items())[not whole :]}
        for key in reversed(place.split(".")):
            averaged = {key: averaged}
        found = networks_in({"model": plain, "updates": torch.tensor(3), **averaged})
        assert list(found) == ([place, "model"] if whole else ["model"])


def test_content_that_holds_itself_ends() -> None:
    content: dict[str, Any] = {}
    for _ in range(60):
        content = {"a": content, "b": content}
    content["again"] = content
    assert networks_in(content) == {}


def test_attributes_and_class_names_stay_but_behaviour_does_not(tmp_path: Path) -> None:
    torch.save({"model": Network().half()}, tmp_path / "x.pt")
    found = network_of(read_checkpoint(tmp_path / "x.pt"))
    assert isinstance(found, StandIn)
    assert not isinstance(found, nn.Module)
    assert found.origin == f"{Network.__module__}.Network"
    assert vars(found)["names"] == {0: "car"}
    state = state_of(found)
    assert {tensor.dtype for tensor in state.values()} == {torch.float32, torch.int64}


def test_nothing_in_a_checkpoint_is_run(tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    for function, arguments in (
        (os.mkdir, (str(mark),)),
        (Path.mkdir, (mark,)),
        (eval, (f"open({str(mark)!r}, 'w')",)),
    ):
        torch.save(
            {"model": {"weight": torch.ones(1)}, "other": Evil(function, *arguments)},
            tmp_path / "x.pt",
        )
        try:
            content = read_checkpoint(tmp_path / "x.pt")
        except StoredFileError:
            # torch refuses modules such as os by name.
            content = {"model": {"weight": torch.ones(1)}, "other": StandIn()}
        assert isinstance(content["other"], StandIn)
        assert not mark.exists()
    # The same file does run where it is opened as usual: the test can fail.
    torch.load(tmp_path / "x.pt", weights_only=False)
    assert mark.exists()


def test_safetensors_and_the_form_of_before_2020(tmp_path: Path) -> None:
    state = {"a.weight": torch.rand(2, 3)}
    save_file(state, tmp_path / "x.safetensors")
    torch.save(state, tmp_path / "old.pth", _use_new_zipfile_serialization=False)
    for name in ("x.safetensors", "old.pth"):
        assert same(state_of(network_of(read_checkpoint(tmp_path / name))), state)


def test_what_is_no_checkpoint_is_refused(tmp_path: Path) -> None:
    for name, content in (
        ("x.pt", b"weights"),
        ("y.pt", b""),
        ("z.safetensors", b"12345678"),
        ("w.pt", b"PK\x03\x04"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(StoredFileError, match=f"{name} is not a checkpoint"):
            read_checkpoint(tmp_path / name)
    torch.save({"a": torch.rand(1000)}, tmp_path / "cut.pt")
    (tmp_path / "cut.pt").write_bytes((tmp_path / "cut.pt").read_bytes()[:2000])
    with pytest.raises(StoredFileError, match="not a checkpoint"):
        read_checkpoint(tmp_path / "cut.pt")
    with pytest.raises(StoredFileError, match="missing"):
        read_checkpoint(tmp_path / "none.pt")
    assert state_of(network_of({"epoch": 3})) == {}
    assert state_of(network_of([1, 2])) == {}


class Command:
    """Would run when it is unpickled in the usual way."""

    def __reduce__(self) -> Any:
        return os.system, ("true",)


def test_the_reader_never_advises_to_run_a_file(tmp_path: Path) -> None:
    torch.save({"a": Command()}, tmp_path / "x.pt", _use_new_zipfile_serialization=False)
    with pytest.raises(StoredFileError, match="more than tensors and plain values") as caught:
        read_checkpoint(tmp_path / "x.pt")
    assert "weights_only" not in str(caught.value)
    assert "\n" not in str(caught.value)
    torch.jit.save(torch.jit.script(nn.Linear(1, 1)), tmp_path / "script.pt")
    with pytest.raises(StoredFileError, match=r"compiled program.*to ONNX, which.*sp\.assess"):
        read_checkpoint(tmp_path / "script.pt")


def test_a_packed_archive_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    torch.save({"a": torch.zeros(10**6)}, tmp_path / "x.pt")
    with (
        zipfile.ZipFile(tmp_path / "x.pt") as plain,
        zipfile.ZipFile(tmp_path / "packed.pt", "w", zipfile.ZIP_DEFLATED) as packed,
    ):
        for name in plain.namelist():
            packed.writestr(name, plain.read(name))
    with pytest.raises(StoredFileError, match="packed archive"):
        read_checkpoint(tmp_path / "packed.pt")


def test_a_tensor_of_any_size_in_a_few_bytes_is_refused(tmp_path: Path) -> None:
    torch.save({"a": torch.zeros(1).expand(10**12)}, tmp_path / "x.pt")
    content = read_checkpoint(tmp_path / "x.pt")
    with pytest.raises(StoredFileError, match=r"tensor a claims the shape \[1000000000000\]"):
        state_of(network_of(content))


def test_a_network_that_holds_itself_is_refused() -> None:
    network = StandIn()
    network.__dict__["_modules"] = {"again": network}
    with pytest.raises(StoredFileError, match="holds itself"):
        state_of(network)
    # Each holds the next twice: few objects, and walks without end.
    last = StandIn()
    for _ in range(60):
        above = StandIn()
        above.__dict__["_modules"] = {"a": last, "b": last}
        last = above
    with pytest.raises(StoredFileError, match="parts, or holds itself"):
        state_of(last)


def test_many_names_of_the_same_bytes_take_no_memory(tmp_path: Path) -> None:
    half = torch.zeros(200_000, dtype=torch.half)
    torch.save({f"layer{number}": half for number in range(5)}, tmp_path / "tied.pt")
    tied = state_of(network_of(read_checkpoint(tmp_path / "tied.pt")))
    assert len(tied) == 5
    torch.save({f"layer{number}": half[:] for number in range(500)}, tmp_path / "many.pt")
    with pytest.raises(StoredFileError, match="500 tensors share 400,000 bytes"):
        state_of(network_of(read_checkpoint(tmp_path / "many.pt")))


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (lambda: torch.eye(3).to_sparse(), "is sparse"),
        (lambda: torch.zeros(3, device="meta"), "is without its numbers"),
        (lambda: torch.quantize_per_tensor(torch.zeros(3), 0.1, 0, torch.qint8), "is quantised"),
    ],
)
def test_tensors_of_other_kinds_are_refused(value: Any, words: str, tmp_path: Path) -> None:
    torch.save({"layer": value()}, tmp_path / "x.pt")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        content = read_checkpoint(tmp_path / "x.pt")
    with pytest.raises(StoredFileError, match=f"tensor layer {words}"):
        state_of(network_of(content))
