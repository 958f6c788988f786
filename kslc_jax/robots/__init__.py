"""Models of the robots (MJCF). Imports no JAX."""

from pathlib import Path

XBOT_L = Path(__file__).parent / "xbot_l.xml"
"""Model of XBot-L; NOTICE gives its source and licence."""
