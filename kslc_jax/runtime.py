"""What must be set before JAX starts, and what the machine decides. Imports JAX only when asked."""

import os
from pathlib import Path

BAD_JAX = ("0.10.", "0.11.0")
"""JAX versions whose CPU backend can hang for ever in batched Cholesky factorisations."""


def cache_dir() -> Path:
    """Folder of the persistent compilation cache."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "kslc_jax"


def prepare() -> None:
    """Quiet XLA and a persistent compilation cache; values the user set stay."""
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache_dir()))


def auto_preset() -> str:
    """'paper' where JAX has an accelerator, 'laptop' without one."""
    import jax

    check_jax(jax.__version__, jax.default_backend())
    return "laptop" if jax.default_backend() == "cpu" else "paper"


def check_jax(version: str, backend: str) -> None:
    """RuntimeError for versions that hang on this backend, with the fix."""
    if backend == "cpu" and version.startswith(BAD_JAX):
        raise RuntimeError(
            f"jax {version} can hang for ever on a CPU, install another: "
            "pip install -U 'jax>=0.7.2,!=0.10.*,!=0.11.0'"
        )
