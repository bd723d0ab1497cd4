"""The resumable loop: what it stores, where it goes on, and whose folders it refuses."""

import json

import pytest
import torch
from torch.optim.lr_scheduler import LambdaLR

from skyproof.errors import RunFolderError, StoredFileError
from skyproof.loop import CHECKPOINT, Loop, refuse_other
from skyproof.storage import read_tensors


class Tally:
    """A part without tensors of its own at the start."""

    def __init__(self):
        self.best = {}

    def state_dict(self):
        return {"best": self.best, "kept": {"0": torch.tensor(1.5)} if self.best else {}}

    def load_state_dict(self, state):
        self.best = state["best"]
        assert state["kept"].keys() == ({"0"} if self.best else set())


def made(folder, steps=7, every=3, identity=None, on_row=None):
    """A loop around a small network, its optimiser and its schedule."""
    network = torch.nn.Linear(3, 2)
    with torch.no_grad():
        network.weight.fill_(0.5)
        network.bias.fill_(0.1)
    optimiser = torch.optim.Adam(network.parameters(), lr=0.1)
    schedule = LambdaLR(optimiser, lambda step: 1 / (1 + step))
    parts = {
        "network": network,
        "optimiser": optimiser,
        "schedule": schedule,
        "tally": Tally(),
        "nothing": torch.nn.Identity(),
    }
    identity = {"name": "x", "sizes": (1, 2)} if identity is None else identity
    return Loop(
        folder, identity, steps, every, parts, "a run with other settings", "run it again", on_row
    )


def run(loop):
    """Steps that depend on their number alone."""
    loop.resume()
    loop.facts.setdefault("first", loop.step)
    parts = loop.parts
    for step in loop:
        draw = torch.rand(4, 3, generator=torch.Generator().manual_seed(step))
        parts["optimiser"].zero_grad()
        parts["network"](draw).square().mean().backward()
        parts["optimiser"].step()
        loop.report({"step": step, "rate": parts["schedule"].get_last_lr()[0]})
        parts["schedule"].step()
        parts["tally"].best = {"step": step}
    return loop


def rows(folder):
    lines = (folder / "steps.jsonl").read_text().splitlines()
    return [(row["step"], row["rate"]) for row in map(json.loads, lines)]


@pytest.mark.parametrize("last", [1, 2, 3, 4, 6, 7])
def test_a_stopped_loop_goes_on_to_the_same_bits(tmp_path, last):
    whole = run(made(tmp_path / "whole"))

    def stop(row):
        if row["step"] == last:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(made(tmp_path / "stopped", on_row=stop))
    if last < 7:
        # As a kill between the two files leaves it.
        with (tmp_path / "stopped" / "steps.jsonl").open("a") as file:
            file.write(json.dumps({"step": last + 1, "rate": 9.0}) + "\n")
    seen = []
    resumed = made(tmp_path / "stopped", on_row=lambda row: seen.append(row["step"]))
    with torch.no_grad():
        resumed.parts["network"].weight.fill_(7.0)
    run(resumed)
    assert seen == list(range((last if last == 7 else last // 3 * 3) + 1, 8))
    assert torch.equal(whole.parts["network"].weight, resumed.parts["network"].weight)
    assert resumed.parts["tally"].best == {"step": 7}
    assert resumed.facts == {"first": 0}
    assert rows(tmp_path / "whole") == [(step, 0.1 * (1 / step)) for step in range(1, 8)]
    assert rows(tmp_path / "stopped") == rows(tmp_path / "whole")


def test_checkpoints_come_before_the_first_step_and_after_every_few(tmp_path):
    stored = []
    for step in (loop := made(tmp_path)):
        stored.append((step, read_tensors(tmp_path / CHECKPOINT, "")[1]["step"]))
        loop.report({"step": step})
    assert stored == [(1, 0), (2, 0), (3, 0), (4, 3), (5, 3), (6, 3), (7, 6)]
    assert read_tensors(tmp_path / CHECKPOINT, "")[1]["step"] == 7
    assert {path.name for path in tmp_path.iterdir()} == {CHECKPOINT, "steps.jsonl"}
    loop.forget()
    assert {path.name for path in tmp_path.iterdir()} == {"steps.jsonl"}


def test_folders_of_others_are_refused_and_left_alone(tmp_path):
    run(made(tmp_path / "run"))
    with pytest.raises(RunFolderError, match="holds a run with other settings"):
        run(made(tmp_path / "run", identity={"name": "y"}))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("precious")
    with pytest.raises(RunFolderError, match=r"thesis\.tex"):
        run(made(tmp_path / "mine"))
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize("damage", ["cut", "other network", "no record"])
def test_a_damaged_checkpoint_is_one_sentence(tmp_path, damage):
    run(made(tmp_path))
    path = tmp_path / CHECKPOINT
    loop = made(tmp_path)
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:300])
    elif damage == "other network":
        loop.parts["network"] = torch.nn.Linear(5, 5)
    else:
        loop.parts["more"] = torch.nn.Linear(1, 1)
    with pytest.raises(StoredFileError, match="run it again"):
        loop.resume()


def test_an_identity_is_compared_as_json_has_it(tmp_path):
    refuse_other(tmp_path, {"sizes": [1, 2]}, {"sizes": (1, 2)}, "another run")
    for stored in (None, [], {"sizes": [1, 3]}):
        with pytest.raises(RunFolderError, match="holds another run; choose another --out"):
            refuse_other(tmp_path, stored, {"sizes": (1, 2)}, "another run")
