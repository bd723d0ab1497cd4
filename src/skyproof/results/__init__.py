"""What was measured belongs here: matched vehicles, rates with intervals, and checks.

A score folder holds all that was measured in one go; `Results` reads all score folders of a run.
"""
