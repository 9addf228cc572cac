"""Many runs: grids, comparisons, and the runner they share."""
