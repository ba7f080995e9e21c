"""Environments written in JAX: 64 rollouts in one compiled scan, recorded as arrays, and read back to fit a model."""

import jax
import jax.numpy as jnp
from gymnasium import spaces

import tupli_mcap

STEPS, ENVS = 200, 64


def reset(key):
    """A pendulum that hangs somewhere: [cos, sin, velocity]."""
    angle, velocity = jax.random.uniform(key, (2,), minval=-1, maxval=1) * jnp.array([jnp.pi, 1])
    return jnp.array([jnp.cos(angle), jnp.sin(angle), velocity])


def step(state, torque):
    angle, velocity = jnp.arctan2(state[1], state[0]), state[2]
    reward = -(angle**2 + 0.1 * velocity**2 + 0.001 * torque[0] ** 2)
    velocity = jnp.clip(velocity + (15 * jnp.sin(angle) + 3 * torque[0]) * 0.05, -8, 8)
    angle = angle + velocity * 0.05
    return jnp.array([jnp.cos(angle), jnp.sin(angle), velocity]), reward


@jax.jit
def rollout(key):
    """States [T + 1, N, 3], actions [T, N, 1] and rewards [T, N] of random torques."""
    of_states, of_torques = jax.random.split(key)
    first = jax.vmap(reset)(jax.random.split(of_states, ENVS))
    torques = jax.random.uniform(of_torques, (STEPS, ENVS, 1), minval=-2, maxval=2)

    def both(state, torque):
        after, reward = jax.vmap(step)(state, torque)
        return after, (after, reward)

    _, (after, rewards) = jax.lax.scan(both, first, torques)
    return jnp.concatenate([first[None], after]), torques, rewards


states, actions, rewards = rollout(jax.random.key(0))
tupli_mcap.write_rollout(
    "jax_rollout.mcap",
    states,  # one more than there are actions: the last ones are the final states
    actions,
    rewards,
    timeouts=jnp.zeros((STEPS, ENVS), bool).at[-1].set(True),
    observation_space=spaces.Box(-8, 8, (3,)),
    action_space=spaces.Box(-2, 2, (1,)),
    labels={"states": ["cos", "sin", "velocity"], "actions": ["torque"]},
    name="random torques",
    metadata={"seed": 0},
)

dataset = tupli_mcap.open("jax_rollout.mcap")
print("recorded", dataset, "with returns from", dataset.returns.min(), "to", dataset.returns.max())

steps = dataset.transitions()[:]
inputs = jnp.concatenate([steps.states, steps.actions, jnp.ones((dataset.n_steps, 1))], axis=1)
model, *_ = jnp.linalg.lstsq(inputs, steps.next_states)
error = jnp.abs(inputs @ model - steps.next_states).mean(axis=0)
print(
    "a linear model of the next state is off by",
    dict(zip(["cos", "sin", "velocity"], error.tolist(), strict=True)),
)
