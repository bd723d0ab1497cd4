"""The reproduction of the paper: its attacks, its tables and figures beside ours, and evidence.

All that only a reproduction needs belongs here: presets, their steps, running steps side by side
with Snakemake, and one file for each topic of the report. Nothing else imports it.
"""
