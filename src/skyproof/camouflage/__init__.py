"""Camouflages: changes of a vehicle's texture or shape, optimised or drawn at random.

The package holds their names, how they change vehicles, how they are stored, and what they cost.
"""
