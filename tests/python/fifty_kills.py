"""Workers of a Dask cluster are killed at random, fifty times: every result is that of one run here, to the last bit.

    python tests/python/fifty_kills.py [folder]

with a Python in which pycostate and Dask are installed; with a folder parts are kept there. It takes two minutes.
"""

import os
import random
import signal
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pycostate
from dask.distributed import Client, LocalCluster
from pycostate import distributed

ROOT = Path(__file__).resolve().parents[2]
KILLS = 50


def begun():
    cluster = LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs="CRITICAL")
    return cluster, Client(cluster)


def killing(cluster, most, chance, ended, kills):
    """Kills one of two workers that are there, now and then."""
    while not ended.wait(chance.uniform(0.3, 1.5)) and len(kills) < most:
        there = [w.pid for w in cluster.workers.values() if w.worker_address in cluster.scheduler.workers and w.pid]
        if len(there) == 2:
            try:
                os.kill(chance.choice(there), signal.SIGKILL)
                kills.append(time.monotonic())
            except ProcessLookupError:
                pass


def main(folder=None):
    problem = pycostate.Problem.load(ROOT / "scenarios" / "pendulum.toml").using(backend="cpu")
    x = np.random.default_rng(2).uniform([-4, -6], [4, 6], (6000, 2))
    here, chance = problem.solve(x), random.Random(1)
    cluster, client = begun()
    killed, runs = 0, 0
    while killed < KILLS:
        if len(cluster.scheduler.workers) < 2:
            # Its nannies have given up.
            client.close()
            cluster.close()
            cluster, client = begun()
        ended, kills = threading.Event(), []
        thread = threading.Thread(target=killing, args=(cluster, KILLS - killed, chance, ended, kills))
        thread.start()
        own = None if folder is None else os.path.join(folder, str(runs))
        there = distributed.solve(problem, x, client, shards=12, folder=own, retries=100)
        ended.set()
        thread.join()
        killed, runs = killed + len(kills), runs + 1
        for name in here.variables:
            a, b = here[name].values, there[name].values
            assert np.array_equal(a, b, equal_nan=a.dtype.kind == "f"), name
        if own is not None:
            assert sorted(os.listdir(own)) == sorted(f"part-{k}-of-12.h5" for k in range(12))
        print(f"{runs} runs, {killed} workers killed", flush=True)
    client.close()
    cluster.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
