"""The paper reproduced: its attacks, its tables and figures beside ours, and what backs them.

Here belongs all that only a reproduction needs: presets, their steps, and how steps run side by
side, by Snakemake; and one file for each topic of the report. Nothing else imports it.
"""
