"""Environments of other libraries as ours, and ours as theirs; each file imports its own alone."""
