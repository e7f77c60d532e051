"""Timing: what is called how often and in which order; no test asserts a time."""

import pytest

from benchmarks import time_together, timing


def fake_clock(monkeypatch, seconds_a_call):
    """A clock that only calls move, by name."""
    now = [0.0]
    log = []

    def make(name):
        def call():
            log.append(name)
            now[0] += seconds_a_call[name]

        return call

    monkeypatch.setattr(timing.time, "perf_counter", lambda: now[0])
    return {name: make(name) for name in seconds_a_call}, log


def test_distribution_is_of_one_call(monkeypatch):
    now = [0.0]
    durations = iter([9.0, 9.0, 9.0, *(k / 1000.0 for k in (2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22))])

    def call():
        now[0] += next(durations)

    monkeypatch.setattr(timing.time, "perf_counter", lambda: now[0])
    # Two calls to warm up and one to see how long a call is are not in the distribution.
    result = time_together({"": call}, warmup=2, repeats=11)[""]
    assert result.n == 11
    assert (result.median_ms, result.p10_ms, result.p90_ms) == pytest.approx((12.0, 4.0, 20.0))


def test_short_calls_are_batched_to_a_millisecond(monkeypatch):
    calls, log = fake_clock(monkeypatch, {"a": 0.0003})
    result = time_together(calls, warmup=1, repeats=3)["a"]
    assert len(log) == 1 + 1 + 3 * 4
    assert result.median_ms == pytest.approx(0.3)


def test_a_call_that_takes_no_time_ends(monkeypatch):
    calls, log = fake_clock(monkeypatch, {"a": 0.0})
    assert time_together(calls, warmup=1, repeats=1)["a"].median_ms == 0.0
    assert len(log) == 2 + 1000


def test_peers_take_turns_and_the_first_changes(monkeypatch):
    calls, log = fake_clock(monkeypatch, {"a": 0.01, "b": 0.02, "c": 0.03})
    result = time_together(calls, warmup=2, repeats=3)
    assert log[:9] == ["a"] * 3 + ["b"] * 3 + ["c"] * 3
    assert "".join(log[9:]) == "abcbcacab"
    assert {name: t.median_ms for name, t in result.items()} == pytest.approx({"a": 10, "b": 20, "c": 30})
