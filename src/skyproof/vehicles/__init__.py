"""Vehicles: the one template mesh with its one UV map, procedural body types, the fleet."""
