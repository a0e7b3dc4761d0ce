"""What every test shares: devices, seeds, checked launches, and the options of this suite."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import numpy as np
import pytest
import warp as wp

# Profiles of the property tests: --hypothesis-profile=stress draws thousands anew, `few` is for slow tools.
hypothesis.settings.register_profile("ci", max_examples=20, derandomize=True, deadline=None, print_blob=True)
hypothesis.settings.register_profile("stress", max_examples=1000, deadline=None, print_blob=True)
hypothesis.settings.register_profile("few", max_examples=2, derandomize=True, deadline=None, print_blob=True)
hypothesis.settings.load_profile("ci")

ASSETS = Path(__file__).resolve().parents[2] / "shared" / "assets"


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("warp-deferred")
    group.addoption(
        "--require-cuda", action="store_true", help="fail, not skip, GPU tests where there is no CUDA device"
    )
    group.addoption(
        "--update-goldens", action="store_true", help="rewrite stored images; look at the differences first"
    )
    group.addoption("--debug-kernels", action="store_true", help="compile kernels with bounds checks (slow)")


def pytest_configure(config: pytest.Config) -> None:
    # Before any test module imports a kernel file: Warp copies some options when a module is created.
    wp.config.log_level = wp.LOG_WARNING
    wp.config.launch_array_access_mode = wp.config.LaunchArrayAccessMode.CHECKED
    if config.getoption("--debug-kernels"):
        wp.config.mode = "debug"
    _look_at_frames(True)


def _look_at_frames(on: bool) -> None:
    """Set whether settings made from now on have every pass's numbers looked at, where they do not say."""
    from warp_deferred.settings import Settings

    Settings.model_fields["check_finite"].default = on
    Settings.model_rebuild(force=True)


@pytest.fixture
def unchecked() -> Iterator[None]:
    """No look at the numbers of frames: for tests that write bad ones on purpose, or count launches."""
    _look_at_frames(False)
    yield
    _look_at_frames(True)


def _cuda(config: pytest.Config) -> None:
    """Skip visibly without CUDA, or fail where the run insists on it."""
    if wp.is_cuda_available():
        return
    if config.getoption("--require-cuda"):
        pytest.fail("no CUDA device, and --require-cuda was given", pytrace=False)
    pytest.skip("no CUDA device")


@pytest.fixture(params=["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> str:
    """Each device in turn."""
    if request.param.startswith("cuda"):
        _cuda(request.config)
    return request.param


@pytest.fixture
def cuda_device(request: pytest.FixtureRequest) -> str:
    """The CUDA device, for tests that compare it with the CPU; mark such tests `gpu`."""
    _cuda(request.config)
    return "cuda:0"


@pytest.fixture(autouse=True)
def _seeded() -> None:
    random.seed(20240607)


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator that yields the same numbers in every run."""
    return np.random.default_rng(20240607)


@pytest.fixture
def update_goldens(request: pytest.FixtureRequest) -> bool:
    """Whether stored images are to be rewritten."""
    return bool(request.config.getoption("--update-goldens"))


@pytest.fixture(scope="session")
def assets() -> Path:
    """The folder of real models beside the repository."""
    if not ASSETS.is_dir():
        pytest.skip("no folder ../shared/assets beside the repository")
    return ASSETS
