"""Cards of the environments: `card(name)` reads one without building the environment."""

from ppl_jax.cards import DEFAULT, EnvCard, ExpertCard, card

__all__ = ["DEFAULT", "EnvCard", "ExpertCard", "card"]
