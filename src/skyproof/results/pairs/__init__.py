"""Matched pairs: what became of each vehicle, and what is counted of it per background tile.

Everything is plain data, on disk and in memory; only `compare` sees what a detector said.
"""
