"""The points that shadow rays go to."""

from __future__ import annotations

import numpy as np
import warp as wp
from warp_deferred.kernels.shadow_rays import net_point

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def net_kernel(out_points: wp.array[wp.vec2]):
    i = wp.tid()
    out_points[i] = net_point(i)


def test_sixteen_points_are_a_net(device):
    points = wp.zeros(16, dtype=wp.vec2, device=device)
    wp.launch(net_kernel, 16, outputs=[points], device=device)
    p = points.numpy()
    # One in every rectangle of area 1/16 whose sides are powers of a half, and the middle as their mean.
    for k in range(5):
        cells = np.floor(p * [2**k, 2 ** (4 - k)]) @ [16, 1]
        assert len(np.unique(cells)) == 16, k
    assert np.array_equal(p.mean(axis=0), [0.5, 0.5])
