"""Camouflages: what is done to a vehicle's texture or shape, learnt or drawn at random, or nothing."""
