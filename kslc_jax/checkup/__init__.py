"""Checks of a robot's description before anybody trains with it: `python -m kslc_jax.doctor robot`.

Imports no training.
"""
