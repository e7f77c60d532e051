import gc
import re
import subprocess
import sys
from functools import partial

import pytest
import torch
import warp as wp
from builders.checks import error_of, misuse_of

from wlm.interop import LaunchGraph, StepGraph, check_device, fork, no_collection, stream, to_warp


@wp.kernel(enable_backward=False, module="unique")
def _add(
    # in:
    amount: wp.array[float],
    # out:
    total: wp.array[float],
):
    i = wp.tid()
    total[i] = total[i] + amount[i]


def test_cuda_means_the_first_gpu(monkeypatch):
    monkeypatch.setattr(wp, "get_cuda_device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert check_device("cuda") == "cuda:0"
    assert check_device("cuda:1") == "cuda:1"
    assert re.search("device 'cuda:2': expected one of: cpu, cuda:0, cuda:1$", error_of(check_device, "cuda:2"))


@pytest.mark.parametrize("name", ["gpu", "", "CPU", "cpu:0", "cuda:", "cuda:x", "cuda:99", "mps"])
def test_an_unknown_device_lists_the_known_ones(name):
    assert re.search(f"^device '{name}': expected one of: cpu", error_of(check_device, name))


def test_a_gpu_that_only_warp_sees_is_refused_with_the_reason(monkeypatch):
    monkeypatch.setattr(wp, "get_cuda_device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    assert "this build of torch does not" in error_of(check_device, "cuda")


@pytest.mark.parametrize("on", [True, False])
def test_nothing_is_collected_inside_and_all_is_as_before_after(monkeypatch, on):
    seen = []
    monkeypatch.setattr(gc, "isenabled", lambda: on)
    for name in ("enable", "disable"):
        monkeypatch.setattr(gc, name, lambda name=name: seen.append(name))
    with pytest.raises(KeyError), no_collection():
        assert seen == ["disable"]
        raise KeyError
    assert seen == ["disable"] + ["enable"] * on


def test_a_wrapped_tensor_shares_memory_and_has_no_gradient(device):
    tensor = torch.arange(6.0, device=device).reshape(2, 3).requires_grad_()
    array = to_warp(tensor)
    assert array.ptr == tensor.data_ptr() and array.shape == (2, 3) and array.dtype == wp.float32
    assert not array.requires_grad and array.grad is None and tensor.grad is None
    assert to_warp(tensor, wp.vec3).shape == (2,)


def test_a_wrapped_tensor_keeps_its_memory_alive(device):
    array = to_warp(torch.full((1000,), 7.0, device=device))
    torch.zeros(1000, device=device)
    assert (array.numpy() == 7.0).all()


def test_the_stream_orders_torch_and_warp(device):
    n = 1 << 20
    ones = torch.ones(n, device=device)
    total = torch.zeros(n, device=device)
    amount, sums = to_warp(ones), to_warp(total)
    for _ in range(20):
        ones.add_(1.0)  # outside, on the default stream
        with stream(device) as side:
            assert (side is None) == (device == "cpu")
            wp.launch(_add, dim=n, inputs=[amount], outputs=[sums], device=device)
            total.mul_(0.5)
            with stream(device) as inner:
                assert inner == side
                wp.launch(_add, dim=n, inputs=[amount], outputs=[sums], device=device)
        total.sub_(1.0)  # outside again
    expected = 0.0
    for step in range(20):
        expected = (expected + step + 2) * 0.5 + step + 2 - 1
    assert torch.all(total == expected)


@pytest.mark.parametrize("works", [1, 3])
def test_forked_works_are_one_step_of_a_graph(device, works):
    totals = torch.zeros(works, 1 << 20, device=device)
    arrays = [to_warp(total) for total in totals]
    first = torch.zeros_like(totals[0])

    def work(number: int) -> None:
        totals[number].add_(first)
        wp.launch(_add, dim=1 << 20, inputs=[arrays[number]], outputs=[arrays[number]], device=device)

    def step() -> None:
        first.add_(1.0)
        fork(device, [partial(work, number) for number in range(works)])
        first.copy_(totals.sum(0) / works)

    graph = StepGraph(step, device, warmup=1)
    expected = 0.0
    for _ in range(6):
        graph()
        expected = 2.0 * (expected + expected + 1.0)
    assert torch.all(first == expected)


def test_an_error_inside_the_stream_passes_through(device):
    with pytest.raises(KeyError), stream(device):
        raise KeyError("x")
    with stream(device) as side:
        assert device == "cpu" or side is not None


@pytest.mark.parametrize("warmup", [1, 3])
def test_each_call_of_a_step_graph_is_one_step(device, warmup):
    total = torch.zeros(8, device=device)
    amount = torch.zeros(8, device=device)
    wrapped_amount, wrapped_total = to_warp(amount), to_warp(total)

    def step() -> None:
        amount.add_(1.0)
        wp.launch(_add, dim=8, inputs=[wrapped_amount], outputs=[wrapped_total], device=device)

    graph = StepGraph(step, device, warmup=warmup)
    for count in range(1, 8):
        graph()
        assert torch.all(total == count * (count + 1) / 2)
        assert graph.captured == (device != "cpu" and count > warmup)


def test_each_call_of_a_launch_graph_is_one_step(device):
    amount, total = (wp.full(8, float(value), dtype=float, device=device) for value in (2, 0))
    add = partial(wp.launch, _add, dim=8, inputs=[amount], outputs=[total], device=device)
    graph = LaunchGraph(add, device, warmup=2)
    for count in range(1, 8):
        graph()
        assert (total.numpy() == 2 * count).all()


def test_a_step_graph_passes_an_error_on_and_wants_a_warm_up(device):
    def broken() -> None:
        raise KeyError("x")

    with pytest.raises(KeyError):
        StepGraph(broken, device)()
    assert "warmup" in misuse_of(StepGraph, broken, device, warmup=0)


@pytest.mark.slow
def test_a_tensor_is_wrapped_before_anything_has_started_warp():
    """A new process makes its first call of Warp here."""
    program = "import torch; from wlm.interop import to_warp; print(to_warp(torch.arange(3.0)).numpy().sum())"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0 and done.stdout.split()[-1] == "3.0"
