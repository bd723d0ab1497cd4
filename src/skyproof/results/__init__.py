"""Measurements and what follows from them: matched vehicles, rates with intervals, and checks.

A score folder holds all that was measured in one call; `Results` reads all score folders of a run.
"""
