"""KSLC in JAX: train the humanoid XBot-L to walk and run. See README.md."""

from typing import Any

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """`load_policy` and `Policy` on first use, so that importing the package stays cheap."""
    if name in ("load_policy", "Policy"):
        from kslc_jax import policy

        return getattr(policy, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
