"""What `skyproof assess` and `skyproof demo` do: from detectors and imagery to a report.

Here belong the steps of a run, the suite of attacks, and the run folder in which every finished
step is kept.
"""
