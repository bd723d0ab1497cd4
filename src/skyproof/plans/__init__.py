"""Whole runs as plans: named steps, each the settings of one command, with inputs and outputs.

Here belong the demo's and the reproduction's steps, where the files of a run lie, and how steps are
run: one after the other in one process, or by Snakemake.
"""
