"""Slow cases of parametrised tests."""

from typing import Any

import pytest


def cases(reason: str, *values: Any) -> list[Any]:
    """Each value, or tuple of values, as a case that the quick suite leaves out."""
    mark = pytest.mark.slow(reason=reason)
    return [pytest.param(*(v if isinstance(v, tuple) else (v,)), marks=mark) for v in values]
