"""`python -m skyproof.reproduction`: the steps of a reproduction that no other run has."""

from skyproof.main import main
from skyproof.reproduction.step_commands import STEPS

if __name__ == "__main__":
    main({"Steps of a reproduction": STEPS})
