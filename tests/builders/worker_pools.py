"""Workers that answer in any order and get lost, in place of those of other processes."""

import random

from wlm.workers import Here, Lost, Workers


class Several(Workers):
    """Workers in this process: any may answer next, and those of the answers of some numbers are lost.

    The arguments are those of `wlm.dispatch.start_workers`, then a seed of the order and the numbers.
    """

    remote = False

    def __init__(self, make, arguments, device, workers, cluster, tasks, usual=1, *, order=0, lose=()):
        self.count, self._make = min(workers or 1, tasks), lambda: Here(make(device, *arguments))
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
