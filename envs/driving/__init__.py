"""A jitted driving world true to MetaDrive."""
