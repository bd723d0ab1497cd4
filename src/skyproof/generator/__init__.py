"""Vehicles learnt from photographs: fitted through the renderer, then sampled anew.

Here belongs what makes vehicles of photographed ones. Vehicles that are drawn by rules, or wrapped
from meshes, belong to `vehicles`; what photographs say of light and place, to `imagery`.
"""
