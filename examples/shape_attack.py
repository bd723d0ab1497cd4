"""A body that may grow by up to a fifth of its width, against one detector of a run."""

import sys

import skyproof.api as sp

run, out = sys.argv[1:3]
world = sp.AttackWorld.open(f"{run}/backgrounds", f"{run}/fleets/attack", sp.SceneSettings(128, vehicles_maximum=1))
detector, _ = sp.load_detector(f"{run}/detectors/retinanet")
camouflage = sp.DisplacementMap("S-O@0.2", magnitude=0.2)
print(sp.sign_test(camouflage, [detector], world, sp.AttackSettings()))
steps = int(sys.argv[3]) if len(sys.argv) > 3 else 100
sp.attack(camouflage, [detector], world, sp.AttackSettings(steps=steps), f"{out}/S-O@0.2")
