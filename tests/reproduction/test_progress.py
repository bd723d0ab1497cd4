"""Progress of a reproduction, from files as Snakemake leaves them."""

import os

from skyproof.reproduction.snakemake import failed_log, finished_jobs
from skyproof.results.stored import Timing

HEADER = "s\th:m:s\tmax_rss\tmax_vms\tmax_uss\tmax_pss\tio_in\tio_out\tmean_load\tcpu_time\n"
LOG = """
[Sat Nov 21 12:50:35 2026]
Finished jobid: 5 (Rule: palette)
[Sat Nov 21 12:50:35 2026]
Error in rule attack:
    message: None
    jobid: 6
    output: camouflages/S-O@0.4-1/camouflage.json
    log: logs/attack/S-O@0.4-1.log (check log file(s) for error details)
    shell:
        python -m skyproof attack
        (command exited with non-zero exit code)
"""


def test_finished_jobs_in_order(tmp_path):
    for age, (kind, name, row) in enumerate(
        [
            ("attack", "S-O@0.4-1", "12.5\t0:00:12\t900.25\t1\t1\t1\t1\t1\t1\t1\n"),
            ("ground", "ground", "3.0\t0:00:03\t-\t-\t-\t-\t-\t-\t-\t-\n"),
            ("score", "000", ""),  # being written
        ]
    ):
        path = tmp_path / "benchmarks" / kind / f"{name}.tsv"
        path.parent.mkdir(parents=True)
        path.write_text(HEADER + row)
        os.utime(path, (1000 - age, 1000 - age))
    jobs = finished_jobs(tmp_path)
    assert list(jobs) == ["ground/ground", "attack/S-O@0.4-1"]
    assert [*jobs.values()] == [
        Timing(stage="ground", name="ground", seconds=3.0),
        Timing(stage="attack", name="S-O@0.4-1", seconds=12.5, largest_memory_mb=900.25),
    ]


def test_the_failed_log_is_named():
    assert failed_log(LOG) == "logs/attack/S-O@0.4-1.log"
    finished = "Finished jobid: 5 (Rule: palette)\n    log: logs/x.log (check log file(s))"
    assert failed_log(finished) is None
