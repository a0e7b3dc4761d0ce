"""How far two medians of repeated times may lie apart although nothing changed.

A median of n times spreads with the standard error 1 / (2 f √n), f the density at the median (David and Nagaraja 2003,
"Order Statistics", section 10.2). A result keeps no times, only their 5th and 95th percentile; where times crowd about
their median, f is at least 0.9 / (p95 - p5), which even times of equal likelihood attain, so that the error is at most
(p95 - p5) / (1.8 √n). Two of them make Welch's statistic (Welch 1947); its limit is Student's, with a chance of a false
alarm of `ALARM` in a whole comparison, shared among its times (Bonferroni). Times that jump between two levels, with
the median in the gap, break the assumption: the bound is then too small, and a false alarm may come.

Spreads within a run are not all: memory lies elsewhere in the next one, clocks and neighbours differ. What two runs of
the same code differ by comes on top: `DRIFT` of a time, and `FLOOR_MS`.
"""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np

__all__ = ["ALARM", "DRIFT", "FLOOR_MS", "Sample", "limit", "student"]

#: Chance that a comparison of results of the same code names any time.
ALARM = 0.05
#: Share of a time, and milliseconds on top, by which runs of the same code differ beyond their spreads.
#: cuda: of 84 medians of clusters, resolve, lights, culling and display in the H200 results of commits 44ef234 and
#: 00d399c, between which their work stayed the same, 78 differ by at most the share and 83 by at most both; the one
#: left, 10 000 lights in tiles of 8 px at 4K, got 16 times faster. The milliseconds are what two events cannot tell,
#: each with half a microsecond (CUDA Runtime API, `cudaEventElapsedTime`).
#: cpu: the frame and its passes in all pairs of 8 runs of `frame` on 2 cores, one after the other, and of 4 runs beside
#: other work: all 272 medians. A machine that does other work in one run only differs by a factor.
DRIFT = {"cuda": 0.03, "cpu": 0.25}
FLOOR_MS = {"cuda": 0.001, "cpu": 0.03}
#: Nodes of the integral over Student's density.
NODES = 20_001


@dataclasses.dataclass(frozen=True)
class Sample:
    """Median and spread of a time, and how many measurements they are of.

    Attributes:
        median: Median, in any unit.
        spread: From the 5th to the 95th percentile, >= 0.
        repeats: Number of measurements, > 1.
    """

    median: float
    spread: float
    repeats: int

    @property
    def error(self) -> float:
        """Upper bound of the median's standard error."""
        return self.spread / (1.8 * math.sqrt(self.repeats))


@functools.cache
def student(chance: float, freedom: float) -> float:
    """Value that Student's t exceeds, up or down, with a chance.

    With t = √n tan θ the density is that of cos^(n-1) θ, which a sum over equal steps integrates.

    Args:
        chance: Of both tails together, in (0, 1).
        freedom: Degrees of freedom n, >= 1.
    """
    angle = np.linspace(0.0, 0.5 * math.pi, NODES)
    density = np.maximum(np.cos(angle), 0.0) ** (freedom - 1.0)
    # From the far end, where tails are small and must keep their digits.
    steps = 0.5 * (density[1:] + density[:-1])[::-1]
    tail = np.concatenate([[0.0], np.cumsum(steps)])
    return math.sqrt(freedom) * math.tan(0.5 * math.pi - np.interp(chance, tail / tail[-1], angle))


def limit(old: Sample, new: Sample, count: int, between: float) -> float:
    """Largest distance of two medians that is called noise, in their unit.

    Args:
        old: A time.
        new: The same time in another run.
        count: Times that are compared with one another, >= 1.
        between: What two runs may differ by whatever their spreads, in the unit of the medians.
    """
    a, b = old.error**2, new.error**2
    if a + b <= 0.0:
        return between
    # Welch and Satterthwaite: between the smaller n - 1 and both together.
    freedom = (a + b) ** 2 / (a**2 / (old.repeats - 1) + b**2 / (new.repeats - 1))
    return student(ALARM / count, freedom) * math.sqrt(a + b) + between
