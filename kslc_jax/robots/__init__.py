"""Robots: descriptions, and the models that are derived from them. Imports no JAX."""
