"""Matched pairs: the outcome of each vehicle, and counts of them per background tile.

Everything is plain data, on disk and in memory.
"""
