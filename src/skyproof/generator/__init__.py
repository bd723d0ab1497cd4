"""Vehicles learnt from photographs: fitted through the renderer, then sampled anew.

Code that makes vehicles from photographed ones belongs here. Vehicles that are drawn by rules, or
wrapped from meshes, belong to `vehicles`; light and places measured on photographs, to `imagery`.
"""
