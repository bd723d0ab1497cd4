"""Report: one self-contained HTML page from a run folder's files alone. Imports no torch."""
