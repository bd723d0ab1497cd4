"""Vehicles: the template mesh with its UV map, bodies and paints drawn at random, and fleets.

Real meshes are wrapped onto the same template (`wrapping`).
"""
