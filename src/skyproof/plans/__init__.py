"""The reproduction of the paper's tables as a workflow: presets, what they expand to, and the Snakefile."""
