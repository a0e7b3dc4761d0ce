"""Distance of two pictures: equal to NumPy's, whatever the number of pixels."""

import numpy as np
import pytest
import warp as wp
from warp_deferred.kernels import picture_error


def squares(first, second, device):
    words = [wp.array(image.view(np.uint32).reshape(-1), dtype=wp.uint32, device=device) for image in (first, second)]
    total = wp.zeros(1, dtype=wp.int64, device=device)
    wp.launch(
        picture_error.sum_squares_kernel, dim=min(picture_error.THREADS, words[0].size), inputs=words, outputs=[total],
        device=device, block_dim=picture_error.BLOCK_DIM,
    )  # fmt: skip
    return int(total.numpy()[0])


@pytest.mark.parametrize("pixels", [1, 255, picture_error.THREADS, picture_error.THREADS + 1, 200_003])
def test_sum_of_squares_is_exact(device, rng, pixels):
    first, second = rng.integers(0, 256, (2, pixels, 4), dtype=np.uint8)
    expected = ((first[:, :3].astype(np.int64) - second[:, :3]) ** 2).sum()
    assert squares(first, second, device) == squares(second, first, device) == expected
    assert squares(first, first, device) == 0


def test_alpha_does_not_count_and_the_largest_difference_does(device):
    black, white = np.zeros((70_000, 4), np.uint8), np.full((70_000, 4), 255, np.uint8)
    assert squares(black, white, device) == 3 * 70_000 * 255**2
    white[:, :3] = 0
    assert squares(black, white, device) == 0
