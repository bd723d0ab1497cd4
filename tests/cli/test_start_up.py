"""Help, the version and a wrong option answer at once: nothing large is imported for them."""

import subprocess
import sys

import pytest

from skyproof.main import COMMANDS

LARGE = {
    "torch",
    "warp",
    "numpy",
    "scipy",
    "matplotlib",
    "pyarrow",
    "rasterio",
    "jaxtyping",
    "geopandas",
}
PROGRAM = """
import sys
from skyproof.main import run
code = run(sys.argv[1:])
print(code, *sorted({name.partition(".")[0] for name in sys.modules}))
"""


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["--help"], 0),
        (["--version"], 0),
        ([], 2),
        *(([name, "--nonsense"], 2) for group in COMMANDS.values() for name in group),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_nothing_large_is_imported(words, code):
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, *words], capture_output=True, text=True, check=True
    )
    answer, *modules = done.stdout.splitlines()[-1].split()
    assert int(answer) == code
    assert "skyproof" in modules
    assert not LARGE & set(modules)


def test_the_overview_fits_one_screen_and_names_at_most_twenty_commands():
    names = [name for group in COMMANDS.values() for name in group]
    assert len(names) == len(set(names)) <= 20
    done = subprocess.run(
        [sys.executable, "-m", "skyproof", "--help"], capture_output=True, text=True, check=True
    )
    lines = done.stdout.splitlines()
    assert len(lines) <= 40
    assert max(map(len, lines)) <= 120
    for name in names:
        assert any(line.startswith(f"  {name} ") for line in lines), name


FETCH = """
import socket, threading
import pyogrio, rasterio
from rasterio.crs import CRS
from skyproof import main

def fetch():
    address = f"http://127.0.0.1:{server.getsockname()[1]}/a.tif"
    ways = (
        lambda: CRS.from_user_input(address),
        lambda: rasterio.open(f"/vsicurl/{address}"),
        lambda: rasterio.open(f"WMS:{address}"),
        lambda: pyogrio.read_info(f"GeoJSON:{address}"),
    )
    for way in ways:
        try:
            way()
        except Exception:
            pass

def answer():
    while True:
        connection, _ = server.accept()
        print("asked")
        connection.close()

server = socket.create_server(("127.0.0.1", 0))
threading.Thread(target=answer, daemon=True).start()
main.run = lambda **_: fetch()
if GUARDED:
    main.main()
else:
    fetch()
"""


LOUD = """
from skyproof import main

def speak():
    import warnings
    from rasterio.crs import CRS
    from rasterio.warp import transform
    warnings.warn("overflow encountered in cast", RuntimeWarning)
    grid = CRS.from_string("+proj=utm +zone=60 +nadgrids=missing.gsb")
    for way in (lambda: CRS.from_user_input("EPSG:999999"),
                lambda: transform(grid, "EPSG:4326", [5e5], [5e6])):
        try:
            way()
        except Exception:
            pass

main.run = lambda **_: speak()
if GUARDED:
    main.main()
else:
    speak()
"""


def alone(script):
    """Runs a script in a process of its own."""
    return subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=120
    )


@pytest.mark.parametrize("guarded", [True, False])
def test_libraries_write_nothing_beside_the_sentence(guarded):
    done = alone(LOUD.replace("GUARDED", str(guarded)))
    assert (done.stderr == "") is guarded
    if not guarded:
        assert "RuntimeWarning" in done.stderr
        assert "PROJ" in done.stderr


@pytest.mark.parametrize("guarded", [True, False])
def test_gdal_and_proj_ask_no_network(guarded):
    done = alone(FETCH.replace("GUARDED", str(guarded)))
    assert ("asked" in done.stdout) is not guarded
