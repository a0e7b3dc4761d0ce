"""The clock of `fit` on a device: a slow host is not the frame's fault."""

import time

import pytest
import warp as wp

from warp_deferred.fitting import clock


@pytest.mark.gpu
def test_a_frame_that_waits_for_the_host_does_not_count(cuda_device):
    device, prepared = wp.get_device(cuda_device), []
    numbers = wp.zeros(1024, dtype=wp.float32, device=device)

    def render():
        # Longer than the copies that keep the device busy at first, between two parts of the frame.
        numbers.fill_(1.0)
        time.sleep(0.02)
        numbers.fill_(2.0)

    with wp.ScopedDevice(device):
        values = clock.frames(device, 3, prepared.append, render)
    assert len(values) == 3 and max(values) < 5.0
    assert prepared == list(range(len(prepared))) and len(prepared) > 3


def test_frames_on_the_cpu_take_what_the_host_takes():
    prepared = []
    values = clock.frames(wp.get_device("cpu"), 3, prepared.append, lambda: time.sleep(0.002))
    assert prepared == [0, 1, 2] and min(values) >= 2.0
