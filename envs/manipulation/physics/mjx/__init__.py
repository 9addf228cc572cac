"""Any MJCF scene on MJX (MuJoCo in JAX), made fit for XLA's CPU compiler."""
