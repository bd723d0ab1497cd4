"""Vehicles on tiles are found, masked, filled with ground and checked. A person sees the result."""
