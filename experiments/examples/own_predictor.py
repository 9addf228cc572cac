"""A predictor of your own, from outside the package: one function and one registration.

    python own_predictor.py train driving --predictor sluggish --lag 0.5
    python own_predictor.py sweep driving --predictor simulator sluggish --seeds 5

"sluggish" is the simulator with actions that arrive only in part, as with a wrong motor model. The
predictor owns `lag`: it is an option, an axis of sweeps and a column of results.
"""

import flax.struct
import jax

import ppl_jax


@flax.struct.dataclass
class SluggishHParams:
    """The predictor's own traced settings."""

    lag: jax.Array | float = ppl_jax.setting(
        0.3, "Share of the action that does not arrive.", low=0, high=1, group="predictor",
        common=True,
    )  # fmt: skip


def make_sluggish(env):
    """The transition that predictions use in an environment."""

    def transition(key, state, action, params, *, hparams):
        return env.transition(key, state, (1.0 - hparams.lag) * action, params)

    return transition


ppl_jax.register_predictor("sluggish", make_sluggish, hparams=SluggishHParams)

if __name__ == "__main__":
    ppl_jax.main()
