"""`python -m skyproof.generator learn`: a generator of vehicles learnt from photographs."""

from skyproof.main import main

COMMANDS = {"Vehicles from photographs": {"learn": "skyproof.generator.command:LearnVehicles"}}

if __name__ == "__main__":
    main(COMMANDS)
