"""Attacks: the objective that is minimised, and the one loop that minimises it.

The package also holds an attack's scenes, and the test that its gradient points the right way.
"""
