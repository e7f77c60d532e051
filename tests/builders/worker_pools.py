"""Workers that answer in any order and get lost, in place of those of other processes; and small classes of workers."""

import os
import random
import signal
import time

import numpy as np

from wlm.dispatch import Whole
from wlm.errors import WlmError
from wlm.workers import Here, Lost, Workers


class Several(Workers):
    """Workers in this process: any may answer next, and those of the answers of some numbers are lost.

    The arguments are those of `wlm.dispatch.start_workers`, then a seed of the order and the numbers.
    """

    remote = False

    def __init__(self, worker, place, tasks, *, order=0, lose=()):
        self.count, self._make = min(place.workers or 1, tasks), lambda: Here(worker[0](place.device, *worker[1:]))
        self._random, self._lose = random.Random(order), lose
        self._workers = [self._make() for _ in range(self.count)]
        self._called, self._answers = [], 0

    def call(self, number, method, *arguments):
        self._workers[number].call(number, method, *arguments)
        self._called.append(number)

    def wait(self, seconds):
        number = self._called.pop(self._random.randrange(len(self._called)))
        self._answers += 1
        if self._answers in self._lose:
            return number, Lost("it was unlucky")
        return number, self._workers[number].wait(seconds)[1]

    def renew(self, number):
        self._workers[number].close()
        self._workers[number] = self._make()

    def close(self):
        for worker in self._workers:
            worker.close()


class ToyBaker(Whole):
    """Stands for `wlm.bake.work.HourBaker`, which needs Mitsuba: the light of an hour is the hour."""

    def __init__(self, device, gather, points, scene, geometry, sky):
        assert geometry.surfaces and not geometry.document.buffers
        self._count = len(points)

    def run(self, job):
        for share in (0.5, 1.0):
            self.report(share)
        light = np.full((self._count, 3), job, np.float32)
        return {"mean": light, "noise": light / 10, "back": np.zeros(self._count, np.float32)}


class ToyWorker(Whole):
    """Multiplies numbers by a factor; texts as tasks make it fail."""

    def __init__(self, device, factor):
        self._factor = factor

    def run(self, job):
        if job == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        if job == "fail":
            raise WlmError("a.exr: expected light")
        if job == "sleep":
            time.sleep(60.0)
        return (lambda: 0) if job == "unsendable" else self._factor * job
