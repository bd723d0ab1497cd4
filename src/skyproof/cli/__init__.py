"""The command line: the only place that picks a device or prints."""

from __future__ import annotations

import os
import sys

__all__ = ["main"]


def main() -> None:
    """Entry point of the `skyproof` command."""
    # Many small operations stall when idle threads spin; this must be said before torch is imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    try:
        from skyproof.cli.main import run
    except KeyboardInterrupt:
        sys.exit(130)
    sys.exit(run())
