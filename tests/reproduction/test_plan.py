"""What a preset expands to: names by hand, and the same jobs in Snakemake's eyes."""

import json
import os
import re
import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import pytest

from skyproof.assessment.run import Step
from skyproof.camouflage.name import CamouflageName
from skyproof.cli.ground import Ground
from skyproof.errors import ConfigurationError, RunFolderError
from skyproof.main import run
from skyproof.ranges import Fraction
from skyproof.reproduction.__main__ import COMMANDS
from skyproof.reproduction.jobs import Jobs
from skyproof.reproduction.plan import Plan, plan_of_run, reproduction_plan
from skyproof.reproduction.preset import PRESETS, Preset, WorldSizes, read_preset
from skyproof.reproduction.snakemake import SNAKEFILE, output_of, shell_line
from skyproof.reproduction.steps import command_step
from skyproof.scenes.weather import CONDITIONS

TINY_FILE = Path(__file__).with_name("tiny.json")
TINY = json.loads(TINY_FILE.read_text())
BLENDER = Path("/blender")


def jobs(**changes):
    return Jobs(Preset.parse({**TINY, **changes}))


def read(preset):
    return json.loads(PRESETS[preset].read_text())


def plan_of(preset, **more):
    """The plan of a preset, as a step of its own sees it in the run folder."""
    return reproduction_plan(Preset.parse(preset), Path(), **more)


def test_tiny_by_hand():
    tiny = jobs()
    assert list(tiny.attacks) == ["T-Fc-0", "S-O@0.4-0", "C-Fc-seq@0.4-0", "C-Fc-par@0.4-0"]
    assert tiny.controls == ("R-Fc-0", "R-S-O@0.4-0", "R-C-Fc@0.4-0")
    texture = tiny.attacks["T-Fc-0"]
    assert texture.texture is None
    assert texture.settings.steps == 8
    sequential = tiny.attacks["C-Fc-seq@0.4-0"]
    assert sequential.texture == "T-Fc-0"
    # Random controls are scored by themselves: they wait for no attack.
    assert tiny.batches["000"] == tiny.controls
    assert list(tiny.batches) == ["000", "001"]
    assert len(tiny.batches["001"]) == 4


def test_on_cycles_are_finished_attacks_and_controls_alone():
    assert jobs().cycles_batches == {
        "000": ("R-Fc-0", "R-S-O@0.4-0", "R-C-Fc@0.4-0"),
        "001": ("T-Fc-0", "S-O@0.4-0", "C-Fc-seq@0.4-0", "C-Fc-par@0.4-0"),
    }
    # One more step for the original images, and one for each batch; only where they are asked for.
    without = reproduction_plan(Preset.parse(TINY), Path())
    plan = reproduction_plan(Preset.parse(TINY), Path(), blender=BLENDER)
    added = {step.id for step in plan.steps} - {step.id for step in without.steps}
    assert added == {"render/test-cycles", "score/cycles-000", "score/cycles-001"}
    assert plan.steps[-1].id == "report/report"
    # No transfers.
    wide = jobs(detectors=["retinanet", "faster_rcnn"], textures=["U"], transfer=["T-U"])
    assert wide.cycles_batches["001"] == ("T-U-0", "S-O@0.4-0", "C-U-seq@0.4-0")
    # The first repeats and draws of each.
    more = {"textures": ["U"], "repeats": 3, "draws": 4, "cycles_repeats": 2, "score_batch": 16}
    # A quarter of a batch of the renderer, so that no core waits long for another at the end.
    assert jobs(**more).cycles_batches == {
        "000": ("R-U-0", "R-U-1", "R-S-O@0.4-0", "R-S-O@0.4-1"),
        "001": ("R-C-U@0.4-0", "R-C-U@0.4-1"),
        "002": ("T-U-0", "S-O@0.4-0", "C-U-seq@0.4-0", "T-U-1"),
        "003": ("S-O@0.4-1", "C-U-seq@0.4-1"),
    }


def test_the_cycles_column_has_more_of_the_headlines():
    more = {"textures": ["U", "Ma"], "magnitudes": [], "repeats": 3, "draws": 5, "best_of": 4}
    batches = jobs(**more, cycles_headlines=["T-Ma"], score_batch=50).cycles_batches
    # As many draws as repeats, and what was chosen; of all else the first.
    assert batches == {
        "000": ("R-U-0", "R-Ma-0", "R-Ma-1", "R-Ma-2"),
        "001": (
            *("T-U-0", "T-Ma-0", "T-Ma-1", "T-Ma-2"),
            *("R-Ma_plain", "R-Ma_best", "R-Ma_search", "R-Ma_pattern"),
        ),
    }
    for wrong in ("R-U", "T-U-0", "T-U_on_yolov5"):
        with pytest.raises(ConfigurationError, match=f"cycles_headlines expects .* '{wrong}'"):
            Preset.parse({**TINY, "cycles_headlines": [wrong]})


def test_controls_are_chosen_and_shapes_drawn_on_learnt_textures():
    none = jobs()
    assert (none.chosen, none.shapes) == ({}, {})
    more = {"textures": ["Fc"], "repeats": 2, "draws": 5, "best_of": 7}
    own = jobs(**more, detectors=["retinanet", "faster_rcnn"], transfer=["T-Fc"])
    # One of each for all repeats, and none for attacks on some detectors alone.
    assert list(own.chosen) == [
        *("R-U_plain", "R-Fc_best", "R-Fc_search", "R-U_pattern"),
        *("R-S-O@0.4_plain", "R-S-O@0.4_best", "R-S-O@0.4_search"),
        *("R-C-U@0.4_plain", "R-C-Fc@0.4_best", "R-C-Fc@0.4_search"),
    ]
    searched = jobs(**more, searches=2, seed=3)
    repeats = ("R-Fc_search-0", "R-Fc_search-1")
    assert [name for name in searched.chosen if name.startswith("R-Fc_search")] == [*repeats]
    assert [searched.chosen[name].settings.seed for name in repeats] == [3, 4]
    # As many steps as texture and shape of the sequential attack together, more than the parallel.
    steps = {name: job.settings.steps for name, job in own.chosen.items()}
    assert steps["R-Fc_search"] == 8
    assert steps["R-C-Fc@0.4_search"] == 8 + 2
    assert {job.best_of for job in own.chosen.values()} == {7}
    assert {job.detectors for job in own.chosen.values()} == {("retinanet", "faster_rcnn")}
    assert own.shapes == {
        "T-Fc-0": ["R-C-Fc-seq@0.4-0", "R-C-Fc-seq@0.4-2", "R-C-Fc-seq@0.4-4"],
        "C-Fc-par@0.4-0": ["R-C-Fc-par@0.4-0", "R-C-Fc-par@0.4-2", "R-C-Fc-par@0.4-4"],
        "T-Fc-1": ["R-C-Fc-seq@0.4-1", "R-C-Fc-seq@0.4-3"],
        "C-Fc-par@0.4-1": ["R-C-Fc-par@0.4-1", "R-C-Fc-par@0.4-3"],
    }
    scored = {folder for batch in own.batches.values() for folder in batch}
    assert {*own.chosen, *own.shapes["T-Fc-0"]} <= scored
    plan = reproduction_plan(Preset.parse({**TINY, **more}), Path("run"))
    drawn = next(step for step in plan.steps if step.id == "control/shapes-T-Fc-1")
    assert drawn.settings.texture == Path("run/camouflages/T-Fc-1")
    assert Path("run/camouflages/T-Fc-1/camouflage.json") in drawn.inputs
    (best,) = (step for step in plan.steps if step.id == "choose/R-Fc_best")
    assert best.settings.draws == 7


def test_features_are_stored_of_a_texture_its_control_and_a_plain_paint():
    more = {"textures": ["Ma"], "repeats": 2, "draws": 2, "best_of": 7, "score_batch": 6}
    plan = reproduction_plan(Preset.parse({**TINY, **more, "features": ["T-Ma"]}), Path("run"))
    (asked,) = (step for step in plan.steps if step.kind == "features")
    worn = [folder.name for folder in asked.settings["camouflages"]]
    assert worn == ["R-Ma-0", "T-Ma-0", "R-Ma_plain"]
    assert asked.outputs[0] in plan.steps[-1].inputs
    plain = reproduction_plan(Preset.parse(TINY), Path(), blender=BLENDER)
    assert not [step for step in plain.steps if step.kind == "features"]
    for wrong in ("R-U", "S-O@0.4", "T-U-0"):
        with pytest.raises(ConfigurationError, match=f"features expects optimised .* '{wrong}'"):
            Preset.parse({**TINY, "features": [wrong]})


def test_weather_is_learnt_in_and_judged_apart():
    more = {"textures": ["U", "Fc"], "repeats": 2, "draws": 3, "magnitudes": [], "score_batch": 4}
    preset = Preset.parse({**TINY, **more, "weather": ["T-U"], "weather_images": 7})
    own = Jobs(preset)
    learnt = own.attacks["T-U_weather-1"]
    clear = own.attacks["T-U-1"]
    # The same but for the weather.
    assert learnt.conditions == tuple(CONDITIONS)
    assert clear.conditions == own.attacks["T-Fc-0"].conditions == ("clear",)
    assert (learnt.settings, learnt.detectors) == (clear.settings, clear.detectors)
    assert own.weather_batches == {
        "000": ("R-U-0", "R-U-1", "R-U-2"),
        "001": ("T-U-0", "T-U_weather-0", "T-U-1", "T-U_weather-1"),
    }
    # It is scored on clear days, too, and has the control of its texture.
    assert "T-U_weather-0" in {name for batch in own.batches.values() for name in batch}
    assert not any("weather" in name for name in own.controls)
    plan = reproduction_plan(preset, Path("run"), blender=BLENDER)
    steps = {step.id: step for step in plan.steps}
    assert steps["attack/T-U_weather-0"].settings.conditions == tuple(CONDITIONS)
    drawn = steps["scenes/weather"].settings
    usual = steps["scenes/test"].settings
    assert set(drawn["settings"].conditions) == {*CONDITIONS} - {"clear"}
    # But for the weather they are the usual scenes.
    assert replace(drawn["settings"], conditions=("clear",)) == usual["settings"]
    assert (drawn["seed"], drawn["split"], drawn["count"]) == (usual["seed"], "test", 7)
    scored = steps["score/weather-001"]
    assert scored.outputs == (Path("run/weather/scores/001"),)
    assert scored.settings.original == Path("run/datasets/weather")
    assert set(scored.outputs) <= set(plan.steps[-1].inputs)
    assert Jobs(Preset.parse(TINY)).weather_batches == {}
    with pytest.raises(ConfigurationError, match="weather names T-Pix, but textures has no Pix"):
        Preset.parse({**TINY, "weather": ["T-Pix"]})


def test_textures_with_more_repeats_than_the_rest():
    more = {"textures": ["U", "Fc"], "repeats": 2, "draws": 2, "texture_repeats": {"U": 4}}
    wide = jobs(**more, magnitudes=[], transfer=["T-U"], detectors=["retinanet", "faster_rcnn"])
    free = [name for name in wide.attacks if name.startswith("T-U")]
    assert free == [
        *("T-U-0", "T-U_on_retinanet-0", "T-U_on_faster_rcnn-0"),
        *("T-U-1", "T-U_on_retinanet-1", "T-U_on_faster_rcnn-1"),
        *("T-U-2", "T-U-3"),
    ]
    assert wide.attacks["T-U-3"].settings.seed == 3
    assert [name for name in wide.attacks if name.startswith("T-Fc")] == ["T-Fc-0", "T-Fc-1"]
    # All textures are looked at, learnt and drawn.
    drawn = ("R-U-0", "R-U-1", "R-Fc-0", "R-Fc-1")
    learnt = tuple(name for name in wide.attacks if name.startswith("T-"))
    assert wide.looked_at == (*learnt, *drawn)
    plan = reproduction_plan(Preset.parse({**TINY, **more}), Path("run"))
    looks = next(step for step in plan.steps if step.id == "looks/looks")
    assert Path("run/camouflages/T-U-3/camouflage.json") in looks.inputs
    assert looks.outputs[0] in plan.steps[-1].inputs
    with pytest.raises(ConfigurationError, match="texture_repeats expects at least the 2 repeats"):
        jobs(repeats=2, texture_repeats={"U": 1})


def test_repeats_seeds_transfer_and_masked():
    wide = jobs(
        seed=7, detectors=["retinanet", "faster_rcnn", "yolov5"], textures=["U", "PixFcMa"],
        repeats=2, draws=2,
        transfer=["T-U"], magnitudes=[0.5, 1.0], combined_magnitudes={"PixFcMa": [0.2]},
        score_batch=4, control_magnitude=0.5,
        attack_steps={"texture": 10, "shape": 5, "sequential": 6, "parallel": 6},
    )  # fmt: skip
    first = [
        "T-U", "T-PixFcMa", "T-U_on_retinanet", "T-U_on_faster_rcnn", "T-U_on_yolov5",
        "T-U_without_retinanet", "T-U_without_faster_rcnn", "T-U_without_yolov5",
        "S-O@0.5", "S-O@1", "C-U-seq@0.5", "C-U-seq@1", "C-PixFcMa-seq@0.2",
    ]  # fmt: skip
    assert list(wide.attacks) == [f"{name}-{repeat}" for repeat in (0, 1) for name in first]
    assert {wide.attacks[f"{name}-1"].settings.seed for name in first} == {8}
    assert wide.attacks["T-U_without_faster_rcnn-0"].detectors == ("retinanet", "yolov5")
    assert wide.attacks["C-PixFcMa-seq@0.2-1"].texture == "T-PixFcMa-1"
    scored = [folder for batch in wide.batches.values() for folder in batch]
    assert len(scored) == len(set(scored)) == 26 + 2 * (2 + 2 + 2 + 1)
    assert [len(batch) for batch in wide.batches.values()] == [4, 4, 4, 2] + [4] * 6 + [2]
    # Two detectors: all but one is the other one, which is there already.
    pair = jobs(detectors=["retinanet", "faster_rcnn"], transfer=["T-U"])
    on_one = [name for name in pair.attacks if "_" in name]
    assert on_one == ["T-U_on_retinanet-0", "T-U_on_faster_rcnn-0"]


@pytest.mark.parametrize("preset", PRESETS)
def test_every_name_can_be_made_and_has_its_control(preset):
    settings = Preset.parse(read(preset))
    full = Jobs(settings)
    attacks = {CamouflageName.parse(name): job for name, job in full.attacks.items()}
    textures = {name.pooled for name in attacks if name.kind == "texture" and not name.variant}
    # All of the paper's, but of detectors that are to be shipped only what is told of them.
    count = 2 if preset == "reference" else 12
    assert len(textures) == len(set(settings.textures)) == count
    controls = {CamouflageName.parse(name) for name in full.controls}
    assert all(name.random for name in controls)
    pooled = {name.pooled for name in controls}
    for name, job in attacks.items():
        assert not name.random
        assert (name.order == "seq") == (job.texture is not None)
        assert name.control in pooled
    # One attack of each is enough to say what a detector is like, and too little for a table.
    assert settings.repeats >= (1 if preset == "reference" else 3)
    assert settings.draws >= 3


@pytest.mark.parametrize("reference", [[], ["retinanet"]])
def test_images_to_train_on_are_drawn_where_something_is_trained(reference):
    changes = {"detectors": ["retinanet"], "reference": reference}
    plan = reproduction_plan(Preset.parse({**TINY, **changes}), Path())
    drawn = {step.name for step in plan.steps if step.kind == "render"}
    assert drawn == ({"test", "empty"} if reference else {"train", "validation", "test", "empty"})


@pytest.mark.parametrize("blur_sigma_px", [None, 1.25, "paper"])
def test_a_preset_says_how_sharp_vehicles_are(blur_sigma_px):
    plan = reproduction_plan(Preset.parse({**TINY, "blur_sigma_px": blur_sigma_px}), Path())
    (ground,) = (step.settings for step in plan.steps if isinstance(step.settings, Ground))
    assert ground.blur_sigma_px == blur_sigma_px
    with pytest.raises(ConfigurationError, match="paper"):
        Preset.parse({**TINY, "blur_sigma_px": "sharp"})


def test_a_preset_says_where_vehicles_stand():
    world = {**TINY["world"], "training_places": "removed", "test_places": "drivable"}
    plan = reproduction_plan(Preset.parse({**TINY, "world": world}), Path())
    drawn = {
        step.name: step.settings["settings"]
        for step in plan.steps
        if step.kind == "scenes" and step.name != "empty"
    }
    assert {split: settings.places for split, settings in drawn.items()} == {
        "train": "removed",
        "validation": "removed",
        "test": "drivable",
    }
    # Rows of parked vehicles are for uniform places, which are the default.
    assert drawn["train"].parked_share == drawn["train"].shaded_share == 0
    assert WorldSizes().scenes("train").parked_share == 0.5
    learnt = [step.settings for step in plan.steps if step.kind == "attack"]
    assert {command.places for command in learnt} == {"drivable"}
    for split in ("train", "validation", "test"):
        assert WorldSizes().scenes(split).places == "uniform"
    with pytest.raises(ConfigurationError, match="roofs"):
        Preset.parse({**TINY, "world": {**world, "test_places": "roofs"}})


def test_a_threshold_is_frozen_on_scenes_like_those_of_training_and_measured_on_clear_days():
    world = WorldSizes(empty_share=0.3, shaded_share=0.4)
    frozen_on = replace(world.scenes("train"), empty_share=0.5)
    assert world.scenes("validation") == frozen_on
    assert world.scenes("train").empty_share == 0.3
    assert world.scenes("train").shaded_share == 0.4
    usual = world.scenes("test")
    assert (usual.empty_share, usual.shaded_share, usual.conditions) == (0, 0, ("clear",))


@cache
def whole_plan(preset, cycles):
    return plan_of(read(preset), blender=BLENDER if cycles else None)


@pytest.mark.parametrize("preset", PRESETS)
def test_every_step_comes_after_what_it_needs(preset):
    steps = whole_plan(preset, True).steps
    made = set()
    needed = set()
    for step in steps:
        assert set(step.inputs) <= made
        made |= set(step.outputs)
        needed |= set(step.inputs)
    # What nothing needs is what the user reads.
    assert made - needed == set(steps[-1].outputs)


def step(name, outputs, settings=None, **more):
    return Step("kind", name, tuple(outputs), print, settings or {}, **more)


def test_a_step_needs_what_its_settings_name():
    texture = step("texture", [Path("camouflages/T-U/camouflage.json")], growing=True)
    fleets = step("fleets", [Path("fleets")])
    named = {"camouflages": (Path("camouflages/T-U"),), "fleet": Path("fleets/test")}
    score = step("score", [Path("scores")], named | {"out": Path("scores"), "seed": 0})
    assert Plan([texture, fleets, score]).steps[-1].inputs == (*texture.outputs, *fleets.outputs)
    with pytest.raises(RunFolderError, match="kind/fleets"):
        Plan([fleets, fleets])


def test_finished_is_what_left_its_outputs(tmp_path):
    needed = tmp_path / "needed"
    outputs = [tmp_path / "one", tmp_path / "two"]
    kept = step("kept", outputs, inputs=(needed,))
    renewed = step("renewed", outputs, inputs=(needed,), renewed=True)
    outputs[0].touch()
    assert not kept.is_finished()
    outputs[1].touch()
    for age, path in enumerate([needed, *outputs]):
        if path.exists():
            os.utime(path, (1000 + age, 1000 + age))
    assert kept.is_finished()
    assert renewed.is_finished()
    needed.touch()
    assert kept.is_finished()
    assert not renewed.is_finished()


def test_what_most_steps_wait_for_comes_first(tmp_path):
    plan = plan_of(TINY)
    waiting = plan.waiting
    # All that comes after, at second hand, too: the report waits for all, and nothing for it.
    assert waiting["report/report"] == 0
    assert waiting["score/001"] == 1
    # The sequential attack on it, its scores, its picture, the report.
    assert waiting["attack/T-Fc-0"] == 4
    # Every attack, two batches of scores, pictures, the report.
    assert waiting["train/retinanet"] == 4 + 2 + 1 + 1
    _, said = dry_run(tmp_path, TINY_FILE)
    rules = re.findall(r"^rule ([a-z]+)_(\d+):((?:\n    .*)+)", said, re.MULTILINE)
    told = {}
    for _, number, lines in rules:
        priority = re.search(r"priority: (\d+)", lines)
        told[plan.steps[int(number)].id] = int(priority[1]) if priority else 0
    assert told == waiting


def dry_run(folder, preset, *more):
    """Snakemake's steps by kind, and all it says."""
    shutil.copyfile(preset, folder / "config.json")
    command = [sys.executable, "-m", "snakemake", "--snakefile", SNAKEFILE, "--directory", folder]
    command += ["--dry-run", "--printshellcmds", "--cores", "2", "--rerun-triggers", "mtime"]
    done = subprocess.run([*command, *more], capture_output=True, text=True)
    said = done.stdout + done.stderr
    assert done.returncode == 0, said
    # The table may be printed twice; every step is a rule of its own.
    rules = dict(re.findall(r"^([a-z]+(?:_\d+)?) +(\d+)$", said, re.MULTILINE))
    counts = Counter()
    for rule, count in rules.items():
        counts[rule.partition("_")[0]] += int(count)
    return counts, said


@pytest.mark.parametrize(("preset", "cycles"), [("quick", True), ("reference", False)])
def test_snakemake_sees_the_same_steps_and_no_cycle(preset, cycles, tmp_path):
    counted, _ = dry_run(
        tmp_path, PRESETS[preset], *(["--config", "blender=/blender"] if cycles else [])
    )
    plan = whole_plan(preset, cycles)
    assert counted == {
        **Counter(step.kind for step in plan.steps),
        "all": 1,
        "total": len(plan.steps) + 1,
    }


@pytest.mark.parametrize("preset", ["quick", "reference"])
def test_cycles_adds_steps_and_changes_none_but_the_report(preset):
    plain, more = (whole_plan(preset, cycles) for cycles in (False, True))
    added = {step.id: step for step in more.steps}
    assert len(added) > len(plain.steps)
    for step in plain.steps:
        if step.kind != "report":
            assert added[step.id] == step


def test_snakemake_takes_no_report_away_that_is_to_be_renewed():
    # Tables without the results beside them are taken for somebody else's, and refused.
    report = plan_of(TINY).steps[-1]
    kept = output_of(report, str, lambda path: f"kept {path}")
    assert kept == ["kept results.json", "kept report.html"]


def test_each_step_is_done_by_its_name(tmp_path, monkeypatch, capsys):
    _, said = dry_run(tmp_path, TINY_FILE, "--config", "blender=/opt/my blender/python")
    words = "-m skyproof.reproduction step score/cycles-001 '--blender=/opt/my blender/python'"
    assert f"{sys.executable} {words} > logs/score/cycles-001.log 2>&1\n" in said
    monkeypatch.chdir(tmp_path)
    assert run(["step", "vehicles/fleets", "--device=cpu"], commands=COMMANDS) == 0
    assert (tmp_path / "fleets" / "test").is_dir()
    # Without a Blender there is no Cycles column.
    assert run(["step", "score/cycles-001"], commands=COMMANDS) == 2
    assert "has no step 'score/cycles-001'" in capsys.readouterr().err


def test_a_step_on_cycles_finds_its_blender_and_files(tmp_path, monkeypatch):
    shutil.copyfile(TINY_FILE, tmp_path / "config.json")
    monkeypatch.chdir(tmp_path)
    plan = plan_of_run("cpu", "/opt/my blender/python")
    drawn, *_, attacks = (
        step.settings
        for step in plan.steps
        if getattr(step.settings, "renderer", "torch") == "cycles"
    )
    assert drawn.blender == Path("/opt/my blender/python")
    assert drawn.workers == 1
    assert drawn.scenes == Path("scenes/test.jsonl")
    assert drawn.out == attacks.original == Path("datasets/test-cycles")
    assert attacks.out == Path("scores/cycles-001")
    assert Path("camouflages/T-Fc-0") in attacks.camouflages
    assert not [folder for folder in attacks.camouflages if "snapshots" in str(folder)]
    assert {step.settings.device for step in plan.steps if step.kind == "score"} == {"cpu"}


@pytest.mark.slow
def test_snakemake_looks_at_waiting_steps_when_one_ends_and_not_between(tmp_path):
    config = tmp_path / "config.json"
    config.write_text(TINY_FILE.read_text())
    command = [sys.executable, "-m", "snakemake", "--snakefile", SNAKEFILE, "--verbose"]
    command += ["--directory", tmp_path, "--cores", "1"]
    command += ["--config", "device=cpu", "--scheduler", "greedy"]
    done = subprocess.run([*command, "fleets", "backgrounds"], capture_output=True, text=True)
    said = done.stdout + done.stderr
    assert done.returncode == 0, said
    # Each takes some seconds, in which one of them waits.
    assert said.count("Finished jobid") == 2
    assert len(re.findall(r"^Ready jobs: [12]$", said, re.MULTILINE)) == 2


def leave(folder, steps, age):
    """Leaves a step's outputs, as old as they would be."""
    for path in (folder / output for step in steps for output in step.outputs):
        (path.parent if path.suffix else path).mkdir(parents=True, exist_ok=True)
        if path.suffix:
            path.touch()
        os.utime(path, (age, age))


def test_a_finished_run_is_given_only_the_cycles_column(tmp_path):
    plan = plan_of(TINY)
    for age, finished in enumerate(plan.steps):
        leave(tmp_path, [finished], 1000 + age)
    counted, said = dry_run(tmp_path, TINY_FILE, "--config", "blender=/blender")
    assert counted == {"render": 1, "score": 2, "report": 1, "all": 1, "total": 5}, said
    # Finished too, then stopped before the report was written again.
    wide = plan_of(TINY, blender=BLENDER)
    known = {step.id for step in plan.steps}
    leave(tmp_path, [step for step in wide.steps if step.id not in known], 2000)
    counted, said = dry_run(tmp_path, TINY_FILE, "--config", "blender=/blender")
    assert counted == {"report": 1, "all": 1, "total": 2}, said
    # Without the flag nothing of it is asked for or taken away.
    counted, said = dry_run(tmp_path, TINY_FILE)
    assert counted == {}, said


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"repeats": 0}, "repeats"),
        ({"cycles_repeats": 0}, "cycles_repeats"),
        ({"reference": ["retinanet", "retinanet"]}, "reference expects each detector once"),
        ({"detectors": ["retinanet", "retinanet"]}, "detectors expects each detector once"),
        ({"detectors": []}, "detector"),
        ({"sun": 1}, "no field 'sun'"),
        ({"world": {**TINY["world"], "image_px": 31}}, "image_px"),
        ({"world": {**TINY["world"], "; touch x": 1}}, "no field '; touch x'"),
        ({"attack": {"--out /elsewhere": 1}}, "no field"),
        ({"training": {"retinanet": {"steps; touch x": 4}}}, "no field"),
        ({"training": {"$(touch x)": {}}}, "training"),
        ({"attack_image_px": "96; touch x"}, "attack_image_px"),
        ({"attack_image_px": 400}, "attack_image_px"),
        ({"resources": {"gpu": "1 --shell x"}}, "resources.gpu"),
        ({"resources": {"shell": 1}}, "no field 'shell'"),
        ({"seed": 2**63}, "64 bits"),
        ({"repeats": 10**9}, "repeats"),
        ({"transfer": ["T-U_x; touch y"]}, "transfer"),
        ({"magnitudes": [1e-320, 1e300]}, "magnitudes"),
        ({"combined_magnitudes": {"{x}": [0.2]}}, "constraints"),
        ({"magnitudes": [0.2, 1.5]}, r"magnitudes\[1\]"),
        ({"magnitudes": [0]}, r"magnitudes\[0\]"),
        ({"textures": ["LcFc"]}, "Lc and Fc"),
        ({"attack_steps": {"texture": 1}}, "attack_steps"),
    ],
)
def test_impossible_presets_are_refused(changes, word):
    with pytest.raises(ConfigurationError, match=word):
        jobs(**changes)


def test_presets_by_name_or_file(tmp_path):
    assert read_preset("quick")[:2] == ("quick", PRESETS["quick"])
    own = tmp_path / "mine.json"
    own.write_text(json.dumps(TINY))
    assert read_preset(str(own)) == ("mine", own, TINY, Preset.parse(TINY))
    own.write_text(json.dumps({**TINY, "seed": 1} | {"draws": 1}).replace('"seed"', '"sed"'))
    with pytest.raises(ConfigurationError, match="no field 'sed'"):
        read_preset(str(own))
    with pytest.raises(ConfigurationError, match="quick, overnight, paper, reference"):
        read_preset("quik")


NASTY = ["a b", "a'b", 'a"b', "a;touch x", "$(touch x)", "`touch x`", "a\nb", "{x}", "*", "~", "-"]


@pytest.mark.parametrize("name", NASTY)
def test_every_word_of_a_step_reaches_the_process_as_it_is(name):
    blender = f"/{name}"
    plan = plan_of(TINY, blender=Path(blender))
    for step in (plan.steps[0], plan.steps[-1]):
        line = shell_line(step, {"device": "cpu", "blender": blender})(None)
        said = subprocess.run(
            ["sh", "-c", f"printf '%s\\0' {line}"], capture_output=True, text=True, check=True
        ).stdout.split("\0")[:-1]
        words = ["step", step.id, "--device=cpu", f"--blender={blender}"]
        assert said == [sys.executable, "-m", "skyproof.reproduction", *words]


def test_names_of_steps_are_plain():
    for preset in PRESETS:
        for each in whole_plan(preset, True).steps:
            assert re.fullmatch(r"[a-z]+/[A-Za-z0-9@._-]+", each.id)


def test_a_plan_refuses_what_a_later_step_would_refuse():
    @dataclass(frozen=True)
    class Late:
        share: Fraction = 2.0

        def run(self):
            raise AssertionError

    with pytest.raises(ConfigurationError, match="share expects"):
        command_step("late", "late", Late(), Path("x"))


def test_a_config_key_that_no_run_has_is_one_sentence():
    with pytest.raises(ConfigurationError, match="takes device and blender, got cycles"):
        plan_of_run(cycles=1)
