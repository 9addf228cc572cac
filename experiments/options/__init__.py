"""Options of the commands, generated from the settings classes."""
