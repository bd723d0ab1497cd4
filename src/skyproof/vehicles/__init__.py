"""Vehicles lie here: one template mesh with one UV map, bodies and paint drawn at random, fleets.

Real meshes are laid onto the same template.
"""
