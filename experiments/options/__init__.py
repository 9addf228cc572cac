"""What the commands take, generated from the settings classes."""
