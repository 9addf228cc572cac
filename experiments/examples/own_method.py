"""A learning method of one's own, from outside the package: one function and one registration.

    python own_method.py train driving --algorithm focused
    python own_method.py compare driving --algorithms ppl focused --seeds 3

"focused" is HG-DAgger that listens to the expert most where it errs most: a sample weighs its
squared error to the power `focus`, a setting of its own: `--focus 0.5`, and an axis of sweeps.
Everything else (gate, phases, resume, evaluation, tables, vmap over seeds) comes with the loop.
"""

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp

from experiments.cli import main
from ppl_jax import buffers
from ppl_jax.algorithms import Algorithm, register
from ppl_jax.buffers import RingBuffer
from ppl_jax.fields import setting
from ppl_jax.learned import Learned, adam_step, init_learned
from ppl_jax.losses import bc_loss
from ppl_jax.networks import layers, make_policy


@flax.struct.dataclass
class State:
    """All of the method's state, one pytree; what updates change is in `learned`."""

    learned: Learned
    human_buffer: RingBuffer


@flax.struct.dataclass
class FocusedHParams:
    """The method's own traced settings."""

    focus: jax.Array | float = setting(0.5, "Power of the error in a sample's weight.", low=0)


def make_focused(spec, config):
    """`spec` tells the sizes of the world, `config` what sets shapes."""
    policy = make_policy(spec, config.hidden)

    def init(key):
        sample = (jnp.zeros(spec.observation_size), jnp.zeros(spec.action_size))
        return State(init_learned(policy.init(key)), buffers.init_buffer(sample, 20_000))

    def act(state, key, observation):  # what the novice does while training
        return policy.apply(state.learned.params, observation)

    def store(state, step, hparams):  # `step` is a `ppl_jax.types.Interaction`
        sample = (step.observation[None], step.expert_action[None])
        buffer = buffers.add(state.human_buffer, sample, mask=step.takeover[None])
        return dataclasses.replace(state, human_buffer=buffer)

    def update(state, key, hparams):  # once per environment step
        observation, action = buffers.sample(state.human_buffer, key, config.batch_size)

        def loss(params):
            mean = policy.apply(params, observation)
            error = jax.lax.stop_gradient(jnp.sum((mean - action) ** 2, -1))
            weight = (error + 1e-6) ** hparams.method.focus
            return bc_loss(mean, action, weight=weight / jnp.mean(weight))

        grads, metrics = jax.grad(loss, has_aux=True)(state.learned.params)
        shown = buffers.size(state.human_buffer) > 0
        learned = adam_step(state.learned, grads, hparams.learning_rate, do=shown)
        return dataclasses.replace(state, learned=learned), metrics

    return Algorithm(
        name="focused",
        init=init,
        act=act,
        store=store,
        update=update,
        policy=lambda state: layers(state.learned.average),  # what is evaluated and exported
    )


register("focused", make_focused, hparams=FocusedHParams)

if __name__ == "__main__":
    main()
