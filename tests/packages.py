"""Shipped robots whose MJCFs come from packages that may be missing."""

import pytest

from kslc_jax.robots import description
from kslc_jax.robots.description import Description, RobotError


def described(name: str) -> Description:
    """A robot's description. Skips the test if the package with its MJCF is missing."""
    try:
        return description.read(name)
    except RobotError as error:
        if "pip install" not in str(error):
            raise
        pytest.skip(str(error))
