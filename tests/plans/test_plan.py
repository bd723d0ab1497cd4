"""What a preset expands to: names by hand, and the same jobs in Snakemake's eyes."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from skyproof.camouflage.name import CamouflageName
from skyproof.errors import ConfigurationError
from skyproof.plans.plan import PRESETS, SNAKEFILE, Plan, Preset, read_preset

TINY = json.loads(Path(__file__).with_name("tiny.json").read_text())


def plan(**changes):
    return Plan(Preset.parse({**TINY, **changes}))


def test_tiny_by_hand():
    tiny = plan()
    assert list(tiny.attacks) == ["T-Fc-0", "S-O@0.4-0", "C-Fc-seq@0.4-0", "C-Fc-par@0.4-0"]
    assert tiny.controls == ("R-Fc-0", "R-S-O@0.4-0", "R-C-Fc@0.4-0")
    texture = tiny.attacks["T-Fc-0"]
    assert (texture.kind, texture.fixed_colours, texture.texture, texture.keep_at) == (
        "texture",
        True,
        None,
        (1,),
    )
    assert texture.folders == (
        "T-Fc-0",
        "T-Fc-0/snapshots/T-Fc_step1-0",
        "T-Fc-0/snapshots/T-Fc_relaxed-0",
    )
    # Its texture is finished: no palette, nothing to round.
    sequential = tiny.attacks["C-Fc-seq@0.4-0"]
    assert (sequential.texture, sequential.fixed_colours, sequential.relaxed) == (
        "T-Fc-0",
        False,
        False,
    )
    assert tiny.attacks["C-Fc-par@0.4-0"].fixed_colours
    # Random controls are scored by themselves: they wait for no attack.
    assert tiny.batches["000"] == tiny.controls == ("R-Fc-0", "R-S-O@0.4-0", "R-C-Fc@0.4-0")
    assert list(tiny.batches) == ["000", "001"]
    assert len(tiny.batches["001"]) == 3 + 2 + 2 + 3


def test_on_cycles_are_finished_attacks_and_controls_alone():
    assert plan().cycles_batches == {}
    tiny = Plan(Preset.parse(TINY), cycles=True)
    assert tiny.cycles_batches == {
        "000": ("R-Fc-0", "R-S-O@0.4-0", "R-C-Fc@0.4-0"),
        "001": ("T-Fc-0", "S-O@0.4-0", "C-Fc-seq@0.4-0", "C-Fc-par@0.4-0"),
    }
    # One more job for the original images, and one for each batch.
    assert tiny.jobs == {**plan().jobs, "render_cycles": 1, "score_cycles": 2}
    assert list(tiny.jobs)[-1] == "tables"
    # Neither transfers nor copies kept on the way.
    wide = Plan(
        Preset.parse({**TINY, "detectors": ["a", "b"], "textures": ["U"], "transfer": ["T-U"]}),
        cycles=True,
    )
    assert wide.cycles_batches["001"] == ("T-U-0", "S-O@0.4-0", "C-U-seq@0.4-0")
    # The first repeats and draws of each.
    more = {"textures": ["U"], "repeats": 3, "draws": 4, "cycles_repeats": 2, "score_batch": 4}
    assert Plan(Preset.parse({**TINY, **more}), cycles=True).cycles_batches == {
        "000": ("R-U-0", "R-U-1", "R-S-O@0.4-0", "R-S-O@0.4-1"),
        "001": ("R-C-U@0.4-0", "R-C-U@0.4-1"),
        "002": ("T-U-0", "S-O@0.4-0", "C-U-seq@0.4-0", "T-U-1"),
        "003": ("S-O@0.4-1", "C-U-seq@0.4-1"),
    }


def test_repeats_seeds_transfer_and_masked():
    wide = plan(
        seed=7, detectors=["a", "b", "c"], textures=["U", "PixFcMa"], repeats=2, draws=2, transfer=["T-U"],
        magnitudes=[0.5, 1.0], combined_magnitudes={"PixFcMa": [0.2]}, score_batch=4,
        ladder_steps=[1, 5, 100], ladder_magnitude=0.5,
        attack_steps={"texture": 10, "shape": 5, "sequential": 6, "parallel": 6},
    )  # fmt: skip
    first = [
        "T-U", "T-PixFcMa", "T-U_on_a", "T-U_on_b", "T-U_on_c", "T-U_without_a", "T-U_without_b", "T-U_without_c",
        "S-O@0.5", "S-O@1", "C-U-seq@0.5", "C-U-seq@1", "C-PixFcMa-seq@0.2",
    ]  # fmt: skip
    assert list(wide.attacks) == [f"{name}-{repeat}" for repeat in (0, 1) for name in first]
    assert {wide.attacks[f"{name}-1"].seed for name in first} == {8}
    assert wide.attacks["T-U_without_b-0"].detectors == ("a", "c")
    assert wide.attacks["C-PixFcMa-seq@0.2-1"].texture == "T-PixFcMa-1"
    # Copies are kept below the last step, of the first repeat, at one magnitude, and not of transfers.
    kept = {name: job.keep_at for name, job in wide.attacks.items() if job.keep_at}
    assert kept == {
        "T-U-0": (1, 5),
        "T-PixFcMa-0": (1, 5),
        "S-O@0.5-0": (1,),
        "C-U-seq@0.5-0": (1, 5),
    }
    scored = [folder for batch in wide.batches.values() for folder in batch]
    assert len(scored) == len(set(scored)) == 26 + (2 + 3 + 1 + 2) + 2 * (2 + 2 + 2 + 1)
    assert [len(batch) for batch in wide.batches.values()] == [4, 4, 4, 2] + [4] * 8 + [2]
    # Two detectors: all but one is the other one, which is there already.
    assert [
        name for name in plan(detectors=["a", "b"], transfer=["T-U"]).attacks if "_" in name
    ] == [
        "T-U_on_a-0",
        "T-U_on_b-0",
    ]


@pytest.mark.parametrize("preset", PRESETS)
def test_every_name_can_be_made_and_has_its_control(preset):
    full = Plan(Preset.parse(json.loads(PRESETS[preset].read_text())))
    parsed = {name: CamouflageName.parse(name) for name in full.attacks}
    textures = [name for name in parsed.values() if name.kind == "texture" and not name.variant]
    assert len({name.pooled for name in textures}) == 12
    controls = {CamouflageName.parse(name).pooled for name in full.controls}
    for name, job in full.attacks.items():
        assert not parsed[name].random
        assert (parsed[name].order == "seq") == (job.texture is not None)
        assert parsed[name].control in controls
    assert all(name.random for name in controls)
    assert full.preset.repeats >= 3
    assert full.preset.draws >= 3


def dry_run(folder, preset, *more):
    """Snakemake's jobs by rule, and all it says."""
    command = [
        sys.executable,
        "-m",
        "snakemake",
        "--snakefile",
        SNAKEFILE,
        "--directory",
        folder,
        "--dry-run",
    ]
    command += [
        "--printshellcmds",
        "--cores",
        "2",
        "--rerun-triggers",
        "mtime",
        "--configfile",
        preset,
    ]
    done = subprocess.run([*command, *more], capture_output=True, text=True)
    said = done.stdout + done.stderr
    assert done.returncode == 0, said
    counts = {rule: int(count) for rule, count in re.findall(r"^(\w+) +(\d+)$", said, re.MULTILINE)}
    return counts, said


@pytest.mark.parametrize("cycles", [False, True])
@pytest.mark.parametrize("preset", PRESETS)
def test_snakemake_sees_the_same_jobs_and_no_cycle(preset, cycles, tmp_path):
    counted, _ = dry_run(tmp_path, PRESETS[preset], *(["--config", "cycles=1"] if cycles else []))
    expected = Plan(Preset.parse(json.loads(PRESETS[preset].read_text())), cycles=cycles).jobs
    assert counted == {**expected, "all": 1, "total": sum(expected.values()) + 1}


def test_commands_on_cycles(tmp_path):
    preset = Path(__file__).with_name("tiny.json")
    _, said = dry_run(tmp_path, preset, "--config", "cycles=1", "blender=/opt/my blender/python")
    commands = [line for line in said.splitlines() if "--renderer cycles" in line]
    assert len(commands) == 3
    assert all(
        "--renderer cycles --blender '/opt/my blender/python' --workers 1 " in line
        for line in commands
    )
    assert "--scenes scenes/test.jsonl" in commands[0]
    assert "--out datasets/test-cycles" in commands[0]
    attacks = next(line for line in commands if "T-Fc-0" in line)
    assert "--original datasets/test-cycles --out scores-cycles/001" in attacks
    assert "snapshots" not in attacks
    _, said = dry_run(tmp_path, preset, "--config", "cycles=1")
    assert "--renderer cycles --workers 1" in said


def test_a_finished_run_is_given_only_the_cycles_column(tmp_path):
    preset = Path(__file__).with_name("tiny.json")
    tiny = plan()
    # By age: what a finished run leaves.
    stages = [
        ["backgrounds", "fleets", "scenes"],
        [f"datasets/{split}" for split in ("train", "validation", "test")],
        ["detectors/retinanet/detector.json"],
        [
            f"camouflages/{name}/camouflage.json"
            for name in (*tiny.controls, "T-Fc-0", "S-O@0.4-0", "C-Fc-par@0.4-0")
        ],
        ["camouflages/C-Fc-seq@0.4-0/camouflage.json"],
        ["measures.json", *(f"scores/{batch}" for batch in tiny.batches)],
        ["results.json", "tables/README.md"],
    ]
    for age, names in enumerate(stages):
        for path in (tmp_path / name for name in names):
            (path.parent if path.suffix else path).mkdir(parents=True, exist_ok=True)
            if path.suffix:
                path.touch()
            os.utime(path, (1000 + 10 * age, 1000 + 10 * age))
    counted, said = dry_run(tmp_path, preset, "--config", "cycles=1")
    assert counted == {"render_cycles": 1, "score_cycles": 2, "tables": 1, "all": 1, "total": 5}, (
        said
    )
    # Finished too, then stopped before the tables were written again.
    for name in ("datasets/test-cycles", "scores-cycles/000", "scores-cycles/001"):
        (tmp_path / name).mkdir(parents=True)
        os.utime(tmp_path / name, (2000, 2000))
    counted, said = dry_run(tmp_path, preset, "--config", "cycles=1")
    assert counted == {"tables": 1, "all": 1, "total": 2}, said
    # Without the flag nothing of it is asked for or taken away.
    counted, said = dry_run(tmp_path, preset)
    assert counted == {}, said


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"repeats": 0}, "repeats"),
        ({"cycles_repeats": 0}, "cycles_repeats"),
        ({"detectors": []}, "detector"),
        ({"magnitudes": [0.2, 1.5]}, "1.5"),
        ({"magnitudes": [0]}, "above 0"),
        ({"textures": ["LcFc"]}, "Lc and Fc"),
        ({"attack_steps": {"texture": 1}}, "attack_steps"),
    ],
)
def test_impossible_presets_are_refused(changes, word):
    with pytest.raises(ConfigurationError, match=word):
        plan(**changes)


def test_presets_by_name_or_file(tmp_path):
    assert read_preset("quick") == ("quick", PRESETS["quick"])
    own = tmp_path / "mine.json"
    own.write_text(json.dumps(TINY))
    assert read_preset(str(own)) == ("mine", own)
    own.write_text(json.dumps({**TINY, "seed": 1} | {"draws": 1}).replace('"seed"', '"sed"'))
    with pytest.raises(ConfigurationError, match="lacks seed"):
        read_preset(str(own))
    with pytest.raises(ConfigurationError, match="quick or paper"):
        read_preset("quik")
