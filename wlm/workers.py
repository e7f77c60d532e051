"""Parallel work: in threads, or by objects in this process or its threads, in other processes, or on a Ray cluster.

Callers submit method calls, one at a time per object, and receive the results in order of completion.
Processes on this machine use the standard library alone: Ray takes seconds to start, needs 250 MB and leaves log
files behind, without a benefit on one machine.
"""

import importlib
import os
import pickle
import queue
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import IO, Any, TypeVar

from wlm.errors import WlmError

_PROTOCOL = 5  # large arrays aren't copied
_PATIENCE = 2.0  # seconds that an idle process gets to end by itself
_ANSWER = 10.0  # seconds that a cluster gets to accept a connection
_THREADS = 16  # maximum number: each needs the memory of its call
_TOLD = 2000  # bytes read from the error output of a dead process

_Item = TypeVar("_Item")
_Answer = TypeVar("_Answer")


class Lost(Exception):
    """The worker object no longer exists and its result is lost; the message gives the reason."""


def cores() -> int:
    """Returns the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def each(call: Callable[[_Item], _Answer], items: Iterable[_Item], most: int = _THREADS) -> Iterator[_Answer]:
    """Calls a function with each item, in at most so many threads, and yields the results in the items' order.

    Threads help because NumPy releases Python's lock while it computes. If a call raises or the caller stops, calls
    that haven't started are cancelled.
    """
    pool = ThreadPoolExecutor(min(cores(), most))
    try:
        yield from pool.map(call, items)
    finally:
        pool.shutdown(cancel_futures=True)


class Workers(ABC):
    """Worker objects of one class, numbered from 0 to `count` - 1; `remote` tells whether they run in parallel with
    this process."""

    count: int
    remote = True
    _answers: queue.SimpleQueue[tuple[int, Any]]

    @abstractmethod
    def call(self, number: int, method: str, *arguments: Any) -> None:
        """Starts a method call on a worker that has no call in progress."""

    def wait(self, seconds: float) -> tuple[int, Any] | None:
        """Waits for the next result, at most some seconds; None if there was none in that time. Returns the worker's
        number and the method's return value, the exception that it raised, or `Lost` if the worker no longer exists."""
        try:
            return self._answers.get(timeout=seconds)
        except queue.Empty:
            return None

    @abstractmethod
    def renew(self, number: int) -> None:
        """Creates a lost worker again."""

    @abstractmethod
    def close(self) -> None:
        """Ends all workers, including those with a call in progress."""


class Here(Workers):
    """A single `worker` in this process; it executes its call in `wait`."""

    count = 1
    remote = False

    def __init__(self, worker: Any) -> None:
        """Wraps a worker object, which must have a method `close`."""
        self.worker, self._call = worker, ("", ())

    def call(self, number: int, method: str, *arguments: Any) -> None:
        self._call = method, arguments

    def wait(self, seconds: float) -> tuple[int, Any]:
        (method, arguments), self._call = self._call, ("", ())
        try:
            return 0, getattr(self.worker, method)(*arguments)
        except Exception as error:
            return 0, error

    def renew(self, number: int) -> None:
        raise AssertionError("this process is not lost")

    def close(self) -> None:
        self.worker.close()


class Threads(Workers):
    """Workers in threads of this process, for work that leaves Python idle, as that of several GPUs does. They share
    the process's data and kernels, and start at once; they end after their current call."""

    def __init__(self, workers: list[Any]) -> None:
        """Takes worker objects as `Here` does; only one thread at a time calls an object's methods."""
        self.count, self._workers, self._answers = len(workers), workers, queue.SimpleQueue()
        self._pool = ThreadPoolExecutor(self.count)

    def call(self, number: int, method: str, *arguments: Any) -> None:
        self._pool.submit(self._run, number, method, arguments)

    def _run(self, number: int, method: str, arguments: tuple[Any, ...]) -> None:
        try:
            answer = getattr(self._workers[number], method)(*arguments)
        except Exception as error:
            answer = error
        self._answers.put((number, answer))

    def renew(self, number: int) -> None:
        raise AssertionError("a thread is not lost")

    def close(self) -> None:
        self._pool.shutdown()
        for worker in self._workers:
            worker.close()


class Processes(Workers):
    """Workers in separate processes on this machine. A worker process ends when its parent process ends for any reason,
    at the latest after its current call."""

    def __init__(self, make: type, arguments: list[tuple[Any, ...]]) -> None:
        """Starts the processes. `make` is the class of the workers, from an importable module. `arguments` are the
        constructor arguments of each worker."""
        self.count = len(arguments)
        self._make, self._arguments = make, arguments
        self._answers = queue.SimpleQueue()
        self._processes: dict[int, subprocess.Popen[bytes]] = {}
        self._errors: dict[int, IO[bytes]] = {}
        try:
            for number in range(self.count):
                self._start(number)
        except WlmError:
            self.close()
            raise

    def call(self, number: int, method: str, *arguments: Any) -> None:
        # If the process has ended, `wait` reports it.
        with suppress(OSError):
            _send(self._processes[number].stdin, (method, arguments))

    def renew(self, number: int) -> None:
        self._end(number)
        self._start(number)

    def close(self) -> None:
        for process in self._processes.values():
            with suppress(OSError):
                process.stdin.close()
        end = time.monotonic() + _PATIENCE
        for number in list(self._processes):
            self._end(number, max(0.0, end - time.monotonic()))

    def _start(self, number: int) -> None:
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)}
        # Without this, NumPy would start one thread per core in each process.
        environment.setdefault("OPENBLAS_NUM_THREADS", str(max(1, cores() // self.count)))
        # Ctrl-C in a terminal signals the whole process group; workers must survive it to return their state.
        group = {"process_group": 0} if os.name == "posix" else {}
        command = [sys.executable, "-P", "-c", f"from {__name__} import serve; serve()"]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        try:
            errors = tempfile.TemporaryFile()  # noqa: SIM115  (closed with its process)
            process = subprocess.Popen(command, stderr=errors, env=environment, **pipes, **group)
        except OSError as error:
            raise WlmError(f"workers: cannot start process {number}: {error.strerror or error}") from error
        self._processes[number], self._errors[number] = process, errors
        threading.Thread(target=self._listen, args=(number, process, errors), daemon=True).start()
        with suppress(OSError):
            _send(process.stdin, (self._make.__module__, self._make.__qualname__, self._arguments[number]))

    def _listen(self, number: int, process: subprocess.Popen[bytes], errors: IO[bytes]) -> None:
        try:
            while True:
                self._answers.put((number, pickle.load(process.stdout)))
        except (EOFError, OSError, ValueError, pickle.UnpicklingError):
            code = process.wait()
            # A process that was replaced or closed has no pending call.
            if self._processes.get(number) is process:
                self._answers.put((number, Lost(_reason(code, errors))))

    def _end(self, number: int, patience: float = 0.0) -> None:
        process = self._processes.pop(number)
        try:
            process.wait(patience)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        with suppress(OSError):
            process.stdin.close()
        self._errors.pop(number).close()


class Actors(Workers):
    """Workers on a Ray cluster, each with its own resources."""

    def __init__(self, make: type, arguments: tuple, count: int | None, most: int, address: str, share: dict) -> None:
        """Connects to the cluster at an address, as for `ray.init`, and requests the workers; they start when resources
        become free.

        `make`, their class, is from a module that every machine of the cluster can import. There are `count` workers,
        None for all resources of the cluster, but at most `most`, each of which takes a `share`, `{"CPU": 2}` or
        `{"GPU": 1}`.
        """
        try:
            import ray
        except ModuleNotFoundError as error:
            raise WlmError('cluster: expected the package Ray, found none: pip install "wlm[cluster]"') from error
        self._ray, self._mine = ray, not ray.is_initialized()
        if self._mine:
            _connect(ray, address)
        ((resource, each),) = share.items()
        room = int(ray.cluster_resources().get(resource, 0.0) // each)
        if not room:
            self._leave()
            raise WlmError(f"cluster {address}: expected at least {each:g} {resource} for a worker, found fewer")
        self.count = min(most, count or room)
        options = {"num_gpus": share.get("GPU", 0), "num_cpus": share.get("CPU", 1)}
        self._make, self._arguments = ray.remote(make).options(**options), arguments
        self._actors = {number: self._make.remote(*arguments) for number in range(self.count)}
        self._calls: dict[Any, int] = {}

    def call(self, number: int, method: str, *arguments: Any) -> None:
        self._calls[getattr(self._actors[number], method).remote(*arguments)] = number

    def wait(self, seconds: float) -> tuple[int, Any] | None:
        done, _ = self._ray.wait(list(self._calls), num_returns=1, timeout=seconds)
        if not done:
            return None
        number = self._calls.pop(done[0])
        try:
            return number, self._ray.get(done[0])
        except self._ray.exceptions.RayTaskError as error:
            return number, error.cause
        except self._ray.exceptions.RayError as error:
            lines = [line.strip() for line in str(error).splitlines() if line.strip()]
            # If a worker couldn't be created, the last line of the message gives the reason.
            return number, Lost(lines[-1 if "creation task" in lines[0] else 0])

    def renew(self, number: int) -> None:
        self._actors[number] = self._make.remote(*self._arguments)

    def close(self) -> None:
        for actor in self._actors.values():
            self._ray.kill(actor)
        self._leave()

    def _leave(self) -> None:
        if self._mine:
            self._ray.shutdown()


def _connect(ray: Any, address: str) -> None:
    """Connects to a cluster and restores the SIGTERM handler that Ray replaces."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdigit():
        # Ray would retry for minutes, so a plain connection is tried first.
        try:
            socket.create_connection((host, int(port)), _ANSWER).close()
        except (OSError, OverflowError) as error:
            raise WlmError(f"cluster {address}: cannot connect: {error}") from error
    main = threading.current_thread() is threading.main_thread()
    before = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(address=address, log_to_driver=False, logging_level="ERROR")
    except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
        reason = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
        raise WlmError(f"cluster {address}: {reason}") from error
    finally:
        if main:
            signal.signal(signal.SIGTERM, before)


def serve() -> None:
    """Runs a worker of `Processes`: creates the object and executes the calls from stdin until stdin is closed."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # output of libraries must not mix with results
    with suppress(EOFError, BrokenPipeError):
        module, name, arguments = pickle.load(sys.stdin.buffer)
        worker, answer = None, None
        try:
            worker = getattr(importlib.import_module(module), name)(*arguments)
        except Exception as error:
            answer = _sendable(error)
        while True:
            method, arguments = pickle.load(sys.stdin.buffer)
            if worker is not None:
                try:
                    answer = getattr(worker, method)(*arguments)
                except Exception as error:
                    answer = _sendable(error)
            _send(answers, answer)


def _send(stream: IO[bytes], message: Any) -> None:
    pickle.dump(message, stream, _PROTOCOL)
    stream.flush()


def _sendable(error: Exception) -> Exception:
    """Converts an exception to one that can be pickled, with the location where it was raised."""
    if not isinstance(error, WlmError):
        error.add_note("".join(traceback.format_exception(error)))
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError("".join(traceback.format_exception(error)))
    return error


def _reason(code: int, errors: IO[bytes]) -> str:
    with suppress(OSError, ValueError):
        size = errors.seek(0, os.SEEK_END)
        errors.seek(max(0, size - _TOLD))
        lines = errors.read().decode(errors="replace").splitlines()
        last = f": {lines[-1]}" if lines else ""
        return (f"it was ended by signal {-code}" if code < 0 else f"it ended with code {code}") + last
    return f"it ended with code {code}"
