"""The human interface: a person in a browser takes over from a policy that learns from it."""
