"""Shared by all tests: hypothesis without deadlines (the first call of a kernel compiles) and with fixed examples."""

import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: small matrices, several workers, threads only spin

import pytest
from hypothesis import settings

settings.register_profile("mavquad", deadline=None, derandomize=True, max_examples=60)
settings.load_profile("mavquad")


@pytest.fixture
def recordings() -> Path:
    """The folder of whole recordings of a real autopilot, or a skip that says how to get there."""
    folder = os.environ.get("MAVQUAD_DATA", "")
    if not folder or not Path(folder).is_dir():
        pytest.skip("MAVQUAD_DATA is not set to the folder of the whole recordings")
    return Path(folder)
