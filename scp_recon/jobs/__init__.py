"""Run many jobs, in processes or on a cluster, and keep the results of finished ones.

A *job* is a key and its inputs; the *work* is a function of the inputs that pickles: one of a module, a
`partial` of one, or an instance of a dataclass. What it returns depends on the inputs alone.

    from scp_recon.jobs.job import Job, here, in_order
    from scp_recon.jobs.processes import Limits, Processes
    from scp_recon.jobs.store import Store, run

    jobs = [Job("cold", 0.9), Job("warm", 0.8)]
    with Store(out / "study.jsonl", {"version": 1, "seed": 1}) as store:
        run(work, jobs, store, Processes(2, Limits(seconds=600.0)))   # those that have no row yet
        rows = [store[job.key] for job in jobs]

An executor is called with the work and the jobs, and yields a `Done` for each job as it ends:
`here` (this process), `Processes` (local processes with limits of time and memory), `Cluster`
(Dask). `in_order` yields results in the order of the jobs without a store. A job that raises, hangs
or dies is a `Done` with a `Failure`.
"""
