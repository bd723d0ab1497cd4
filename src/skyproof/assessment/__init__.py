"""What `skyproof assess` and `skyproof demo` do: from detectors and imagery to a report.

This package holds the steps of a run, the suite of attacks, and the run folder that keeps every
finished step.
"""
