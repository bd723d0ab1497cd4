"""The command line: the only place that picks a device or prints."""

from __future__ import annotations

import ctypes
import os
import sys

__all__ = ["main"]


def main() -> None:
    """Entry point of the `skyproof` command."""
    # Many small operations stall when idle threads spin; this must be said before torch is imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    _keep_freed_memory()
    try:
        from skyproof.cli.main import run
    except KeyboardInterrupt:
        sys.exit(130)
    sys.exit(run())


def _keep_freed_memory() -> None:
    """Tells the GNU C library not to hand large freed blocks back to the system.

    Every step of training and attack needs the same large blocks again; getting them fresh costs page faults, up to a
    quarter of the rendering time. Elsewhere than on glibc nothing happens.
    """
    trim_threshold, mmap_threshold = -1, -3
    try:
        library = ctypes.CDLL(None)
        library.mallopt(trim_threshold, 2**31 - 1)
        library.mallopt(mmap_threshold, 2**30)
    except (OSError, AttributeError, TypeError):
        pass
