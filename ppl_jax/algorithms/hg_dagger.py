"""HG-DAgger (Kelly et al. 2019): clone the expert while it is in control."""

from __future__ import annotations

from ppl_jax.algorithms.base import Algorithm
from ppl_jax.algorithms.bc import make_cloner
from ppl_jax.config import TrainConfig
from ppl_jax.types import EnvSpec


def make_hg_dagger(spec: EnvSpec, config: TrainConfig) -> Algorithm:
    """HG-DAgger with the shared gate in the human's place.

    Only (s, a_h) under the expert's control is learnt from. Updated at every step rather than
    retrained after every episode, as all methods here are; this is PPL without its preference
    loss.
    """
    return make_cloner("hg_dagger", spec, config, decide=None)
