"""Progress of a reproduction, from files as Snakemake leaves them."""

import os

from skyproof.reproduction.snakemake import failed_job, finished_jobs
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
# As the plug-in for Slurm leaves them, shortened.
REFUSED = """
[Mon Nov 23 08:36:52 2026]
Error in rule ground_0:
    message: SLURM sbatch failed. The error message was 'sbatch: error: invalid partition: nowhere
sbatch: error: Batch job submission failed: Invalid partition name specified'.
    sbatch call:
        sbatch --parsable --comment rule_ground_0   -p nowhere --wrap="python -m snakemake"
For further error details see the cluster/cloud log and the log files of the involved rule(s).
    jobid: 1
    log: logs/ground/ground.log (check log file(s) for error details)
"""
ENDED = """
[Mon Nov 23 08:35:33 2026]
Error in rule score_15:
    message: SLURM-job '16' failed, SLURM status is: 'FAILED'. Reason: Unknown.For further details.
    jobid: 16
    log: logs/score/001.log, /run/.snakemake/slurm_logs/rule_score_15/16.log (check log file(s) for)
    external_jobid: 16
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


def test_the_failed_job_is_named():
    assert failed_job(LOG) == (["logs/attack/S-O@0.4-1.log"], "")
    finished = "Finished jobid: 5 (Rule: palette)\n    log: logs/x.log (check log file(s))"
    assert failed_job(finished) is None


def test_what_a_cluster_says_of_a_failed_job():
    logs = ["logs/score/001.log", "/run/.snakemake/slurm_logs/rule_score_15/16.log"]
    assert failed_job(ENDED + LOG) == (logs, "")
    late = ENDED.replace("'FAILED'", "'TIMEOUT'")
    assert failed_job(late + LOG) == (logs, "Slurm says TIMEOUT")
    # What an earlier try printed is not why this one was refused.
    why = (
        "sbatch: error: invalid partition: nowhere sbatch: error: Batch job submission failed: "
        "Invalid partition name specified"
    )
    assert failed_job(REFUSED + LOG) == ([], why)
