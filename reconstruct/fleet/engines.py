"""Where jobs run: processes of this machine, or tasks of a Ray cluster; see :func:`reconstruct.fleet.job.run_job`."""

from __future__ import annotations

import os
import threading
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import Any, Protocol

from reconstruct.errors import TaaError
from reconstruct.fleet.job import run_job

GB = 1 << 30


@dataclass(frozen=True)
class Needs:
    """What a job takes: CPU cores, a share of one GPU, bytes of memory."""

    cpus: float = 1.0
    gpus: float = 0.0
    memory: int = 3 * GB


class Engine(Protocol):
    """Runs jobs. ``words``: one line on where."""

    words: str

    def room(self) -> int:
        """How many further jobs to hand over now."""

    def submit(self, job: dict, needs: Needs) -> None:
        """Hand a job over."""

    def collect(self, seconds: float) -> list[tuple[dict, dict]]:
        """(job, answer) of those that ended, after at most that time."""

    def close(self) -> None:
        """End what still runs."""


class Local:
    """Processes of this machine, ``workers`` at a time; jobs that need a GPU share those there are.

    Args:
        workers: None for as many as cores and memory allow.
    """

    def __init__(self, workers: int | None = None) -> None:
        cores = len(os.sched_getaffinity(0))
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        self.workers = workers or max(1, min(cores, memory // (4 * GB)))
        self._threads = max(1, cores // self.workers)
        self._pool = ThreadPoolExecutor(self.workers)
        self._stop = threading.Event()
        self._running: dict[Future, dict] = {}
        self._gpu = threading.Condition()
        self._gpus = _gpus() or 1.0  # without a GPU such jobs run one at a time, on the processor
        self.words = f"{self.workers} processes of {self._threads} threads"

    def room(self) -> int:
        return self.workers - len(self._running)

    def submit(self, job: dict, needs: Needs) -> None:
        self._running[self._pool.submit(self._run, job, needs)] = job

    def _run(self, job: dict, needs: Needs) -> dict:
        with self._gpu:
            self._gpu.wait_for(lambda: self._gpus >= min(needs.gpus, 1.0) - 1e-9)
            self._gpus -= needs.gpus
        try:
            return run_job(job, self._threads, self._stop)
        finally:
            with self._gpu:
                self._gpus += needs.gpus
                self._gpu.notify_all()

    def collect(self, seconds: float) -> list[tuple[dict, dict]]:
        done, _ = wait(self._running, timeout=seconds, return_when=FIRST_COMPLETED)
        return [(self._running.pop(future), future.result()) for future in done]

    def close(self) -> None:
        self._stop.set()
        self._pool.shutdown(wait=True, cancel_futures=True)


class OnRay:
    """Tasks of a Ray cluster: the one this process is connected to, that of ``$RAY_ADDRESS``, or a local one it starts.

    Videos, scenes and assets are read and written by path, so all nodes need the same file system. A node that dies
    takes its tasks along; Ray starts them again elsewhere, and what a scene folder holds by then is not made twice.

    Args:
        workers: cores of a local cluster; also the most tasks at once.
        retries: how often Ray itself starts a task again whose node or worker died.

    Raises:
        TaaError: Ray is not installed, or no cluster answers.
    """

    def __init__(self, workers: int | None = None, retries: int = 2) -> None:
        try:
            import ray
        except ImportError:
            raise TaaError("--engine ray needs the package ray; install it with: pip install 'taa-envs[ray]'") from None
        self._ray, self._limit = ray, workers
        self._started = not ray.is_initialized()
        if self._started:
            address = os.environ.get("RAY_ADDRESS")
            try:
                ray.init(
                    address=address,
                    num_cpus=None if address else workers,
                    log_to_driver=False,
                    include_dashboard=None if address else False,
                    logging_level="error",
                )
            except ConnectionError as error:
                raise TaaError(
                    f"no Ray cluster answers at {address} ({' '.join(str(error).split())[:80]}); start it with "
                    "`ray start --head` or unset RAY_ADDRESS"
                ) from None
        self._task = ray.remote(max_retries=retries, retry_exceptions=False)(run_job)
        self._running: dict[Any, dict] = {}
        self.words = f"Ray with {len([n for n in ray.nodes() if n['Alive']])} nodes, {self._cores():g} cores"

    def _cores(self) -> float:
        return self._ray.cluster_resources().get("CPU", 0.0)

    def room(self) -> int:
        # A few more than there are cores, so that none waits for the next; the rest stays in the manifest's hands.
        most = int(self._cores()) + 2
        return min(most, self._limit or most) - len(self._running)

    def submit(self, job: dict, needs: Needs) -> None:
        largest = max((n["Resources"].get("memory", 0) for n in self._ray.nodes() if n["Alive"]), default=0)
        if needs.gpus and not self._ray.cluster_resources().get("GPU"):
            needs = Needs(needs.cpus, 0.0, needs.memory)
        task = self._task.options(
            num_cpus=needs.cpus, num_gpus=needs.gpus, memory=int(min(needs.memory, 0.9 * largest))
        )
        self._running[task.remote(job, max(1, round(needs.cpus)))] = job

    def collect(self, seconds: float) -> list[tuple[dict, dict]]:
        ray = self._ray
        if not self._running:
            return []
        done, _ = ray.wait(list(self._running), num_returns=1, timeout=seconds)
        ended = []
        for reference in done:
            job = self._running.pop(reference)
            try:
                ended.append((job, ray.get(reference)))
            except ray.exceptions.RayError as error:
                words = " ".join(str(error).split())[:120]
                ended.append(
                    (
                        job,
                        {"state": "died", "result": "", "error": f"the node or worker died ({words})", "seconds": 0.0},
                    )
                )
        return ended

    def close(self) -> None:
        for reference in self._running:
            self._ray.cancel(reference, force=True)
        if self._started:
            self._ray.shutdown()


def make_engine(name: str, workers: int | None, retries: int) -> Engine:
    """The engine of that name.

    Raises:
        TaaError: there is none, or it cannot run here.
    """
    if name == "local":
        return Local(workers)
    if name == "ray":
        return OnRay(workers, retries)
    raise TaaError(f"no engine is named {name!r}; known: local, ray")


def _gpus() -> float:
    """Number of GPUs that PyTorch would use, without importing it where no driver is."""
    if not os.path.exists("/proc/driver/nvidia/version"):
        return 0.0
    import torch

    return float(torch.cuda.device_count())
