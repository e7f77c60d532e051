"""Reverses a sequence of steps within a fixed number of stored states (binomial checkpoints: Griewank and Walther 2000,
"Algorithm 799: Revolve").

The backward pass needs the state before each step, from the last step to the first. States that are not stored are
computed again from the last stored one. With s stored states, of which the first is the start, C(s + r, s) steps can be
reversed while no step is computed more than r + 1 times: 8 states suffice for 45 steps at r = 2, for 165 at r = 3 and
for 495 at r = 4.
"""

import math
from collections.abc import Callable
from typing import TypeVar

S = TypeVar("S")
G = TypeVar("G")


def run(stored: list[tuple[int, S]], steps: int, most: int, advance: Callable[[int, S], S]) -> S:
    """Runs `steps` steps from a start, and stores the states that the backward pass needs first; returns the last
    state.

    `stored` begins as the start, (0, state); stored states are appended with the number of steps before them, at most
    `most` in all. `advance` computes the state after a step from the number of steps before it and the state then.
    """
    if steps == 0:
        return stored[0][1]
    return advance(steps - 1, _reach(stored, steps - 1, most, advance))


def reverse(
    stored: list[tuple[int, S]],
    steps: int,
    most: int,
    advance: Callable[[int, S], S],
    backward: Callable[[int, S, G], G],
    gradient: G,
) -> G:
    """Runs steps backwards, from states as `run` left them, and returns the gradient at the start.

    `backward` computes the gradient before a step from the number of steps before it, the state then, and the gradient
    after it; `gradient` is that after the last step. Only the start is left in `stored`.
    """
    for before in reversed(range(steps)):
        gradient = backward(before, _reach(stored, before, most, advance), gradient)
        if stored[-1][0] == before > 0:
            stored.pop()
    return gradient


def _reach(stored: list[tuple[int, S]], step: int, most: int, advance: Callable[[int, S], S]) -> S:
    """Returns the state before a step, from the last stored state; stores states on the way."""
    at, state = stored[-1]
    while at < step:
        free = most - len(stored)
        to = at + _interval(step - at + 1, free + 1) if free > 0 else step
        while at < to:
            state = advance(at, state)
            at += 1
        if free > 0:
            stored.append((at, state))
    return state


def _interval(steps: int, states: int) -> int:
    """Returns after how many of at least 2 steps the next state is stored; `states` includes the one at their start."""
    sweeps = 1
    while math.comb(states + sweeps, states) < steps:
        sweeps += 1
    return max(1, steps - math.comb(states - 1 + sweeps, states - 1))
