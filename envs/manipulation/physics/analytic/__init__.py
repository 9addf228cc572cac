"""The arms' physics written out in scalars: the fast path on a CPU."""
