"""Vehicles are removed from tiles here: they are found, masked, filled with ground and checked.

A person is shown what was done.
"""
