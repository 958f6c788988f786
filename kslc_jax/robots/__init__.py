"""The robots' models (MJCF). Imports no JAX."""

from pathlib import Path

XBOT_L = Path(__file__).parent / "xbot_l.xml"
"""The model of XBot-L, see NOTICE."""
