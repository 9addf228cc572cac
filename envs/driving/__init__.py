"""A jitted driving environment true to MetaDrive."""
