"""Predictive Preference Learning from human interventions, in JAX."""

__version__ = "0.1.0"
