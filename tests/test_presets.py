"""Presets: chosen from a result by a rule, shipped as made, and set beside what a user sets."""

import json

import bench_package
import pytest
from typer.testing import CliRunner  # noqa: F401

import warp_deferred as wd
from bench import presets, record
from bench.__main__ import main
from bench.ladders import LADDERS
from warp_deferred.presets import PRESETS

ROOT = bench_package.ROOT
