"""Brings real meshes onto the shared template: reads, turns, wraps, bakes and measures them.

Nothing here is needed to use a fleet.
"""
