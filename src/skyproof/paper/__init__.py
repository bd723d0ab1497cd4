"""What the paper reports, and our results in the same tables and beside its numbers.

Only results are read here; nothing is drawn, rendered or detected.
"""
