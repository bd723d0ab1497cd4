"""`python -m skyproof`."""

from skyproof.cli import main

main()
