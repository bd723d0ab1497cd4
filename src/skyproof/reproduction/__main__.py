"""`python -m skyproof.reproduction step NAME`: one step of the run in the current folder."""

from skyproof.main import main

COMMANDS = {"Steps of a reproduction": {"step": "skyproof.reproduction.command:OneStep"}}

if __name__ == "__main__":
    main(COMMANDS)
