"""Attacks: what is minimised, and the one loop that minimises it.

Here stand also what an attack sees, and the test that its gradient points the right way.
"""
