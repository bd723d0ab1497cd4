"""All that only a reproduction of the paper needs. Nothing else imports this room.

Here belong presets, their steps, and how steps run side by side, by Snakemake or on Slurm.
"""
