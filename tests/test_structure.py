"""Which package may import which, read from the syntax trees: imports run downwards."""

import ast
import re
from collections import Counter
from functools import cache
from pathlib import Path

SOURCE = Path(__file__).parents[1] / "src" / "skyproof"

# From the ground up. A module imports from its own package and from lower floors, never from a
# neighbour.
FLOORS = [
    {"errors", "seeds"},
    {"ranges", "files", "words", "layout", "randomness", "console", "device"},
    {"pictures", "kernels"},
    {"documents"},
    {"geometry", "storage"},
    {"loop"},
    {"scenes", "vehicles"},
    {"datasets", "ground"},
    {"camouflage", "render", "detectors"},
    {"cycles", "results", "imagery"},
    {"measure"},
    {"attacks", "maite"},
    {"report"},
    {"cli"},
    {"assessment"},
    {"main", "__init__"},
    {"generator", "hardening", "reproduction", "__main__"},
]
# Nothing else needs them: the paper's tables, vehicles learnt from photographs, and hardening.
ROOMS_OF_THEIR_OWN = ("generator", "hardening", "reproduction")
BLENDER_WORKER = "cycles.worker"
PRINTING = ("console", "__main__", *ROOMS_OF_THEIR_OWN)
FLOOR = {package: floor for floor, packages in enumerate(FLOORS) for package in packages}


# A module is read and parsed once for all rules.
parsed = cache(ast.parse)


@cache
def sources():
    """Every module's dotted name below skyproof and its text."""
    return {
        ".".join(path.relative_to(SOURCE).with_suffix("").parts): path.read_text(encoding="utf-8")
        for path in sorted(SOURCE.rglob("*.py"))
    }


@cache
def imports(text, *, at_import_time=False):
    """Dotted names a module imports; with `at_import_time` only those outside functions."""
    found, waiting = set(), [parsed(text)]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            # What is imported may be a module itself.
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
        elif at_import_time and isinstance(
            node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda
        ):
            continue
        waiting += ast.iter_child_nodes(node)
    return found


def ours(names):
    """Of dotted names, the part below skyproof."""
    return {name.removeprefix("skyproof.") for name in names if name.startswith("skyproof.")}


def upward_imports(modules):
    wrong = []
    for module, text in modules.items():
        own = module.split(".")[0]
        for package in {name.split(".")[0] for name in ours(imports(text))}:
            if package != own and FLOOR.get(package, -1) >= FLOOR[own]:
                wrong.append(f"{module} imports {package}")
    return sorted(wrong)


def reaches(start, modules, wanted):
    """The modules, from `start` on, that load a package `wanted` when they are imported."""
    seen, waiting, guilty = set(), [start], []
    while waiting:
        module = waiting.pop()
        if module in seen or module not in modules:
            continue
        seen.add(module)
        names = imports(modules[module], at_import_time=True)
        if any(name == wanted or name.startswith(f"{wanted}.") for name in names):
            guilty.append(module)
        for name in ours(names):
            parts = name.split(".")
            # Importing a.b runs a's own file first.
            waiting += [
                ".".join([*parts[:end], *last])
                for end in range(1, len(parts) + 1)
                for last in ([], ["__init__"])
            ]
    return sorted(guilty)


def importers(modules, package):
    return sorted(
        module
        for module, text in modules.items()
        if package in {n.split(".")[0] for n in imports(text)}
    )


def dependants(modules, room):
    """Modules outside a room that import from it, at once or later."""
    return sorted(
        module
        for module, text in modules.items()
        if module.split(".")[0] != room
        and any(name.split(".")[0] == room for name in ours(imports(text)))
    )


def printers(modules):
    """Modules that call print, or write to a stream of sys."""
    found = []
    for module, text in modules.items():
        for node in ast.walk(parsed(text)):
            if not isinstance(node, ast.Call):
                continue
            called = ast.unparse(node.func)
            if called in ("print", "sys.stdout.write", "sys.stderr.write", "warnings.warn"):
                found.append(module)
    # The program that runs inside Blender prints its answers into a pipe.
    spared = {
        module for module in found if module.split(".")[0] in PRINTING or module == BLENDER_WORKER
    }
    return sorted({*found} - spared)


def test_every_package_has_its_floor():
    assert {module.split(".")[0] for module in sources()} <= set(FLOOR)


def test_imports_run_downwards():
    # So camouflage never imports render, and detectors never import attacks.
    assert upward_imports(sources()) == []


def test_nothing_needs_the_paper_or_the_learnt_vehicles():
    # The entry point names their commands as text, and imports them when they are asked for.
    for room in ROOMS_OF_THEIR_OWN:
        assert dependants(sources(), room) == [], room


def test_geometry_needs_torch_and_kernels_alone():
    for module, text in sources().items():
        if module.startswith("geometry."):
            outside = {name.split(".")[0] for name in imports(text)} - {
                "__future__",
                "functools",
                "math",
                "typing",
            }
            assert outside <= {"torch", "warp", "jaxtyping", "skyproof"}, module
            within = {name.split(".")[0] for name in ours(imports(text))}
            assert within <= {"geometry", "kernels"}, module


def test_kernels_are_written_where_no_checker_of_python_looks():
    # pyproject.toml spares these files mypy, and without jaxtyping nothing checks their shapes.
    modules = sources()
    kernels = {
        module
        for module, text in modules.items()
        if re.search(r"^@wp\.", text, re.MULTILINE) or "render.kernels" in module
    }
    assert {m for m in kernels if not m.startswith("render.kernels.")} == {"geometry.triangles"}
    assert not kernels & set(importers(modules, "jaxtyping"))
    overrides = (SOURCE.parents[1] / "pyproject.toml").read_text().split("[[tool.mypy.overrides]]")
    spared = re.findall(r'"skyproof\.([^"]+)"', "".join(overrides[1:]))
    assert spared == ["geometry.triangles", "render.kernels.*"]


def test_the_report_loads_no_torch():
    modules = sources()
    for module in modules:
        if module.split(".")[0] == "report":
            assert reaches(module, modules, "torch") == [], module


def test_the_first_look_loads_no_diagrams_and_no_distributions():
    # They take a second, and a user waits for the first words.
    modules = sources()
    for package in ("matplotlib", "scipy.stats", "cmaes"):
        assert reaches("assessment.assess", modules, package) == [], package
    assert reaches("report.report", modules, "matplotlib") != []


def test_a_generator_is_read_without_the_renderer():
    # Fleets are drawn from one without it, as they are without one.
    modules = sources()
    assert reaches("generator.folder", modules, "skyproof.render") == []
    assert reaches("generator.fitting", modules, "skyproof.render") != []


def test_ultralytics_is_imported_in_one_file_and_only_when_used():
    # Its licence is AGPL-3.0: whoever does not ask for YOLOv5 never loads it.
    modules = sources()
    assert importers(modules, "ultralytics") == ["detectors.ultralytics_detectors"]
    at_once = imports(modules["detectors.ultralytics_detectors"], at_import_time=True)
    assert not any(name.startswith("ultralytics") for name in at_once)


def test_packages_of_extras_are_imported_in_one_file_and_only_when_used():
    # The plain install has none of them.
    modules = sources()
    files = {
        "onnx": "detectors.onnx_file",
        "onnxruntime": "detectors.onnx_file",
        "transformers": "detectors.transformers_detectors",
    }
    for package, file in files.items():
        assert importers(modules, package) == [file]
        at_once = imports(modules[file], at_import_time=True)
        assert not any(name.split(".")[0] == package for name in at_once)


def test_blenders_interface_is_imported_in_one_file_that_stands_alone():
    # It is under the GPL, and so is that file: it shares no code with the rest, in either
    # direction.
    modules = sources()
    assert importers(modules, "bpy") == importers(modules, "mathutils") == [BLENDER_WORKER]
    assert ours(imports(modules[BLENDER_WORKER])) == set()
    assert not any(BLENDER_WORKER in ours(imports(text)) for text in modules.values())
    assert "SPDX-License-Identifier: GPL-3.0-or-later" in modules[BLENDER_WORKER].split("\n")[0]


def rooms_without_a_description(modules):
    """Rooms whose first file does not say in two sentences or more what belongs there."""
    return [
        module
        for module, text in modules.items()
        if module.endswith(".__init__")
        and len(re.findall(r"\.\s", (ast.get_docstring(parsed(text)) or "") + "\n")) < 2
    ]


def test_every_room_says_what_belongs_there():
    assert rooms_without_a_description(sources()) == []


def test_the_paper_is_cited_by_section_equation_and_table():
    root = SOURCE.parents[1]
    # The number of a private list would tell a reader nothing.
    private = re.compile("PAPER" + r"\s+\d")
    places = ("src", "tests", "tools", "examples", "docs")
    files = [path for place in places for path in (root / place).rglob("*.*")]
    texts = [*root.glob("*.md"), *(path for path in files if path.suffix in (".py", ".md", ".j2"))]
    assert [
        path.relative_to(root).as_posix()
        for path in texts
        if private.search(path.read_text(encoding="utf-8"))
    ] == []


def test_only_the_command_line_prints():
    assert printers(sources()) == []


def test_no_module_unpickles():
    for module, text in sources().items():
        assert not {"pickle", "joblib", "dill"} & {name.split(".")[0] for name in imports(text)}, (
            module
        )
        # Checkpoints of others: weights alone, with every foreign class replaced by one that does
        # nothing.
        loads = re.findall(r"torch\.load\(.*", text)
        assert len(loads) == (module == "detectors.checkpoints"), module
        assert all("weights_only=True" in load for load in loads), module


def packed_calls(text):
    """The lines that assign two values or more at once, of which one is computed by a call."""
    return [
        node.lineno
        for node in ast.walk(parsed(text))
        if isinstance(node, ast.Assign)
        and isinstance(node.value, ast.Tuple)
        and any(isinstance(target, ast.Tuple) for target in node.targets)
        and any(isinstance(part, ast.Call) for part in ast.walk(node.value))
    ]


def packings_per_1000_lines(modules):
    packings = sum(len(packed_calls(text)) for text in modules.values())
    return 1000 * packings / sum(text.count("\n") for text in modules.values())


def test_one_statement_a_line():
    modules = sources()
    places = {module: packed_calls(text) for module, text in modules.items() if packed_calls(text)}
    assert packings_per_1000_lines(modules) <= 3, places


def test_packed_calls_are_counted():
    assert packed_calls("a, b = f(), g()\nc, d = d, c\ne, f = pair()\ng = f(), h()\n") == [1]
    assert packed_calls("first, second = (\n    one(),\n    2,\n)\n") == [1]
    lines = "a = 1\n" * 249
    assert packings_per_1000_lines({"packed": "a, b = f(), g()\n" + lines}) == 4
    assert packings_per_1000_lines({"packed": "a, b = f(), g()\n" + lines, "fine": lines}) < 3


def test_a_module_beyond_400_lines_has_a_second_subject():
    assert {
        module: text.count("\n") for module, text in sources().items() if text.count("\n") > 400
    } == {}


def test_a_class_name_stands_for_one_class():
    names = Counter(
        node.name
        for text in sources().values()
        for node in ast.parse(text).body
        if isinstance(node, ast.ClassDef)
    )
    assert [name for name, count in names.items() if count > 1] == []


def test_the_source_keeps_to_its_budget_of_lines():
    lines = {module: text.count("\n") for module, text in sources().items()}
    own = sum(n for module, n in lines.items() if module.split(".")[0] in ROOMS_OF_THEIR_OWN)
    assert sum(lines.values()) <= 48_000
    assert sum(lines.values()) - own <= 40_000


def test_these_rules_can_fail():
    modules = {
        "errors": "",
        "camouflage.texture": "from skyproof.render.renderer import TorchRenderer",
        "detectors.detector": "def later():\n    from skyproof.attacks import attack",
        "vehicles.fleet": "import skyproof.scenes.scene",
        "render.shade": (
            "from skyproof.errors import SkyproofError\nfrom skyproof.render import settings"
        ),
        "results.fine": "from skyproof.errors import SkyproofError\ndef f():\n    import torch",
        "results.heavy": "class Row:\n    from torch import Tensor",
        "report.page": "from skyproof.results.fine import f\nprint('done')",
        "report.slow": "from skyproof.results import heavy",
        "cli.later": "def f():\n    from skyproof.reproduction.page import f",
        "console": "print('hello')",
        "reproduction.__init__": '"""The paper: tables. Nothing else."""',
        "reproduction.page": "from skyproof.report.page import f",
        "render.__init__": '"""The renderer."""',
    }
    assert rooms_without_a_description(modules) == ["render.__init__"]
    assert upward_imports(modules) == [
        "camouflage.texture imports render",
        "cli.later imports reproduction",
        "detectors.detector imports attacks",
        "vehicles.fleet imports scenes",
    ]
    assert dependants(modules, "reproduction") == ["cli.later"]
    assert reaches("report.page", modules, "torch") == []
    assert reaches("report.slow", modules, "torch") == ["results.heavy"]
    assert importers(modules, "torch") == ["results.fine", "results.heavy"]
    assert printers(modules) == ["report.page"]


def test_every_test_runs_in_ci():
    """`make test` leaves tests out, and `make test-all`, which CI runs, takes just those."""
    top = SOURCE.parents[1]
    makefile = (top / "Makefile").read_text()
    recipes = dict(re.findall(r"^(test\S*): .*\n\t(.*)$", makefile, re.MULTILINE))
    assert recipes == {"test": '$(PYTEST) -m "not slow"', "test-all": "$(PYTEST) -m slow"}
    assert re.search(r"^test-all: test$", makefile, re.MULTILINE)
    for file in (".ci/run", ".github/workflows/test.yml"):
        assert re.search(r"\bmake test-all$", (top / file).read_text(), re.MULTILINE), file
