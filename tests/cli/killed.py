"""Runs an assessment in child processes and ends each at a given moment.

It is a script, so that torch is imported once.

Usage: killed.py FOLDER MOMENTS ARGUMENTS..., with MOMENTS as JSON: a list of [how, fragment, nth].
`how` is

- "appears": the parent polls the folder and sends SIGKILL when a path with `fragment` lies there;
- "interrupt": the same with SIGINT;
- "write": the child kills itself half-way through the n-th write of a path with `fragment`;
- "rename": the child kills itself just before such a file or folder gets its final name.

Prints one JSON list per child: how it ended, and the paths left below the folder. The last child
runs to its end.
"""

import contextlib
import json
import os
import signal
import sys
import time
import warnings
from pathlib import Path

import torch
from PIL import Image

from skyproof.main import run
from tests.few_scenes import few_scenes_judge
from tests.tiny_suite import tiny_suite


def plain(path: object) -> str:
    return str(path).replace(".partial", "").replace("/.", "/")


def arm(how: str, fragment: str, nth: int) -> None:
    left = [nth]

    def hit(path: object) -> bool:
        if fragment in plain(path):
            left[0] -= 1
        return left[0] == 0 and fragment in plain(path)

    def end() -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    if how == "rename":
        genuine = os.replace

        def replace(source: object, target: object) -> None:
            if hit(target):
                end()
            genuine(source, target)  # type: ignore[arg-type]

        os.replace = replace  # type: ignore[assignment]
    if how == "write":
        write_bytes, save = Path.write_bytes, Image.Image.save

        def write(path: Path, data: bytes) -> int:
            if hit(path):
                write_bytes(path, data[: len(data) // 2])
                end()
            return write_bytes(path, data)

        def write_image(
            image: Image.Image, path: object, *arguments: object, **options: object
        ) -> None:
            save(image, path, *arguments, **options)  # type: ignore[arg-type]
            if isinstance(path, str | Path) and hit(path):
                os.truncate(path, os.path.getsize(path) // 2)
                end()

        Path.write_bytes = write  # type: ignore[assignment,method-assign]
        Image.Image.save = write_image  # type: ignore[assignment,method-assign]


def main() -> None:
    torch.set_num_threads(1)
    # A parent may have had interrupts ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    folder, moments, arguments = Path(sys.argv[1]), json.loads(sys.argv[2]), sys.argv[3:]
    for how, fragment, nth in [*moments, ["never", "", 0]]:
        with contextlib.suppress(OSError):
            sys.stdout.flush()
        # Python 3.12 and later warn of forking beside torch's idle threads; no child uses them.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            child = os.fork()
        if not child:
            arm(how, fragment, nth)
            with (
                few_scenes_judge(),
                tiny_suite(),
                open(os.devnull, "w") as nowhere,
                contextlib.redirect_stdout(nowhere),
            ):
                code = run([*arguments, "--out", str(folder)])
            os._exit(code)
        if how in ("appears", "interrupt"):
            until = time.monotonic() + 60
            while time.monotonic() < until and not list(folder.glob(fragment)):
                time.sleep(0.001)
            os.kill(child, signal.SIGKILL if how == "appears" else signal.SIGINT)
        _, status = os.waitpid(child, 0)
        left = (
            sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))
            if folder.exists()
            else []
        )
        print(json.dumps([os.waitstatus_to_exitcode(status), left]))


if __name__ == "__main__":
    main()
