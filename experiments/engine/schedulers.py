"""Where the jobs of a sweep run: worker processes of this machine, or a Ray cluster."""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from experiments.engine.runtime import UserError, need
from experiments.engine.worker import Job, Reply

SERVE = "sweep-worker"  # the hidden command that a worker process is started with
TRIES = 2  # of a job whose worker dies


def cores(processes: int) -> list[int | None]:
    """A core for each process, where they are to share them out; else wherever they like.

    Two runs that spread over the same cores slow each other down several times.
    """
    if not hasattr(os, "sched_getaffinity"):
        return [None] * processes
    found = sorted(os.sched_getaffinity(0))
    return list(found[:processes]) if processes == len(found) else [None] * processes


def local(jobs: Sequence[Job], processes: int, log: Path) -> Iterator[tuple[int, Reply]]:
    """Run jobs on worker processes, each on a core of its own where they use all of them.

    Args:
        jobs: In order; a worker takes the next one when it is free.
        processes: Workers at the same time.
        log: File for what they print.

    Yields:
        (number of the job, reply), as they finish.
    """
    waiting: queue.SimpleQueue[int] = queue.SimpleQueue()
    for number in range(len(jobs)):
        waiting.put(number)
    done: queue.SimpleQueue[tuple[int, Reply]] = queue.SimpleQueue()
    workers = [_Process(core, log) for core in cores(processes)[: len(jobs)]]

    def work(worker: _Process) -> None:
        while True:
            try:
                number = waiting.get_nowait()
            except queue.Empty:
                return
            done.put((number, worker.run(jobs[number])))

    threads = [threading.Thread(target=work, args=(w,), daemon=True) for w in workers]
    try:
        for thread in threads:
            thread.start()
        for _ in jobs:
            yield done.get()
    finally:
        while not waiting.empty():  # a caller that stops early leaves nothing behind
            waiting.get()
        for worker in workers:
            worker.stop()


class _Process:
    """A worker process, started when it gets its first job and again where it died."""

    def __init__(self, core: int | None, log: Path):
        self.core, self.log = core, log
        self.process: subprocess.Popen[str] | None = None

    def run(self, job: Job) -> Reply:
        code = None
        for _ in range(TRIES):
            process = self.process or self._start()
            try:
                assert process.stdin is not None
                assert process.stdout is not None
                process.stdin.write(json.dumps(job) + "\n")
                process.stdin.flush()
                answer = process.stdout.readline()
            except OSError:
                answer = ""
            if answer:
                return json.loads(answer)
            code = process.wait()
            self.process = None
        return {"error": f"its worker died (exit status {code}); see {self.log}"}

    def _start(self) -> subprocess.Popen[str]:
        # the program that was called: it may have registered methods or environments of its own
        words = [sys.executable, sys.argv[0], SERVE]
        with open(self.log, "a") as log:
            self.process = subprocess.Popen(
                words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True
            )
        if self.core is not None:
            os.sched_setaffinity(self.process.pid, {self.core})
        return self.process

    def stop(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()


def here(jobs: Sequence[Job]) -> Iterator[tuple[int, Reply]]:
    """Run jobs in this process: on an accelerator, which has one owner."""
    from experiments.engine.worker import Worker

    worker = Worker()
    for number, job in enumerate(jobs):
        yield number, worker.run(job)


def ray_cluster(jobs: Sequence[Job], address: str | None) -> Iterator[tuple[int, Reply]]:
    """Run jobs as tasks of a Ray cluster, a core each.

    Ray starts a task again where its node is lost; a task's result comes once.

    Args:
        jobs: In order.
        address: Address of a running cluster; None starts one on this machine.

    Raises:
        UserError: If Ray is not installed or the cluster cannot be reached.
    """
    ray = need("ray", "ray", "engine ray")
    from ray.exceptions import RayError

    try:
        ray.init(address=address, log_to_driver=False, configure_logging=False)
    except (ConnectionError, RayError, RuntimeError, ValueError) as error:
        raise UserError(f"address: no Ray cluster at {address!r}: {error}") from error
    task = ray.remote(num_cpus=1, max_retries=-1)(_task)
    try:
        numbers = {task.remote(job, sys.argv[0]): number for number, job in enumerate(jobs)}
        left = list(numbers)
        while left:
            ready, left = ray.wait(left, num_returns=1)
            try:
                reply = ray.get(ready[0])
            except RayError as error:
                reply = {"error": f"Ray: {str(error).splitlines()[0]}"}
            yield numbers[ready[0]], reply
    finally:
        ray.shutdown()


def _task(job: Job, program: str) -> Reply:
    """A job in a Ray worker, which keeps its programs and its core for the next one.

    The program that was called is run first, without its main part, where it is a script: it may
    register methods or environments of its own.
    """
    global _worker
    import runpy

    from experiments.engine.runtime import start_jax
    from experiments.engine.worker import Worker

    if _worker is None:
        _claim_core()
        start_jax()
        if program.endswith(".py"):
            runpy.run_path(program, run_name="worker")
        _worker = Worker()
    return _worker.run(job)


_worker: Any = None
_claimed: Any = None


def _claim_core() -> None:
    """Stay on a core that no other worker of this machine has."""
    global _claimed
    import fcntl
    import tempfile

    if not hasattr(os, "sched_setaffinity"):
        return
    for core in sorted(os.sched_getaffinity(0)):
        file = open(Path(tempfile.gettempdir()) / f"ppl_jax_core_{core}.lock", "w")  # noqa: SIM115
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.close()
            continue
        _claimed = file  # held as long as the process lives
        os.sched_setaffinity(0, {core})
        return
