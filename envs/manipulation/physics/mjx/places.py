"""`array.at[places].set(new)` for places known before tracing, without a scatter.

On a CPU a scatter costs a whole physics step its speed: see `repairs.py`.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def with_values(array: jax.Array, places: Any, new: Any) -> jax.Array:
    """`array.at[places].set(new)`.

    Args:
        array: [N, ...].
        places: Whole numbers or a slice, known before tracing: of the first axis.
        new: What shall be there, of the shape of `array[places]`.
    """
    count = array.shape[0]
    at = np.arange(count)[places]
    order = np.arange(count, dtype=np.int32)
    order[at] = count + np.arange(at.size).reshape(at.shape)
    added = jnp.reshape(jnp.asarray(new, array.dtype), (at.size, *array.shape[1:]))
    return jnp.concatenate([array, added])[order]
