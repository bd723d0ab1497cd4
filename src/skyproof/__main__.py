"""`python -m skyproof`."""

from skyproof.main import main

main()
