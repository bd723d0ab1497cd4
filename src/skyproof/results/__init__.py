"""What was measured: matched vehicles, rates with intervals, checks, and the one `Results` of a run.

A score folder holds all that was measured in one go; `Results` reads all score folders of a run.
"""
