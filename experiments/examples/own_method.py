"""A learning method of one's own, from outside the package: one function and one registration.

    python own_method.py train driving --algorithm focused
    python own_method.py compare driving --algorithms ppl focused --seeds 3

"focused" is HG-DAgger that listens to the expert most where it errs most: a sample weighs its
squared error to the power `focus`, a setting of its own: `--focus 0.5`, and an axis of sweeps.
The gate decides who acts, as for every method without a rule (`decide`) of its own.
"""

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp

import ppl_jax
from ppl_jax import buffers
from ppl_jax.learned import Learned, adam_step, init_learned
from ppl_jax.networks import layers, make_policy


@flax.struct.dataclass
class State:
    """All of the method's state, one pytree; updates change `learned` alone."""

    learned: Learned
    human_buffer: buffers.RingBuffer


@flax.struct.dataclass
class FocusedHParams:
    """The method's own traced settings."""

    focus: jax.Array | float = ppl_jax.setting(
        0.5, "Power of the error in a sample's weight.", low=0, common=True
    )


def make_focused(spec, config):
    """`spec` holds the sizes of the environment, `config` the static settings."""
    policy = make_policy(spec, config.hidden)

    def init(key):
        sample = (jnp.zeros(spec.observation_size), jnp.zeros(spec.action_size))
        buffer = buffers.init_buffer(sample, config.human_capacity)
        return State(learned=init_learned(policy.init(key)), human_buffer=buffer)

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
            return ppl_jax.bc_loss(mean, action, weight=weight / jnp.mean(weight))

        grads, metrics = jax.grad(loss, has_aux=True)(state.learned.params)
        shown = buffers.size(state.human_buffer) > 0
        learned = adam_step(state.learned, grads, hparams.learning_rate, do=shown)
        return dataclasses.replace(state, learned=learned), metrics

    return ppl_jax.Algorithm(
        name="focused", init=init, act=act, store=store, update=update,
        policy=lambda state: layers(state.learned.average),  # what is evaluated and exported
    )  # fmt: skip


ppl_jax.register_method("focused", make_focused, hparams=FocusedHParams)

if __name__ == "__main__":
    ppl_jax.main()
