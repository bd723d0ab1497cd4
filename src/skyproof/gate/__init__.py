"""The gate: whether a detector is worth attacking, told before any attack.

A detector that a plain paint, a sharper lens or a lower sun makes blind ranks no attacks: each of
them hides everything. Trials that learn nothing find that out.
"""
