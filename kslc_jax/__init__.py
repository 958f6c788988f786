"""KSLC in JAX: train the humanoid XBot-L to walk and run. See README.md."""

__version__ = "0.1.0"
