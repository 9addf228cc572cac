"""Worlds of other libraries as ours, and ours as theirs. Each file imports its library alone."""
