"""Where the jobs of a sweep run: worker processes of this machine, or a Ray cluster."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from experiments.engine.preparation import Preparation, preparation, prepare, words
from experiments.engine.runtime import UserError, need
from experiments.engine.worker import ALIVE, READY, Job, Reply

TRIES = 2  # of a job whose worker dies
SILENCE_S = 60.0  # after which a worker that says nothing has failed


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
    known = preparation()
    workers = [_Process(core, log, known) for core in cores(processes)[: len(jobs)]]

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

    def __init__(self, core: int | None, log: Path, known: Preparation):
        self.core, self.log, self.known = core, log, known
        self.process: subprocess.Popen[str] | None = None
        self.lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.failed: Reply | None = None  # to start: no job has a chance

    def run(self, job: Job) -> Reply:
        if self.failed is not None:
            return self.failed
        reply: Reply = {}
        for _ in range(TRIES):
            if self.process is None and (started := self._start()) != READY:
                self.failed = started
                return started
            reply = self._ask(job)
            if not reply.get("lost"):
                return reply
        return reply

    def _start(self) -> Reply:
        """A new process that is prepared, or what went wrong."""
        with open(self.log, "a") as log:
            self.process = subprocess.Popen(
                words(), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True
            )
        if self.core is not None:
            os.sched_setaffinity(self.process.pid, {self.core})
        self.lines = queue.SimpleQueue()
        reader = threading.Thread(target=_read, args=(self.process, self.lines), daemon=True)
        reader.start()
        return self._ask(self.known, patient=False)

    def _ask(self, message: dict[str, Any], patient: bool = True) -> Reply:
        """What the process answers; it is stopped where it does not.

        Args:
            message: A job, or the preparation.
            patient: Signs of life count as well: a job may take hours.
        """
        process = self.process
        assert process is not None
        assert process.stdin is not None
        try:
            process.stdin.write(json.dumps(message) + "\n")
            process.stdin.flush()
            end = time.monotonic() + SILENCE_S
            while line := self.lines.get(timeout=max(end - time.monotonic(), 0.0)):
                if (reply := json.loads(line)) != ALIVE:
                    return reply
                if patient:
                    end = time.monotonic() + SILENCE_S
        except queue.Empty:
            self.stop()
            return self._lost(f"did not answer for {SILENCE_S:.0f} s")
        except OSError:
            pass  # it has gone
        return self._lost(f"died (exit status {self._end()})")

    def _lost(self, what: str) -> Reply:
        text = self.log.read_text(errors="replace").strip()
        said = f", which ends with: {text.splitlines()[-1]}" if text else ", which is empty"
        return {"error": f"its worker {what}; see {self.log}{said}", "lost": True}

    def stop(self) -> None:
        if self.process is not None:
            self.process.kill()
            self._end()

    def _end(self) -> int:
        """Wait for the end of the process; returns its exit status."""
        process, self.process = self.process, None
        assert process is not None
        assert process.stdin is not None
        with contextlib.suppress(OSError):  # what it did not read is lost with it
            process.stdin.close()
        return process.wait()


def _read(process: subprocess.Popen[str], lines: queue.SimpleQueue[str]) -> None:
    """Hand over what a process says, a line each, and an empty one when it has gone."""
    assert process.stdout is not None
    with process.stdout:
        for line in process.stdout:
            lines.put(line)
    lines.put("")


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
        known = preparation()
        del known["process"]["sys_path"]  # another machine has its own
        numbers = {task.remote(job, known): number for number, job in enumerate(jobs)}
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


def _task(job: Job, known: Preparation) -> Reply:
    """A job in a Ray worker, which keeps its programs and its core for the next one."""
    global _worker
    from experiments.engine.runtime import start_jax
    from experiments.engine.worker import Worker

    if _worker is None:
        _claim_core()
        start_jax()
        _worker = Worker(prepare(known))
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
