"""A study of your own, from outside the package: a grid with a name.

    python own_study.py sweep driving --study interval --dry-run
    python own_study.py sweep driving --study interval --out interval
    python own_study.py figure interval

Does it matter how often the gate decides? Every value is run with every seed; results, resuming,
table and figure are those of `ppl sweep`.
"""

import ppl_jax
from experiments.studies.grid import Study

ppl_jax.register_study(
    "interval",
    Study(
        title="steps that a decision holds",
        algorithms=("ppl", "hg_dagger"),
        axes={"decision_interval": (5, 10, 20)},
        evaluations=4,
    ),
)

if __name__ == "__main__":
    ppl_jax.main()
