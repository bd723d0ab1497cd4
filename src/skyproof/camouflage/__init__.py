"""Camouflages: what is done to a vehicle's texture or shape, optimised or drawn at random.

Here stand their names, how each changes vehicles, how it is stored, and what it would cost to make.
"""
